"""What every node shares: the contract on the wire, settings, time and the common node."""
