"""A map of a surface that a reader can enlarge: its data, and the script that draws them."""
