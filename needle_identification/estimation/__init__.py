"""Linear regression with standard errors, residual tests, and parameter estimates."""
