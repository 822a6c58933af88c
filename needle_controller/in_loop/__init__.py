"""Closed loops in simulation: continuous laws, the sampled controller, and batches of runs."""
