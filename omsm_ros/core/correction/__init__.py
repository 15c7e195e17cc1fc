"""From a recording and a calibration to surface points, each with its uncertainty."""
