"""Models between any two sampled quantities: what follows what, how well known, how far valid."""
