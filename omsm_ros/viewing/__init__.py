"""The running scan in a browser: what is shown, and the server that shows it."""
