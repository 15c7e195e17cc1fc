"""Bags and files, and the one mapping between messages and records."""
