"""Estimation of transfer functions from records."""
