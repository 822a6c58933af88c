"""Command line, demo and reports: the composition of plant, controller and identification."""
