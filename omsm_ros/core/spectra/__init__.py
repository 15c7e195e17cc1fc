"""Spectra of a scan in time and along the part; what each of their lines is."""
