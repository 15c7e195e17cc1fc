"""Pipelines: complete tasks from files to files, shared by commands and nodes."""
