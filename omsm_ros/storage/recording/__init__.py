"""Bags as they are written: in place, readable at every moment, repaired where cut."""
