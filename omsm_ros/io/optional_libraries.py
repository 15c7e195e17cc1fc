"""Loads optional libraries, and looks through an HDF5 file in a process of its own."""

import importlib
from pathlib import Path
from types import ModuleType
from typing import Any

from omsm_ros.errors import FileError
from omsm_ros.io.child_process import read_in_child
from omsm_ros.quantities import MAP_POINTS, shown


def walk_in_child(path: Path, what: str) -> None:
    """Raise FileError if reading ``path`` does not end, crashes, or needs other files."""
    read_in_child(path, what, "write it again", lambda: _walk(path, what))


def _walk(path: Path, what: str) -> None:
    """Read all attributes, and all arrays that could be a map."""
    import h5py

    def look(name: str, item: Any) -> None:
        list(item.attrs.items())
        _keep_within(h5py, name, item, what)
        if isinstance(item, h5py.Dataset) and item.size and item.size <= MAP_POINTS.high:
            item[()]

    with h5py.File(path, "r") as content:
        look("/", content)
        content.visititems(look)


def _keep_within(h5py: Any, name: str, item: Any, what: str) -> None:
    """Raise FileError if an array or a link of a group is in another file.

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
        raise FileError(
            f"{what} takes {shown(elsewhere[0])} from another file; save it with all its data"
        )


def import_optional(name: str, what: str) -> ModuleType:
    """Return the module ``name``; raise FileError, which calls the file ``what``, without it."""
    try:
        return importlib.import_module(name)
    except ImportError as err:
        raise FileError(
            f"{what} needs a further Python package: pip install {name}, or convert it to text"
        ) from err
