"""Observer: Kalman filter of the needle deflection."""
