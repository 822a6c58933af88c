"""What the laws and the observer compile to machine code."""
