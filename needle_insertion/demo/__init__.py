"""Record, check and draw the insertions of `needle demo`, on one page with the experiments."""
