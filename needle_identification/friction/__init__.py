"""Friction of a needle from the force and the motion of its base."""
