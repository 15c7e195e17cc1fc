"""Devices: a transport that moves bytes, and one class a model that turns them into blocks."""
