"""Run the experiments of the paper in a graph of nodes, and compare with the true values."""
