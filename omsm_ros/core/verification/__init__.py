"""Is a calibration true? Free paths, reversal, change, repeatability."""
