"""Simulated needles, guides and sensors that differ from the model of this project."""
