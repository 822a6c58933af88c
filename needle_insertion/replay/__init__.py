"""Recomputation of recorded plant runs."""
