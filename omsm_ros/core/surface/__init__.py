"""Nominal shapes: heights, slopes, poses; grids and points; the deviation from them."""
