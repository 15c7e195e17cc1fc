"""G(s) and H(z): what a transfer function does, and how well it is known."""
