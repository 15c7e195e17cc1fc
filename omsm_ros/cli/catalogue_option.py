"""The option that writes down what was calibrated or measured; it never costs a measurement."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable

from omsm_ros.errors import OmsmError

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


def remembered(address: str, keep: Callable[[], bool]) -> list[str]:
    """Write something down if there is a catalogue; return a warning where that failed.

    A measurement is never lost because of a database: it lies in its folder already.
    """
    if not address:
        return []
    try:
        keep()
    except (OmsmError, OSError) as err:
        return [f"not written into the catalogue: {err}; 'omsm history --add' does it later"]
    return []
