"""What is happening, as a page in a browser: live, or from a bag."""
