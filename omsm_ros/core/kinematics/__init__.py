"""Axes, trajectories, limits."""
