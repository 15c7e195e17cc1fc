"""``DISTURBANCES.yaml`` with what a test wants to be wrong with the machine."""

from __future__ import annotations

from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any

import yaml

from omsm_ros.twin.disturbances import Disturbances


def write_disturbances(path: Path, disturbances: Disturbances) -> None:
    """Write all that is switched on."""
    path.write_text(yaml.safe_dump(content_of(disturbances), sort_keys=False))


def content_of(record: Any) -> dict[str, Any]:
    """Names and values of a record that are not as they are by default."""
    content: dict[str, Any] = {}
    for field in fields(record):
        value = getattr(record, field.name)
        default = field.default if field.default_factory is MISSING else field.default_factory()
        if value == default:
            continue
        if is_dataclass(value):
            content[field.name] = content_of(value)
        elif isinstance(value, tuple):
            content[field.name] = [content_of(item) for item in value]
        else:
            content[field.name] = value
    return content
