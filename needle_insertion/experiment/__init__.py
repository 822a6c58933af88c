"""The protocols of the paper, run in a graph of nodes."""
