"""The page of a running scan."""
