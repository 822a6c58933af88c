"""Record, check and draw the insertions of `needle demo`."""
