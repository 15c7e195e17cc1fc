"""``SOURCES.yaml``: what is uncertain of the machine, one statement a source.

schema: omsm-sources/1
sources:
  - {source: tilt, value: 5.0e-6, unit: rad, how: declared, reason: dial gauge at the rim}
  - {source: spindle_axial, per_turn: 2, value: 8.0e-9, unit: m, distribution: arcsine,
     how: evaluated, reason: ball and capacitive sensor}
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omsm_ros.core.correction.machine_sources import MachineSources, StatedSource
from omsm_ros.core.correction.source_kinds import KINDS
from omsm_ros.errors import ConfigurationError, FileError
from omsm_ros.storage import strict_yaml
from omsm_ros.storage.files import read_text
from omsm_ros.storage.schemas import NUMBER, check_form, form

SCHEMA = "omsm-sources/1"
MAX_BYTES = 100_000
_MOST_SOURCES = 200
_TEXT = {"type": "string"}
_OWN = {"source": _TEXT, "value": NUMBER, "unit": _TEXT, "how": _TEXT, "reason": _TEXT}
_PARAMETERS = {key: NUMBER for kind in KINDS.values() for key in kind.parameters}
_ITEM = form({**_OWN, "distribution": _TEXT, **_PARAMETERS}, tuple(_OWN))
_FORM = form(
    {
        "schema": {"const": SCHEMA},
        "sources": {"type": "array", "items": _ITEM, "maxItems": _MOST_SOURCES},
    },
    ("schema", "sources"),
)


def load_sources(path: Path | str) -> MachineSources:
    """Read ``SOURCES.yaml``; FileError naming the source and what is wrong with it."""
    what = f"sources {str(path)!r}"
    content = strict_yaml.mapping_of(
        read_text(path, MAX_BYTES, FileError, "sources"), FileError, what
    )
    check_form(content, _FORM, FileError, what)
    try:
        return MachineSources(tuple(_stated(item) for item in content["sources"]))
    except ConfigurationError as err:
        raise FileError(f"{what}: {err}") from err


def _stated(item: Mapping[str, Any]) -> StatedSource:
    own = {name: item[name] for name in (*_OWN, "distribution") if name in item}
    unit = own.pop("unit")
    stated = StatedSource(**own, parameters={k: v for k, v in item.items() if k in _PARAMETERS})
    expected = KINDS[stated.source].quantity.unit or "1" if stated.source in KINDS else "m"
    if unit != expected:
        raise ConfigurationError(f"{stated.source} is stated in {unit!r}, expected {expected!r}")
    return stated
