"""The paper: its figures, tables and claims."""
