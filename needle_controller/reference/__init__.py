"""References: the motion that a law follows."""
