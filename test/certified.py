"""Certificates for tests, from the flat names of version 1."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

from omsm_ros.core.calibration.calibration import certificate_of_version_1
from omsm_ros.core.calibration.certificate import Certificate


def certified_by(
    entries: Mapping[str, Any] | Certificate, on: Certificate | None = None
) -> Certificate:
    """Return the certificate that states ``entries``, beside what ``on`` states."""
    if isinstance(entries, Certificate):
        return entries
    found = certificate_of_version_1(entries)
    return found if on is None else _merged(on, found)


def _merged(before: Any, after: Any) -> Any:
    changes = {}
    for field in fields(after):
        old, new = (getattr(each, field.name) for each in (before, after))
        if is_dataclass(new) and is_dataclass(old) and field.name != "latency":
            changes[field.name] = _merged(old, new)
        elif new is not None and new != () and new != {}:
            changes[field.name] = new
    return replace(before, **changes)
