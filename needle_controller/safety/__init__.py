"""Safety checks before each force command: inputs, limits, latched stop."""
