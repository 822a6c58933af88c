"""References: where the needle should be over time, within limits of speed and acceleration."""
