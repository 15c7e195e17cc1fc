"""Which G(s) describes a recording best: structures, fits, and the choice among them."""
