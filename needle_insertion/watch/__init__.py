"""Live or recorded state of the nodes as a page in a browser."""
