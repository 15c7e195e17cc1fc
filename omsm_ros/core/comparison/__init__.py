"""Compare two measurements of one part: match, subtract, test the agreement."""
