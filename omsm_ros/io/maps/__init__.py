"""Maps and point clouds of other programs."""
