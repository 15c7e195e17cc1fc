"""Digital twin of the cell: samples as the devices report them, and the true values."""
