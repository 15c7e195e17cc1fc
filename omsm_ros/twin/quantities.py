"""What every record of a disturbance is checked for, and when it is switched on."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np

from omsm_ros.errors import ConfigurationError


def check_numbers(
    record: Any, *, positive: tuple[str, ...] = (), not_negative: tuple[str, ...] = ()
) -> None:
    """Raise ConfigurationError for a number of a record that is not finite or out of its limits."""
    for field in fields(record):
        value = getattr(record, field.name)
        if isinstance(value, bool) or not isinstance(value, int | float):
            continue
        expected = "a finite number"
        fails = not np.isfinite(value)
        if field.name in positive:
            expected, fails = "a positive number", fails or value <= 0
        elif field.name in not_negative:
            expected, fails = "zero or a positive number", fails or value < 0
        if fails:
            raise ConfigurationError(
                f"{type(record).__name__}: {field.name} is {value!r}, expected {expected}"
            )


def is_default(record: Any) -> bool:
    """True if a record is as it is without arguments: nothing is switched on."""
    return bool(record == type(record)())
