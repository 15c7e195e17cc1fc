"""Several scans of one part, evaluated together."""
