"""Friction identification from the force and the motion of the needle base."""
