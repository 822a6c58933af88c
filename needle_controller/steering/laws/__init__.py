"""Steering laws: four methods of the literature, and our law for all hypotheses."""
