"""Record calibrations and measurements in a catalogue, and evaluate the drift of each machine."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.trend import LinearTrend, trend
from omsm_ros.errors import FileError, OmsmError
from omsm_ros.io import bags, json_and_yaml
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.catalogue import MOST_ROWS, Catalogue, time_of
from omsm_ros.io.files import SUMMARY, read_text
from omsm_ros.io.folders import MAX_RESULT_BYTES
from omsm_ros.quantities import COUNTER, SIGNAL
from omsm_ros.report.verdict import verdict_text

_TABLES = ("calibrations", "measurements")


def keep_calibration(
    address: str,
    calibration: Calibration,
    path: Path,
    source: Path | None = None,
    recorded_ns: int | None = None,
) -> bool:
    """Add a calibration, its file and its bag; return False if the catalogue has it already.

    recorded_ns: when the bag was recorded [ns, ROS time]; None: read it from the bag ``source``
    """
    row = {
        "id": calibration.id,
        "recorded_at": time_of(recorded_ns or _recorded(source)),
        "machine": _machine(calibration.settings),
        "verdict": verdict_text(calibration),
        "path": str(path.absolute()),
        "source": "" if source is None else str(source.absolute()),
        "settings": json_and_yaml.text_of(dict(calibration.settings)),
        "static_gain": float(calibration.static_gain),
        "static_gain_uncertainty": calibration.certificate.static_gain.uncertainty,
        "delay": float(calibration.dynamics.low_frequency_delay),
        "delay_uncertainty": float(calibration.low_frequency_delay_uncertainty),
        "valid_up_to": float(calibration.valid_up_to),
        "sample_period": float(calibration.sample_period),
    }
    with Catalogue(address) as catalogue:
        return catalogue.add("calibrations", row)


def keep_measurement(address: str, folder: Path, bag: Path | None = None) -> bool:
    """Add the finished measurement in ``folder``.

    bag: its recording, if it was moved since;  return False if the catalogue has the same summary
    of the same folder already
    """
    path = folder / SUMMARY
    text = read_text(path, MAX_RESULT_BYTES, FileError, "summary")
    summary = json_and_yaml.object_of(text, FileError, f"summary {str(path)!r}")
    settings = _object(_part(summary, "settings"))
    source = bag if bag is not None else Path(str(summary.get("bag", "")))
    place = str(folder.absolute())
    row = {
        "id": hashlib.sha256(f"{place}\0{text}".encode()).hexdigest(),
        "recorded_at": time_of(_recorded(source)),
        "machine": _machine(settings),
        "bag": str(source.absolute()),
        "folder": place,
        "version": str(_part(summary, "versions", "omsm_ros") or ""),
        "settings": json_and_yaml.text_of(settings),
        "calibration": str(summary.get("calibration", "")),
        "received": _count(_part(summary, "samples", "distance", "received")),
        "corrected": _count(_part(summary, "samples", "distance", "corrected")),
        "deviation_rms": _number(_part(summary, "deviation", "corrected", "rms_area_weighted")),
        "deviation_peak_to_valley": _number(
            _part(summary, "deviation", "corrected", "peak_to_valley")
        ),
        "dynamic_error_rms": _number(_part(summary, "dynamic_error_before", "rms")),
        "uncertainty_median": _number(_part(summary, "uncertainty", "median")),
    }
    with Catalogue(address) as catalogue:
        return catalogue.add("measurements", row)


def keep(address: str, path: Path) -> bool:
    """Add a calibration file or the folder of a measurement."""
    if path.is_dir():
        return keep_measurement(address, path)
    return keep_calibration(address, load_calibration(path), path)


@dataclass(frozen=True, slots=True)
class MachineHistory:
    """Calibrations and measurements of one machine, and their linear trends.

    delay: trend of the lag [s/s];  static_gain: [1/s];  deviation: of the form's rms [m/s]; None
    for fewer than five rows
    """

    machine: str
    calibrations: list[dict[str, Any]]
    measurements: list[dict[str, Any]]
    delay: LinearTrend | None
    static_gain: LinearTrend | None
    deviation: LinearTrend | None


@dataclass(frozen=True, slots=True)
class CatalogueHistory:
    """Contents of a catalogue by machine.

    older: number of calibrations and measurements that are older than those listed; zero unless a
        table holds more than ``catalogue.MOST_ROWS``
    """

    machines: list[MachineHistory]
    older: int


def history(address: str, machine: str = "") -> CatalogueHistory:
    """Return the contents of the catalogue; of one machine, or of all."""
    older = 0
    rows: dict[str, dict[str, list[dict[str, Any]]]] = {}
    with Catalogue(address) as catalogue:
        for table in _TABLES:
            found = catalogue.rows(table, machine)
            if len(found) == MOST_ROWS:
                older += catalogue.count(table, machine) - len(found)
            for row in found:
                name = row["machine"] or ""
                rows.setdefault(name, {table: [] for table in _TABLES})[table].append(row)
    return CatalogueHistory([_of(name, **rows[name]) for name in sorted(rows)], older)


def _of(
    name: str, calibrations: list[dict[str, Any]], measurements: list[dict[str, Any]]
) -> MachineHistory:
    accepted = [row for row in calibrations if row["verdict"] != "rejected"]
    return MachineHistory(
        name, calibrations, measurements,
        _trend(accepted, "delay"), _trend(accepted, "static_gain"),
        _trend(measurements, "deviation_rms"),
    )  # fmt: skip


def _trend(rows: list[dict[str, Any]], name: str) -> LinearTrend | None:
    values = np.array([np.nan if row[name] is None else row[name] for row in rows], np.float64)
    times = np.array([_seconds(row["recorded_at"]) for row in rows], np.float64)
    return trend(times, values)


def _seconds(when: datetime | None) -> float:
    return np.nan if when is None else (when - datetime(1970, 1, 1)).total_seconds()


def _machine(settings: Mapping[str, object]) -> str:
    return str(settings.get("machine", ""))[:200]


def _number(value: object) -> float | None:
    known = isinstance(value, int | float) and abs(value) <= SIGNAL.high
    return float(value) if known else None  # type: ignore[arg-type]


def _count(value: object) -> int | None:
    return value if isinstance(value, int) and 0 <= value <= COUNTER.high else None


def _object(value: object) -> Mapping[str, object]:
    return value if isinstance(value, Mapping) else {}


def _part(content: Mapping[str, Any], *names: str) -> Any:
    found: Any = content
    for name in names:
        found = found.get(name) if isinstance(found, Mapping) else None
    return found


def _recorded(bag: Path | None) -> int | None:
    try:
        if bag is None or not bag.exists():
            return None
        with bags.BagReader(bag) as reader:
            return reader.recorded_ns
    except (FileError, OSError):
        return None


def record_in_catalogue(address: str, keep: Callable[[], bool]) -> list[str]:
    """Call ``keep`` if there is a catalogue; return a warning if that failed.

    A failing database raises nothing, because the result is in its files already.
    """
    if not address:
        return []
    try:
        keep()
    except (OmsmError, OSError) as err:
        return [f"not written into the catalogue: {err}; add it later with 'omsm history --add'"]
    return []
