"""Guides that move so that the tip hits its target: our controller, and those of others."""
