"""Simulated needle, tissue and sensors, advanced in simulated time."""
