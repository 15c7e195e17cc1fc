"""Digital twin of the cell: samples as the devices report them, and the true values.

``omsm_ros.twin(…)`` is ``omsm_ros.simulate(…)``.
"""

import importlib
import sys
from types import ModuleType
from typing import Any


class _Twin(ModuleType):
    def __call__(self, *args: Any, **options: Any) -> Any:
        # By its name, so that the twin depends on nothing above it.
        return importlib.import_module("omsm_ros.api").simulate(*args, **options)


sys.modules[__name__].__class__ = _Twin
