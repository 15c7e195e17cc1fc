"""Whole tasks, shared by commands and nodes."""
