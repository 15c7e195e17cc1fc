"""Figures of a registered deviation, each with its uncertainty; the offsets of the next cut."""
