"""Start the nodes as processes, and wait for their states and messages."""
