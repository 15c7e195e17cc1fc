"""Probes, encoders and sensors: protocol, device and emulator of each."""
