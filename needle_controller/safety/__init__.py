"""What must be well before a force may be commanded: inputs, limits, and the stop."""
