"""Define the experiments of the paper: published values, motions and sampled parameters."""
