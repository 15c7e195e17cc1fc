"""On-machine surface measurement with the dynamic error of the loop corrected."""

__version__ = "0.1.0"
