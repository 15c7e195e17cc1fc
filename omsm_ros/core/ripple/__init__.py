"""Lines in the spectra of scans, and their sources."""
