"""Run the experiments of the paper and the demo in a graph of nodes."""
