"""Micro-Epsilon confocalDT and capaNCDT."""
