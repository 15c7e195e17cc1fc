"""From a step test to a certified calibration."""
