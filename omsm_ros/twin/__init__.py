"""The digital twin of the cell: samples as the devices give them, and the truth behind them."""
