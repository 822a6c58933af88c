"""A running graph: what a person may ask of it, and what its nodes say of themselves."""
