"""Populations: many insertions that differ, and how often they do what they should."""
