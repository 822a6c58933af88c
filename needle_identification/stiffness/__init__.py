"""Stiffness of the tissue in the plane of deflection, from presses with an end-effector."""
