"""The option that names the catalogue where what was calibrated or measured is written down."""

from __future__ import annotations

import argparse
import os

ADDRESS = "OMSM_CATALOGUE"
"""Environment variable: the catalogue of this shop, where none is named."""


def declare_catalogue(sub: argparse.ArgumentParser) -> None:
    """Add ``--catalogue`` to a command that makes something worth remembering."""
    sub.add_argument(
        "--catalogue",
        default=os.environ.get(ADDRESS, ""),
        metavar="FILE|URL",
        help=f"write it down there, too; default: ${ADDRESS}",
    )
