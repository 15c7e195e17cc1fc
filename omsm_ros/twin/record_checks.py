"""Check the numbers of disturbances, and whether a disturbance is switched on."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, ClassVar

import numpy as np

from omsm_ros.errors import ConfigurationError

# Largest plausible value by the unit at the end of a field's name; a larger one has a wrong unit.
_LIMITS: Mapping[str, float] = {
    "_m": 10.0,
    "_s": 1e6,
    "_hz": 1e6,
    "_rad": 10.0,
    "_ppm": 1e5,
    "_ratio": 100.0,
}
LONGEST_LAG_S = 1.0
"""Largest delay of a sample [s]; the simulation starts earlier by this time."""


class CheckedNumbers:
    """Base of records, which refuses a number that is not finite or beyond its limits.

    positive, not_negative: names of such fields
    lags: names of times of at most a second, of either sign

    Raises ConfigurationError.
    """

    __slots__ = ()
    positive: ClassVar[tuple[str, ...]] = ()
    not_negative: ClassVar[tuple[str, ...]] = ()
    lags: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for field in fields(self):  # type: ignore[arg-type]  # each is a dataclass
            value = getattr(self, field.name)
            if isinstance(value, bool) or not isinstance(value, int | float):
                continue
            ends = (most for unit, most in _LIMITS.items() if field.name.endswith(unit))
            limit = next(ends, float(np.finfo(np.float64).max))
            limit = LONGEST_LAG_S if field.name in self.lags else limit
            least = -limit
            if field.name in self.positive or field.name in self.not_negative:
                least = 0.0
            zero_refused = field.name in self.positive and value == 0
            if not least <= value <= limit or zero_refused:
                expected = "a positive number" if field.name in self.positive else "a number"
                raise ConfigurationError(
                    f"{type(self).__name__}: {field.name} is {value!r}, expected {expected} from "
                    f"{least:g} to {limit:g}; check its unit"
                )


def is_default(record: Any) -> bool:
    """Return True if a record equals its default, so that nothing is switched on."""
    return bool(record == type(record)())
