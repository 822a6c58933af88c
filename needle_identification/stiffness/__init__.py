"""Identification of the stiffness of the tissue."""
