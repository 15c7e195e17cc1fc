"""The page of a calibration: its certificate and figures."""
