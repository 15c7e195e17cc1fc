"""The running scan in a browser."""
