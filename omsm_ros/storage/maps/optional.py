"""Libraries for some formats only: loaded when such a file comes, named when they are missing."""

from __future__ import annotations

import importlib
from types import ModuleType

from omsm_ros.errors import FileError


def library(name: str, what: str) -> ModuleType:
    """Return the module ``name``; raise FileError, which calls the file ``what``, without it."""
    try:
        return importlib.import_module(name)
    except ImportError as err:
        raise FileError(
            f"{what} needs a further Python package: pip install {name}, or use xyz or PLY instead"
        ) from err
