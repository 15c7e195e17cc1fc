"""Is an HDF5 file read to its end? A damaged one may keep its library in a loop for ever.

Nothing in this process could interrupt that loop, so another one goes first.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

from omsm_ros.errors import FileError
from omsm_ros.quantities import MAP_POINTS

# To start a process, and to read from a slow disk; a damaged file of any size is known so soon.
LIMIT_S, SLOWEST_BYTES_S = 3.0, 50e6


def walked(path: Path, what: str) -> None:
    """Raise FileError if reading all of ``path`` does not end in time, or ends its process."""
    command = [sys.executable, "-m", __name__, str(path.absolute())]
    limit = LIMIT_S + path.stat().st_size / SLOWEST_BYTES_S
    try:
        done = subprocess.run(command, capture_output=True, check=False, timeout=limit)
    except subprocess.TimeoutExpired as err:
        raise FileError(f"{what} is not read in {limit:.1f} s: damaged; write it again") from err
    if done.returncode < 0:
        raise FileError(f"{what} ends the program that reads it: damaged; write it again")


def _walk(path: str) -> None:
    """Read every attribute, and every array that could be a map."""
    import h5py

    def look(_: str, item: Any) -> None:
        list(item.attrs.items())
        if isinstance(item, h5py.Dataset) and item.size and item.size <= MAP_POINTS.high:
            item[()]

    with h5py.File(path, "r") as content:
        list(content.attrs.items())
        content.visititems(look)


if __name__ == "__main__":
    _walk(sys.argv[1])
