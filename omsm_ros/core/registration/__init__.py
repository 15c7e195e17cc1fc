"""Register measured points on their nominal surface; align the probe on a reference sphere."""
