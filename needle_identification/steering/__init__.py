"""Steering identification: needle bending from depth, guide, roll and tip positions."""
