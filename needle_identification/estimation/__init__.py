"""From arrays to estimates with their intervals."""
