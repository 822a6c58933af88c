"""Benchmarks: cost and accuracy compared with common alternatives."""
