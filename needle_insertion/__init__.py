"""Command line, running nodes and reports of the needle insertion suite."""
