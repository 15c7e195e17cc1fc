"""Tables of a report: numbers as text, with their units."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.machine_sources import OF_CALIBRATION
from omsm_ros.messages import text_from
from omsm_ros.readable import NOTHING, column, count, measured, number, plain, quantity

_OPEN = "not evaluated"
POSE_UNITS = {
    "piston": "m", "x": "m", "y": "m", "tip": "rad", "tilt": "rad", "clocking": "rad",
    "power": "1/m",
}  # fmt: skip


def unit_of_parameter(name: str) -> str:
    """Return the unit of a parameter of a pose, or of the shape of a surface."""
    return POSE_UNITS.get(name, "" if name.startswith("conic") else "m")


@dataclass(frozen=True, slots=True)
class Table:
    """A table: ``rows`` of a label and one text per column; no heading without ``columns``.

    prose: the column that holds sentences instead of numbers, empty for none
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[tuple[str, ...]]
    prose: str = ""


def filled(title: str, items: Iterable[object], label: str, columns: Mapping[str, str]) -> Table:
    """Return a table of ``items``; label, columns: templates, as :mod:`omsm_ros.messages` has them.

    columns: name → template of its cells
    """
    templates = (label, *columns.values())
    rows = [tuple(text_from(template, item) for template in templates) for item in items]
    return Table(title, tuple(columns), rows)


def known_rows(rows: Iterable[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Return the rows that have something in the first column after their label."""
    return [row for row in rows if row[1] != NOTHING]


def part(mapping: Mapping[str, Any], *path: str) -> Any:
    """Return the value at ``path`` in nested mappings, None if it is missing."""
    found: Any = mapping
    for key in path:
        found = found.get(key) if isinstance(found, Mapping) else None
    return found


def budget_table(summary: Mapping[str, object]) -> Table:
    """Return the sources, with their names in SOURCES.yaml, the largest first, others in a row."""
    rows: Sequence[Mapping[str, Any]] = part(summary, "budget", "sources") or ()
    known = [row for row in rows if row["status"] != _OPEN]
    known.sort(key=lambda row: -(row["height"] or 0.0))
    heights = column([row["height"] for row in known], "m")
    ordered = [_budget_row(row, height) for row, height in zip(known, heights, strict=True)]
    if missing := [f"{r['says']} ({r['source']})" for r in rows if r["status"] == _OPEN]:
        ordered.append((_OPEN, NOTHING, NOTHING, NOTHING, "; ".join(missing)))
    return Table(
        "Uncertainty of the heights, k = 1, rms over the scan",
        ("of the source", "of the heights", "correlation", "basis"),
        ordered,
        prose="basis",
    )


def _budget_row(row: Mapping[str, Any], height: str) -> tuple[str, ...]:
    size = row["standard_uncertainty"]
    known = f"{row['status']}: {row['reason']}" if row["reason"] else row["status"]
    return (
        f"{row['says']} ({row['source']})",
        NOTHING if row["source"] in OF_CALIBRATION else sized(size, row["unit"], 2),
        height,
        "none" if row["kind"] == "random" else "all points",
        known,
    )


def sized(size: object, unit: str, digits: int = 3) -> str:
    """Return a size in its unit; without a unit it has no SI prefix, and zero is ``none``."""
    if number(size) == 0:
        return "none"
    if unit == "1":
        return plain(size, digits)
    return quantity(size, unit, digits)


def sample_table(summary: Mapping[str, object]) -> Table:
    """Return the account of the samples of every stream."""
    streams: Mapping[str, Any] = part(summary, "samples") or {}
    reasons = dict.fromkeys(r for s in streams.values() for r in part(s, "counted") or {})
    rows = [("received", *(count(part(s, "received")) for s in streams.values()))]
    rows.append(("corrected", *(count(part(s, "corrected")) for s in streams.values())))
    for reason in reasons:
        cells = (count((part(s, "counted") or {}).get(reason, 0)) for s in streams.values())
        rows.append((reason.replace("_", " "), *cells))
    if any(part(s, "pending") for s in streams.values()):
        rows.append(("still pending", *(count(part(s, "pending")) for s in streams.values())))
    return Table("Samples", tuple(streams), rows if streams else ())


def latency_text(calibration: Calibration) -> str:
    """Return the latency in the lag, and its source."""
    latency = calibration.latency
    if latency.share is None:
        return f"unknown ({latency.source})"
    return f"{measured(latency.delay_s, latency.uncertainty_s, 's')} ({latency.source})"


def calibration_table(calibration: Calibration) -> Table:
    """Return the main figures of a calibration; its certificate has the others."""
    certificate, dynamics = calibration.certificate, calibration.dynamics
    response = certificate.response
    gain = measured(calibration.static_gain, certificate.static_gain.uncertainty, digits=6)
    delay = measured(dynamics.low_frequency_delay, response.low_frequency_delay_uncertainty_s, "s")
    rows = [
        ("verdict", certificate.verdict or NOTHING),
        ("valid up to", quantity(calibration.valid_up_to, "Hz")),
        ("static gain, probe per encoder", gain),
        ("low-frequency delay", delay),
        ("latency of the probe in it", latency_text(calibration)),
        ("sample period", quantity(calibration.sample_period, "s")),
        ("id", calibration.id[:16]),
    ]
    return Table("Calibration", (), known_rows(rows))


def mapping_table(title: str, values: Mapping[str, object]) -> Table:
    """Return a mapping of JSON values, one row per key."""
    rows = [
        (str(k), v if isinstance(v, str) else json.dumps(v, ensure_ascii=False, default=str))
        for k, v in values.items()
    ]
    return Table(title, (), rows)
