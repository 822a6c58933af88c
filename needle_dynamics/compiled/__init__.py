"""Everything that is compiled to machine code."""
