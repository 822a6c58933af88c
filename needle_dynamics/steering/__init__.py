"""Steered needles: constants, motion, batches and reference models."""
