"""Report pages, tables and figures."""
