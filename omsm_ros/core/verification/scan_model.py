"""What scans of one part have in common, and in what they may differ.

``h = S(P(t - τ)) + δ Dz - κ D²z + ε d + what is the scan's own``, D = d/dt, with h the height
after a correction that is to be judged: its lag is wrong by δ, its curvature (of the gain, in
s²) by κ, its static gain by the share ε, and the probe is late against the slides by τ.
Of its own each scan but the first has a drift, its clocking, and shift and tilt of the part.

To first order two speeds or directions separate ``δ - τ`` from S, for its mark grows with the
speed; a following error, or knowledge of G from a step test, separates δ from τ. Clocking leaves
the same mark as a lag at a steady speed: how well C repeats limits what is identifiable.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray, IntArray
from omsm_ros.core.verification.eliminated_surface import Portion, portions
from omsm_ros.core.verification.polar_surface import PolarBasis, spline_columns
from omsm_ros.core.verification.scan_reader import ScanColumns
from omsm_ros.errors import DataError

LAG, CURVATURE, GAIN, LATENCY = range(4)
DYNAMIC = 4
CLOCKING = 0
OWN = ("clocking", "shift_x", "shift_y", "tilt_x", "tilt_y")
# Nearer to the axis a degree is less than the spacing of points, and no harmonic is seen.
_INNER_SHARE = 0.01
# Half a millimetre on a part of 25 mm; there are at least two turns in an interval.
_MOST_INTERVALS, _TURNS_AN_INTERVAL, _LEAST_INTERVALS = 24, 2, 3
# Thermal drift, as slow as half a minute over four minutes, and slower than a few turns.
_MOST_DRIFT_INTERVALS, _TURNS_A_DRIFT = 8, 5


@dataclass(frozen=True, slots=True)
class Place:
    """Where the surface is evaluated: latency [s], and clocking of each scan [rad], (scans,)."""

    latency: float
    clocking: FloatArray


class ScanModel:
    """All points of all scans, and the columns of the parameters at each.

    Parameters: lag, curvature, gain, latency; then of each scan but the first: clocking, shift
    and tilt, and its drift over time.

    Raises DataError for fewer than two scans.
    """

    def __init__(self, scans: Sequence[ScanColumns], harmonics: int) -> None:
        if len(scans) < 2:
            raise DataError(
                f"{len(scans)} scan, expected two or more of one part, at different speeds or "
                "in opposite directions"
            )
        outer = min(float(np.max(s.radius)) for s in scans)
        inner = max(_INNER_SHARE * outer, *(float(np.min(s.radius)) for s in scans))
        if not inner < outer:
            raise DataError(
                f"the scans share no ring: one begins at a radius of {inner!r} m, another ends at "
                f"{outer!r} m; scan the same part of the surface"
            )
        within = [(s.radius >= inner) & (s.radius <= outer) for s in scans]
        if not all(map(np.any, within)):
            raise DataError(
                f"a scan has no points between radii of {inner!r} and {outer!r} m, which the scans "
                "share; scan the same part of the surface"
            )
        self.number = len(scans)
        self.scan: IntArray = np.repeat(
            np.arange(len(scans)), [np.count_nonzero(w) for w in within]
        )
        self._column = {
            name: np.concatenate([getattr(s, name)[w] for s, w in zip(scans, within, strict=True)])
            for name in ScanColumns.__dataclass_fields__
        }
        self.turns = [_turns(s) for s in scans]
        intervals = int(
            np.clip(min(self.turns) // _TURNS_AN_INTERVAL, _LEAST_INTERVALS, _MOST_INTERVALS)
        )
        self.basis = PolarBasis(inner, outer, intervals, harmonics)
        self._drifts = [_Drift.of(s, turns) for s, turns in zip(scans, self.turns, strict=True)]
        self._interval = self.basis.interval(self._column["radius"])
        self._order = np.lexsort((np.arange(len(self.scan)), self._interval))

    def __len__(self) -> int:
        return len(self.scan)

    @property
    def speeds(self) -> list[float]:
        """Median spindle speed of each scan [rad/s], with the sign of its C."""
        rate = self._column["angular_rate"]
        # The probe goes round the part against the turn of C.
        return [-float(np.median(rate[self.scan == k])) for k in range(self.number)]

    def own(self, scan: int) -> slice:
        """Return where clocking, shift and tilt of ``scan`` (1, 2, …) are among the parameters."""
        begin = DYNAMIC + sum(len(OWN) + self._drifts[k].size for k in range(1, scan))
        return slice(begin, begin + len(OWN))

    @property
    def size(self) -> int:
        """Number of parameters."""
        return int(self.own(self.number).start)

    def radius(self, part: Portion) -> FloatArray:
        """Return the radius of the points of ``part`` [m]."""
        return np.asarray(self._column["radius"][part.points])

    def angle(self, part: Portion) -> FloatArray:
        """Return the angle of the points of ``part``, on the part [rad]."""
        return np.asarray(self._column["angle"][part.points])

    def portions(self, place: Place, every: int) -> Iterator[Portion]:
        """Yield one point in ``every``, the surface's terms evaluated at ``place``."""
        column = self._column
        radius = column["radius"] - place.latency * column["radial_rate"]
        turned = place.latency * column["angular_rate"] + place.clocking[self.scan]
        angle = column["angle"] - turned
        return portions(self.basis, self._order[::every], self._interval, radius, angle)

    def columns(
        self, part: Portion, place: Place, surface: FloatArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """Return X (n, parameters) and y (n,) of the points of ``part``.

        surface: coefficients from before, for its slopes; None leaves out what needs them
        """
        column = {name: values[part.points] for name, values in self._column.items()}
        scan = self.scan[part.points]
        x = np.zeros((len(part.points), self.size))
        y = column["height"].copy()
        x[:, LAG] = column["motion_rate"]
        x[:, CURVATURE] = -column["motion_acceleration"]
        # ε d = ε (S - H(z)), and εS is a surface too.
        x[:, GAIN] = -column["motion"]
        position = column["radius"] * np.exp(1j * column["angle"])
        for k in range(1, self.number):
            mine, own = scan == k, self.own(k)
            x[mine, own.start + 3] = position.real[mine]
            x[mine, own.start + 4] = position.imag[mine]
            drift = self._drifts[k]
            x[mine, own.stop : own.stop + drift.size] = drift.columns(column["time"][mine])
        if surface is None:
            return x, y
        here = surface[self.basis.terms(part.interval)]
        radial, angular = part.rows.derivatives(here)
        x[:, LATENCY] = -(radial * column["radial_rate"] + angular * column["angular_rate"])
        # Both were taken at ``place``; with what they did there added, they are counted from zero.
        y += x[:, LATENCY] * place.latency - angular * place.clocking[scan]
        gradient = (radial + 1j * angular / column["radius"]) * position / column["radius"]
        for k in range(1, self.number):
            mine, own = scan == k, self.own(k)
            x[mine, own.start + CLOCKING] = -angular[mine]
            x[mine, own.start + 1] = -gradient.real[mine]
            x[mine, own.start + 2] = -gradient.imag[mine]
        return x, y


@dataclass(frozen=True)
class _Drift:
    """A cubic spline of time over ``duration`` [s], its constant included."""

    duration: float
    intervals: int

    @classmethod
    def of(cls, scan: ScanColumns, turns: float) -> _Drift:
        intervals = int(np.clip(turns // _TURNS_A_DRIFT, 1, _MOST_DRIFT_INTERVALS))
        return cls(float(scan.time[-1]), intervals)

    @property
    def size(self) -> int:
        return self.intervals + 3

    def columns(self, time: FloatArray) -> FloatArray:
        return spline_columns(time / self.duration * self.intervals, self.intervals)


def _turns(scan: ScanColumns) -> float:
    period = float(np.median(np.diff(scan.time)))
    turns = float(np.sum(np.abs(scan.angular_rate))) * period / (2 * np.pi)
    if not np.isfinite(turns):
        raise DataError("the pace of C is not known at every point of a scan; record it again")
    return turns
