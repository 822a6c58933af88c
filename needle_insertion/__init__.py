"""Command line, demo, experiments and reports of the needle insertion suite."""
