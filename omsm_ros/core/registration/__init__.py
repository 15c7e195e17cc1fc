"""How does the part sit, and the probe beside the spindle? A known shape fitted to points."""
