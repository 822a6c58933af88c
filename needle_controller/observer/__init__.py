"""The estimate of the deflection from what is measured."""
