"""What shape does the part have? Figures of a registered deviation, each with its uncertainty."""
