"""A recorded run of a plant, computed again."""
