"""What the response says of the machine, and what could hide in it: modes, masses, shape."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from omsm_ros.core.departures.families import CREEP, MODE
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.dynamics.modes import KnownMode, known_modes
from omsm_ros.readable import NOTHING, measured, number, percent, plain, quantity
from omsm_ros.report.certificate.tables import CertificateEntries, known_rows, listed, texts
from omsm_ros.report.common.tables import Table, part
from omsm_ros.units import MILLISECOND_S


def mode_table(calibration: Calibration) -> Table:
    """Return the poles as terms of Eq. 8, and whether the band reaches them."""
    modes = known_modes(calibration.dynamics, calibration.covariance)
    rows = [
        (
            f"mode {index}" if mode.residue is not None else f"real pole {index}",
            measured(mode.frequency, mode.frequency_uncertainty, "Hz"),
            *_oscillation(mode),
            "yes" if mode.frequency <= calibration.valid_up_to else "no",
        )
        for index, mode in enumerate(modes, start=1)
    ]
    columns = ("frequency", "damping ratio", "residue [1/ms²]", "within the trusted band")
    return Table("Modes (Eq. 8)", columns, rows)


def _oscillation(mode: KnownMode) -> tuple[str, str]:
    """Return the damping and residue."""
    if mode.residue is None or mode.residue_uncertainty is None:
        return "1, by definition", "none"
    residue, spread = (v * MILLISECOND_S**2 for v in (mode.residue, mode.residue_uncertainty))
    return measured(mode.damping, mode.damping_uncertainty), measured(residue, spread)


_MECHANICAL_UNITS = {"m1": "kg", "m2": "kg", "k1": "N/m", "k2": "N/m", "c1": "N·s/m", "c2": "N·s/m"}
_UNITS_PER_MASS = {
    "m2": "",
    "k1": "N/(m·kg)",
    "k2": "N/(m·kg)",
    "c1": "N·s/(m·kg)",
    "c2": "N·s/(m·kg)",
}
_PROBE_ON = {False: "second mass, not the driven one (Eq. 7)", True: "driven mass (collocated)"}


def two_mass_table(certificate: CertificateEntries) -> Table:
    """Return masses, springs and dampers, or each per mass of the table where that is not known."""
    model: Mapping[str, Any] = part(certificate, "two_mass", "model") or {}
    absolute = number(part(certificate, "two_mass", "table_mass_kg")) is not None
    rows = []
    for name, unit in (_MECHANICAL_UNITS if absolute else _UNITS_PER_MASS).items():
        value = number(part(model, name))
        relative = number(part(certificate, "two_mass", "relative_uncertainty", name))
        text = NOTHING if value is None else measured(value, (relative or 0.0) * value, unit)
        if name == "m1" and value is not None:
            text += ", as given"
        rows.append((name if absolute else f"{name} / m1", text))
    side = part(certificate, "two_mass", "collocated")
    rows += [
        ("probe on the", _PROBE_ON[side] if isinstance(side, bool) else NOTHING),
        ("misfit, over the stated uncertainty", plain(part(certificate, "two_mass", "misfit"))),
    ]
    title = "Two-mass model (Eq. 6, 7)"
    return Table(title if absolute else f"{title}, per mass of the table", (), known_rows(rows, 1))


_SHAPE_ROWS = (
    ("gain off 1 by 1 %", "bandwidth_1_percent", None),
    ("gain off 1 by 3 dB", "bandwidth_3db", None),
    ("highest peak of the gain", "resonance", "resonance_gain"),
    ("lowest dip of the gain", "minimum", "minimum_gain"),
)


def shape_table(calibration: Calibration) -> Table:
    """Return what stands out in the identified response, and whether the band reaches it."""
    certificate, trusted = calibration.certificate, calibration.valid_up_to
    rows = [
        (name, _point(certificate, place, gain), _reached(certificate, place, trusted))
        for name, place, gain in _SHAPE_ROWS
    ]
    left = number(certificate.get("modal_remainder"))
    if left is not None:
        rows.append(("not in the terms of Eq. 8, of the greatest gain", percent(left), "yes"))
    columns = ("", "within the trusted band")
    return Table("Shape of the response", columns, known_rows(rows, 1))


def _reached(certificate: CertificateEntries, place: str, trusted: float) -> str:
    at = number(part(certificate, "shape", place))
    return "" if at is None else "yes" if at <= trusted else "no"


def _point(certificate: CertificateEntries, place: str, gain: str | None) -> str:
    at = quantity(part(certificate, "shape", place), "Hz")
    if gain is None or at == NOTHING:
        return at
    return f"{plain(part(certificate, 'shape', gain), 4)} at {at}"


def _size(hidden: Mapping[str, Any]) -> str:
    """Return the largest size that was missed, in the unit of its family."""
    missed = number(hidden.get("missed"))
    if missed is None or hidden.get("family") not in (CREEP, MODE):
        return quantity(missed, "m")
    return f"{percent(missed)} of the motion"


def _family(entry: Mapping[str, Any]) -> str:
    """Return a way to depart from linear and steady, with its own time or frequency."""
    family, parameter = str(entry.get("family", NOTHING)), entry.get("parameter")
    if family == CREEP:
        return f"{family} over {quantity(parameter, 's', 2)}"
    return f"{family} at {quantity(parameter, 'Hz', 2)}" if family == MODE else family


def hidden_table(certificate: CertificateEntries) -> Table:
    """Return what this very test would have missed, and what that costs on a scan."""
    rows = [
        (
            _family(entry),
            _size(entry),
            quantity(entry.get("missed_effect_on_scan_m"), "m"),
            quantity(entry.get("effect_on_scan_m"), "m"),
        )
        for entry in listed(certificate, "could_hide")
    ]
    return Table(
        "What could hide",
        ("largest size missed", "its rms on the paper's scan", "carried in the band"),
        rows
        + known_rows(
            [
                (
                    "plateau that would tell the slowest",
                    quantity(certificate.get("plateau_that_would_tell_s"), "s"),
                    "",
                    "",
                )
            ],
            1,
        )
        + [(f"assumed: {text}", "", "", "") for text in texts(certificate, "assumed")],
    )
