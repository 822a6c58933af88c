"""Recordings: force and motion of one experiment, as arrays on one time base."""
