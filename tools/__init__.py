"""Checks of this repository, for `make check` and Git hooks."""
