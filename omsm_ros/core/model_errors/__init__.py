"""Deviations of a machine from a linear, time-invariant response, and tests for them."""
