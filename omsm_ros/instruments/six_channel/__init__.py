"""The generic six-channel stream, binary and text."""
