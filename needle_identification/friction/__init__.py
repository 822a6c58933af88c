"""Identification of friction."""
