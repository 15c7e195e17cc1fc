"""The page of spectra: every line with its name and its evidence."""
