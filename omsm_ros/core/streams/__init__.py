"""Blocks of samples: counters, stamps, pairing."""
