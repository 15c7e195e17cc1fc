"""Is an HDF5 file read to its end, and from itself alone?

A damaged one may keep its library in a loop for ever. Nothing in this process could interrupt that
loop, so another one goes first.
"""

from __future__ import annotations

import importlib
import math
import resource
import signal
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from omsm_ros.errors import FileError
from omsm_ros.quantities import MAP_POINTS, shown

# Of a processor: to load the library, and to unpack slowly. A loop takes that much on an idle
# computer as on a busy one; what only waits, for a disk, has ten times as long.
LIMIT_S, SLOWEST_BYTES_S, _WAITING = 2.0, 50e6, 10.0
_LINK_TYPES = 3


def walk_in_subprocess(path: Path, what: str) -> None:
    """Raise FileError if reading all of ``path`` does not end, ends its process, or leaves it."""
    limit = math.ceil(LIMIT_S + path.stat().st_size / SLOWEST_BYTES_S)
    command = [sys.executable, "-m", __name__, str(path.absolute()), str(limit)]
    endless = f"{what} is not read in {limit} s: damaged; write it again"
    try:
        done = subprocess.run(
            command, capture_output=True, check=False, timeout=_WAITING * limit, text=True
        )
    except subprocess.TimeoutExpired as err:
        raise FileError(endless) from err
    if done.returncode == -signal.SIGXCPU:
        raise FileError(endless)
    if done.returncode == _LINK_TYPES:
        raise FileError(
            f"{what} takes {done.stdout.strip()} from another file; save it with all its data"
        )
    if done.returncode < 0:
        raise FileError(f"{what} ends the program that reads it: damaged; write it again")


def _walk(path: str, limit: int) -> None:
    """Read all attributes, and all arrays that could be a map; ``limit`` of processor time [s]."""
    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 1))
    import h5py

    def look(name: str, item: Any) -> None:
        list(item.attrs.items())
        _keep_within(h5py, name, item)
        if isinstance(item, h5py.Dataset) and item.size and item.size <= MAP_POINTS.high:
            item[()]

    with h5py.File(path, "r") as content:
        look("/", content)
        content.visititems(look)


def _keep_within(h5py: Any, name: str, item: Any) -> None:
    """End this process if an array or a link of a group stands in a file of its own.

    Whoever made the file would choose which one of the reader's is opened, a pipe among them.
    """
    if isinstance(item, h5py.Group):
        links = {child: item.get(child, getlink=True) for child in item}
        elsewhere = [c for c, link in links.items() if isinstance(link, h5py.ExternalLink)]
    elif isinstance(item, h5py.Dataset):
        mapped = item.virtual_sources() if item.is_virtual else []
        other = item.external or [source for source in mapped if source.file_name != "."]
        elsewhere = [name] if other else []
    else:
        elsewhere = []
    if elsewhere:
        print(shown(elsewhere[0]))
        sys.exit(_LINK_TYPES)


if __name__ == "__main__":
    _walk(sys.argv[1], int(sys.argv[2]))


# Libraries for some formats only: loaded when such a file comes, named when they are missing.


def import_optional(name: str, what: str) -> ModuleType:
    """Return the module ``name``; raise FileError, which calls the file ``what``, without it."""
    try:
        return importlib.import_module(name)
    except ImportError as err:
        raise FileError(
            f"{what} needs a further Python package: pip install {name}, or use xyz or PLY instead"
        ) from err
