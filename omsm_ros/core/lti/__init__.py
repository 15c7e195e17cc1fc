"""Linear systems: G(s), H(z), bands, modes."""
