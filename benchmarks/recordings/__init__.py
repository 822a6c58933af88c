"""Steering laws and identification on recorded insertions, from a folder outside of this one."""
