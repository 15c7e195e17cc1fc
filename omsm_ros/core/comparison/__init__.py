"""Do two measurements of one part agree? The same places, the difference, what it is worth."""
