"""Precitec CHRocodile."""
