"""Calibrations: what they hold, when they apply, how they repeat."""
