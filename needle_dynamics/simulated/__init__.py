"""A needle, its tissue and its sensors in simulated time."""
