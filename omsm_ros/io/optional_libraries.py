"""Loads optional libraries, and checks an HDF5 file in a process of its own.

On a damaged file the HDF5 library may loop for ever, which this process could not interrupt.
"""

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

# Processor time to load the library [s], rate of slow unpacking [bytes/s], and elapsed time over
# processor time for a slow disk.
LIMIT_S, SLOWEST_BYTES_S, _WAITING = 2.0, 50e6, 10.0
_LINK_TYPES = 3


def walk_in_subprocess(path: Path, what: str) -> None:
    """Raise FileError if reading ``path`` does not end, crashes, or needs other files."""
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
    """Exit if an array or a link of a group is in another file.

    The author of the file would choose which file of the user is opened.
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


def import_optional(name: str, what: str) -> ModuleType:
    """Return the module ``name``; raise FileError, which calls the file ``what``, without it."""
    try:
        return importlib.import_module(name)
    except ImportError as err:
        raise FileError(
            f"{what} needs a further Python package: pip install {name}, or use xyz or PLY instead"
        ) from err
