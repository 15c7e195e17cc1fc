"""From a recording to a calibration: band, tests of the residual, verdict."""
