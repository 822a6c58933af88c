"""A needle that cuts its own path: its constants, its motion, many of them, and other models."""
