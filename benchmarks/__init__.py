"""Benchmarks: what it costs, beside what a user would otherwise use."""
