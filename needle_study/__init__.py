"""Simulate populations of insertions and estimate the distribution of their metrics."""
