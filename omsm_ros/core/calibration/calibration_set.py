"""One machine, calibrated at several places: its dynamics vary along X, Z or B.

A set may be used wherever a calibration may. Where one response is needed (a prediction, a page),
it is that of the member nearest to the middle; a correction interpolates between members.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from omsm_ros.core.calibration.calibration import Calibration, certificate_from_content
from omsm_ros.core.calibration.certificate import REJECTED, Certificate
from omsm_ros.core.calibration.latency import Latency, latency_share_of, unresolved_latency
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.errors import CalibrationError
from omsm_ros.quantities import POSITION, TABLE_ANGLE

SET_SCHEMA = "omsm-calibration-set/2"
SET_SCHEMA_1 = "omsm-calibration-set/1"
AXES = ("x", "z", "b")
# Every 13 mm of a travel of 250 mm; each costs its filter at every sample.
MOST_MEMBERS = 20
# A path that ends at the last place may exceed it by the noise of the encoder.
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
            "certificate": self.certificate.content(),
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
    along: str, placed: Sequence[tuple[float, Calibration]], certificate: Certificate | None = None
) -> CalibrationSet:
    """Return the set of calibrations at their places [m], of b [rad].

    certificate: of the set; None combines those of the members

    Raises CalibrationError for members that are too few, too many, at one place, or of different
    sample periods, polarities or settings.
    """
    if along not in AXES:
        raise CalibrationError("calibration.set_axis", axis=repr(along), known=", ".join(AXES))
    if not 2 <= len(placed) <= MOST_MEMBERS:
        raise CalibrationError("calibration.set_size", count=len(placed), most=MOST_MEMBERS)
    quantity = TABLE_ANGLE if along == "b" else POSITION
    for position, _ in placed:
        quantity.checked(position, CalibrationError, along)
    ordered = sorted(placed, key=lambda pair: pair[0])
    positions = tuple(float(position) for position, _ in ordered)
    members = tuple(calibration for _, calibration in ordered)
    if len(set(positions)) < len(positions):
        raise CalibrationError("calibration.set_places", axis=along, positions=repr(positions))
    _check_alike(members)
    half = (positions[0] + positions[-1]) / 2
    middle = members[int(np.argmin([abs(position - half) for position in positions]))]
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


def _check_alike(members: Sequence[Calibration]) -> None:
    first, *others = (
        {
            "sample_period": c.sample_period,
            "polarity": c.certificate.static_gain.polarity,
            "settings": dict(c.settings),
        }
        for c in members
    )
    for other in others:
        for what, value in first.items():
            if value != other[what]:
                raise CalibrationError(
                    "calibration.set_differs", what=what, first=repr(value), other=repr(other[what])
                )


def _certificate(middle: Calibration, members: Sequence[Calibration]) -> Certificate:
    every = [c.certificate for c in members]
    own = middle.certificate
    rejected = any(c.verdict == REJECTED for c in every)
    silent = any(c.verdict is None for c in every)
    reasons = [finding for c in every for finding in c.reasons]
    kept = [*own.reservations, *own.warnings]
    gains = [c.static_gain for c in members]
    largest = max(c.static_gain_uncertainty for c in members)
    return replace(
        own,
        verdict=REJECTED if rejected else None if silent else own.verdict,
        findings=tuple(f for i, f in enumerate(reasons) if f not in reasons[:i]) + tuple(kept),
        residual=replace(own.residual, noise_m=_largest(c.residual.noise_m for c in every)),
        model_errors=replace(
            own.model_errors, motion_error_m=_largest(c.model_errors.motion_error_m for c in every)
        ),
        validity=replace(own.validity, from_hz=_largest(c.validity.from_hz for c in every)),
        static_gain=replace(
            own.static_gain, uncertainty=float(np.hypot(largest, np.ptp(gains) / np.sqrt(12.0)))
        ),
        latency=_latency(members),
    )


def _largest(values: Iterable[float | None]) -> float | None:
    return max((value for value in values if value is not None), default=None)


def _latency(members: Sequence[Calibration]) -> Latency:
    each = [c.latency for c in members]
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
        unshared_s=float(np.hypot(max(latency.unshared_s for latency in each), spread)),
        share=latency_share_of(mean, lag),
        source=each[0].source,
        reason="; ".join(dict.fromkeys(latency.reason for latency in each)),
    )


def set_from_content(content: Mapping[str, Any], members: Sequence[Calibration]) -> CalibrationSet:
    """Return the inverse of :meth:`CalibrationSet.content`, of members read already."""
    places = [float(member["position"]) for member in content["members"]]
    placed = list(zip(places, members, strict=True))
    certificate = certificate_from_content(content["certificate"])
    return calibration_set(content["along"], placed, certificate)
