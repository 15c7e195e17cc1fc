"""May these heights be relied on, to the accuracy asked for? Green, amber or red, with reasons.

Green says that everything which can spoil a scan was looked at and is small enough; amber that
something was not; red that something is known to be too large or wrong. Every reason names what
can be done about it at the machine.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from omsm_ros.core.correction.machine_sources import RANDOM, MachineSources
from omsm_ros.core.correction.uncertainty import SCAN_SCATTER
from omsm_ros.core.dynamics.calibration import REJECTED, Calibration, verdict_of
from omsm_ros.core.dynamics.latency import REMEDY, latency_of
from omsm_ros.readable import quantity

GREEN, AMBER, RED = "green", "amber", "red"

# A source this much smaller than what is asked for adds a twentieth to it in squares.
_SETTLED_SHARE = 1 / 3
# Light and texture of the part explain less than a fifth more of noise.
_NOISIER = 1.2
POSE = ("tilt", "decentre", "clocking")
# Of each group one statement will do: zero, with a reason, where it is known not to matter.
_GROUPS: Mapping[str, tuple[tuple[str, ...], str]] = {
    "drift": (
        ("drift", "drift_rate", "drift_walk"),
        "hold the probe on one place of the part for as long as the scan takes, or scan twice, "
        "and state drift, drift_rate or drift_walk",
    ),
    "centre of the spindle": (
        ("centre_x",),
        "scan a reference sphere, run 'omsm align', and state centre_x with its uncertainty",
    ),
    "spindle": (
        ("spindle_axial", "spindle_radial", "spindle_tilt"),
        "measure its error motion with a ball and a capacitive sensor, and state spindle_axial",
    ),
    "straightness of X": (
        ("straightness_x",),
        "scan an optical flat along X, and state straightness_x",
    ),
    "linearity of the probe": (
        ("probe_linearity", "probe_periodic"),
        "step Z through the probe's range on a flat, and state probe_linearity",
    ),
    "slope error of the probe": (
        ("probe_slope", "probe_slope_square"),
        "scan a reference sphere, and state probe_slope",
    ),
    "scale of Z": (
        ("encoder_scale",),
        "compare Z with a laser interferometer, or take it from the scale's certificate, and "
        "state encoder_scale",
    ),
    "vibration": (
        ("vibration",),
        "hold the probe on the axis of the turning part for some turns, and state vibration, the "
        "rms of what does not repeat with the turn",
    ),
    "change since the step test": (
        ("lag_change",),
        "repeat the step test after the scan, run 'omsm compare' on both, and state lag_change, "
        "by how much their lags differ",
    ),
    "pitch of Z": (
        ("pitch",),
        "measure it with an autocollimator along Z, give the arm in the geometry, and state pitch",
    ),
}


@dataclass(frozen=True)
class Reason:
    """What stands against green;  remedy: what to do about it at the machine, or nothing."""

    what: str
    remedy: str = ""

    def __str__(self) -> str:
        return f"{self.what}: {self.remedy}" if self.remedy else self.what


@dataclass(frozen=True)
class Light:
    """level: GREEN, AMBER or RED;  word: for the reader;  reasons: all that speaks against green.

    accuracy: that it is held against, k = 2 [m];  uncertainty: of what all heights share, k = 2,
        rms over the scan [m]
    """

    level: str
    word: str
    accuracy: float
    uncertainty: float
    reasons: tuple[Reason, ...]

    def entry(self) -> dict[str, Any]:
        """Return the JSON values of ``summary.json``."""
        return asdict(self)


def light_of(
    calibration: Calibration,
    heights: Mapping[str, float],
    stated: MachineSources,
    *,
    accuracy: float | None = None,
    pose_open: Sequence[str] = POSE,
    registered: bool = False,
    doubts: Iterable[Reason] = (),
) -> Light:
    """Return the light of a scan.

    heights: standard uncertainty of the heights from each systematic source, rms [m]
    accuracy: asked for, k = 2 [m]; None takes the uncertainty that is stated
    pose_open: sources of the part's pose that count; none where it is not compared with a nominal
        surface, or is fitted to it
    registered: whether others of the pose's freedoms are fitted to the nominal surface
    doubts: what else speaks against it
    """
    uncertainty = 2 * sum(size**2 for size in heights.values()) ** 0.5
    asked = uncertainty if accuracy is None else accuracy
    verdict, reasons = verdict_of(calibration)
    if verdict == REJECTED:
        found = [Reason("the calibration was rejected", "identify again"), *map(Reason, reasons)]
        return _light(RED, calibration, asked, uncertainty, found)
    open_ = [
        *_latency(calibration, heights, accuracy),
        *_not_settled(stated, pose_open, registered),
    ]
    if not verdict:
        open_.insert(0, Reason("the calibration has no certificate", "identify again"))
    if uncertainty > asked:
        largest = max(heights, key=lambda name: heights[name])
        too_large = Reason(
            f"uncertainty {quantity(uncertainty, 'm')} (k = 2) exceeds the accuracy of "
            f"{quantity(asked, 'm')} asked for",
            f"begin with {largest.replace('_', ' ')}, which alone makes "
            + quantity(2 * heights[largest], "m"),
        )
        return _light(RED, calibration, asked, uncertainty, [too_large, *open_, *doubts])
    open_ += doubts
    return _light(AMBER if open_ else GREEN, calibration, asked, uncertainty, open_)


def noisier(budget: Mapping[str, float]) -> Iterator[Reason]:
    """Yield a reason where readings scatter by more than is stated of them.

    budget: rms of the heights by each source [m]
    """
    variances = {name: budget.get(name, 0.0) ** 2 for name in RANDOM}
    beyond = variances.pop(SCAN_SCATTER)
    stated = sum(variances.values())
    if stated > 0 and stated + beyond > _NOISIER**2 * stated:
        yield Reason(
            f"heights of this scan scatter by {quantity((stated + beyond) ** 0.5, 'm')}, "
            f"{quantity(stated**0.5, 'm')} by what is stated of single readings",
            "compare exposure, intensity and vibration with those of the step test; where the "
            "scan is as it should be, state probe_noise",
        )


def _light(
    level: str, calibration: Calibration, asked: float, uncertainty: float, reasons: list[Reason]
) -> Light:
    supported = f"supported by data up to {quantity(calibration.valid_up_to, 'Hz')}"
    word = {
        GREEN: f"{supported}, to {quantity(asked, 'm')} (k = 2)",
        AMBER: f"{supported}, but not everything was looked at",
        RED: "not supported by data",
    }[level]
    return Light(level, word, asked, uncertainty, tuple(reasons))


def _latency(
    calibration: Calibration, heights: Mapping[str, float], accuracy: float | None
) -> Iterator[Reason]:
    if latency_of(calibration).resolved:
        return
    share = 2 * heights.get("lateral_lag", 0.0)
    if accuracy is None or share > _SETTLED_SHARE * accuracy:
        what = (
            "any part of the lag may be latency of the probe, which makes "
            f"{quantity(share, 'm')} (k = 2)"
        )
        yield Reason(what, REMEDY)


def _not_settled(
    stated: MachineSources, pose_open: Sequence[str], registered: bool
) -> Iterator[Reason]:
    missing = [name for name in pose_open if not stated.of(name)]
    if missing:
        yield Reason(
            f"pose of the part not evaluated ({', '.join(missing)})",
            "these are held; state them, or fit them too (--fit auto)"
            if registered
            else "register the part to its nominal surface (--fit auto, or 'omsm form'), or state "
            "them",
        )
    for group, (names, remedy) in _GROUPS.items():
        if not any(stated.of(name) for name in names):
            yield Reason(f"{group} not evaluated", remedy)
