"""Linear regression with standard errors, tests of its residuals, and estimates of parameters."""
