"""Steering: laws that move the guide so that the tip hits its target, and their executive."""
