"""Control laws, sampled and in continuous time."""
