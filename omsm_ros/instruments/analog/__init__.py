"""Analog sensors behind a data acquisition device."""
