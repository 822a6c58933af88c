"""Recordings: what a bag says of one experiment, as arrays."""
