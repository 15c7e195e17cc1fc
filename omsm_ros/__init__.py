"""On-machine surface measurement with the dynamic error of the loop corrected.

The Python interface stands in :mod:`omsm_ros.api`; its names can be used from here, and are loaded
when one of them is used first::

    import omsm_ros as omsm

    calibration = omsm.identify(omsm.read("steps.mcap"))
    points = omsm.correct(omsm.read("scan.mcap"), calibration)
"""

import importlib
from collections.abc import Mapping
from typing import Any

from omsm_ros import errors

__version__ = "0.1.0"


def _sentence(code: str, values: Mapping[str, Any]) -> str:
    """Return the text of an error; the templates are loaded when the first one is written."""
    from omsm_ros import messages

    return messages.sentence(code, values)


errors.write_texts_with(_sentence)

# The public names, here alone; a test holds them.
__all__ = [
    "Adjusted", "Calibration", "Difference", "Form", "Plan", "Points", "Prediction", "Recording",
    "Spectrum", "adjust", "correct", "difference", "form", "identify", "load", "plan", "predict",
    "read", "simulate", "spectrum", "surface",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Return a name of the Python interface, which is loaded now."""
    if name in __all__:
        # By its name, so that the package itself depends on none of its rooms.
        return getattr(importlib.import_module("omsm_ros.api"), name)
    if name == "twin":
        return importlib.import_module("omsm_ros.twin")
    raise AttributeError(f"module 'omsm_ros' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return the public names, those of the interface too."""
    return sorted({*globals(), *__all__})
