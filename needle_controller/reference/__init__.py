"""Reference generator: setpoints over time within limits of speed and acceleration."""
