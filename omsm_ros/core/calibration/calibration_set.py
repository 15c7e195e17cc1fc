"""One machine, calibrated at several places: its dynamics vary along X, Z or B.

The set stands wherever a calibration does. Where one response is asked for (a prediction, a page)
it is that of the member nearest to the middle; a correction goes from member to member.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from omsm_ros.core.calibration.calibration import (
    ENTRY,
    REJECTED,
    Calibration,
    Latency,
    latency_of,
    latency_share_of,
    unresolved_latency,
    verdict_of,
)
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.errors import CalibrationError
from omsm_ros.quantities import POSITION, TABLE_ANGLE

SET_SCHEMA = "omsm-calibration-set/1"
AXES = ("x", "z", "b")
# Every 13 mm of a travel of 250 mm; each costs its filter at every sample.
MOST_MEMBERS = 20
# Noise of the encoder at the last place, and a path that ends there, are not beyond it.
_MARGIN = 0.01


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibrationSet(Calibration):
    """Calibrations of one machine at ``positions`` along one axis.

    along: "x", "z" or "b";  positions: increasing [m], of b [rad];  members: one at each

    Made by :func:`calibration_set`.
    """

    along: str
    positions: tuple[float, ...]
    members: tuple[Calibration, ...]

    def content(self) -> dict[str, object]:
        """Return the set as JSON values, without its id."""
        return {
            "schema": SET_SCHEMA,
            "along": self.along,
            "members": [
                {"position": position, "calibration": {"id": c.id, **c.content()}}
                for position, c in zip(self.positions, self.members, strict=True)
            ],
            "certificate": dict(self.certificate),
        }

    def covered(self, position: FloatArray) -> BoolArray:
        """Return which of ``position`` (n,) [m], [rad] lie within the range that was calibrated."""
        first, last = self.positions[0], self.positions[-1]
        margin = _MARGIN * (last - first)
        within = (position >= first - margin) & (position <= last + margin)
        return np.asarray(within, np.bool_)

    def weights(self, position: FloatArray) -> FloatArray:
        """Return the weight of each member (m, n) at ``position`` (n,); they add up to one.

        Each is one at its own place and falls linearly to zero at its neighbours'.
        """
        unit = np.eye(len(self.positions))
        return np.array([np.interp(position, self.positions, row) for row in unit])


def calibration_set(
    along: str,
    placed: Sequence[tuple[float, Calibration]],
    certificate: Mapping[str, object] | None = None,
) -> CalibrationSet:
    """Return the set of calibrations at their places [m], of b [rad].

    certificate: of the set; None makes it of the members'

    Raises CalibrationError for members that are too few, too many, at one place, or of different
    sample periods, polarities or settings.
    """
    if along not in AXES:
        raise CalibrationError(f"a set along {along!r}, expected one of {', '.join(AXES)}")
    if not 2 <= len(placed) <= MOST_MEMBERS:
        raise CalibrationError(
            f"a set of {len(placed)} calibrations, expected 2 to {MOST_MEMBERS}; calibrate at "
            "both ends of the range at least"
        )
    quantity = TABLE_ANGLE if along == "b" else POSITION
    for position, _ in placed:
        quantity.checked(position, CalibrationError, along)
    ordered = sorted(placed, key=lambda pair: pair[0])
    positions = tuple(float(position) for position, _ in ordered)
    members = tuple(calibration for _, calibration in ordered)
    if len(set(positions)) < len(positions):
        raise CalibrationError(
            f"two calibrations stand at one {along}: {positions!r}; give each a place of its own"
        )
    _check_alike(members)
    middle = members[_nearest_to_middle(positions)]
    return CalibrationSet(
        dynamics=middle.dynamics,
        static_gain=float(np.mean([c.static_gain for c in members])),
        sample_period=middle.sample_period,
        valid_up_to=min(c.valid_up_to for c in members),
        covariance=middle.covariance,
        settings=middle.settings,
        certificate=_certificate(middle, members) if certificate is None else certificate,
        along=along,
        positions=positions,
        members=members,
    )


def _nearest_to_middle(positions: Sequence[float]) -> int:
    middle = (positions[0] + positions[-1]) / 2
    return int(np.argmin([abs(position - middle) for position in positions]))


def _check_alike(members: Sequence[Calibration]) -> None:
    first = members[0]
    for other in members[1:]:
        for what, one, two in (
            ("sample_period", first.sample_period, other.sample_period),
            ("polarity", first.certificate.get("polarity"), other.certificate.get("polarity")),
            ("settings", dict(first.settings), dict(other.settings)),
        ):
            if one != two:
                raise CalibrationError(
                    f"{what} of a set's members is {one!r} and {two!r}; calibrate every place alike"
                )


def _certificate(middle: Calibration, members: Sequence[Calibration]) -> dict[str, object]:
    """Return what holds for all: the worst verdict, the largest uncertainties."""
    found = dict(middle.certificate)
    verdicts = [verdict_of(c) for c in members]
    rejected = [verdict for verdict in verdicts if verdict[0] == REJECTED]
    silent = [verdict for verdict in verdicts if not verdict[0]]
    found["verdict"] = (rejected or silent or [verdict_of(middle)])[0][0]
    found["reasons"] = [*dict.fromkeys(text for _, texts in verdicts for text in texts)]
    if not found["verdict"]:
        del found["verdict"]
    for key in ("noise_m", "motion_error_m", "valid_from"):
        sizes = [c.certificate.get(key) for c in members]
        known = [float(size) for size in sizes if isinstance(size, int | float)]
        if known:
            found[key] = max(known)
    gains = [c.static_gain for c in members]
    own = max(c.static_gain_uncertainty for c in members)
    found["static_gain_uncertainty"] = float(np.hypot(own, np.ptp(gains) / np.sqrt(12.0)))
    found[ENTRY] = _latency(members).entry()
    return found


def _latency(members: Sequence[Calibration]) -> Latency:
    """Return the latency of the probe, which is one wherever the slides stand."""
    each = [latency_of(c) for c in members]
    lag = max((c.dynamics.low_frequency_delay for c in members), key=abs)
    if not all(latency.resolved for latency in each):
        return unresolved_latency(lag)
    delays = [latency.delay_s for latency in each]
    spread = float(np.ptp(delays) / np.sqrt(12.0))
    mean = float(np.mean(delays))
    own = max(latency.uncertainty_s or 0.0 for latency in each)
    return Latency(
        delay_s=mean,
        uncertainty_s=float(np.hypot(own, spread)),
        beside_z_s=float(np.hypot(max(latency.beside_z_s for latency in each), spread)),
        share=latency_share_of(mean, lag),
        source=each[0].source,
        reason="; ".join(dict.fromkeys(latency.reason for latency in each)),
    )


def set_from_content(content: Mapping[str, Any], members: Sequence[Calibration]) -> CalibrationSet:
    """Return the inverse of :meth:`CalibrationSet.content`, of members read already."""
    places = [float(member["position"]) for member in content["members"]]
    placed = list(zip(places, members, strict=True))
    return calibration_set(content["along"], placed, content["certificate"])
