"""Identification of the tissue stiffness in the plane of deflection from indentation presses."""
