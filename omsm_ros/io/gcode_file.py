"""G-code of step tests and scans, in the dialect of a controller.

Only ``linuxcnc`` has run on its controller. The others follow the programming manuals; run them
dry first.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.kinematics.planner import PlannedPath
from omsm_ros.core.kinematics.trajectories import StepPlan
from omsm_ros.units import MICROMETRE_M, MILLIMETRE_M

# Rest at the start of a path, in which the transient of the approach decays [s].
_SETTLE_S = 0.3


@dataclass(frozen=True, kw_only=True)
class Dialect:
    """Words of a controller.

    comment, metric, dwell: patterns and words;  dwell_decimals: of its time [s]
    frame, end: first and last lines;  before_scan: path tolerance, X by radius
    measuring, measured: around what the probe measures;  c_word: of the spindle
    increments: axes that take increments in a scan; absolute angles would be reduced to one turn
    decimals: of X and Z [mm]
    note: what the controller must be set to
    """

    comment: str
    metric: str
    dwell: str
    dwell_decimals: int = 6
    frame: tuple[str, ...] = ()
    before_scan: tuple[str, ...] = ()
    measuring: tuple[str, ...] = ()
    measured: tuple[str, ...] = ()
    c_word: str = "C{}"
    increments: str = ""
    decimals: int = 7
    end: tuple[str, ...] = ("M30",)
    note: str = ""

    def remark(self, text: str) -> str:
        """Return a comment; one in brackets has capitals, and no brackets, colon or plus."""
        if self.comment == "({})":
            text = text.upper().translate(str.maketrans("();", ",,,", ":+"))
        return self.comment.format(text)

    def rest(self, time: float) -> str:
        """Return the block that waits for ``time`` [s]."""
        return self.dwell.format(f"{time:.{self.dwell_decimals}f}")


DIALECTS = {
    "linuxcnc": Dialect(
        comment="; {}",
        metric="G21",
        dwell="G4 P{}",
        before_scan=("G64 P0.0001",),
        # A digital output; config/linuxcnc/cell.hal has no target for the probe while it is off.
        measuring=("M64 P0",),
        measured=("M65 P0",),
        decimals=8,
        end=("M2",),
    ),
    "fanuc": Dialect(
        comment="({})",
        metric="G21",
        dwell="G04 X{}",  # seconds; the unit of P depends on the increment system
        dwell_decimals=3,
        frame=("%", "O0001"),
        increments="XZC",  # by G91; U, W and H are words of G-code system A
        decimals=6,
        end=("M30", "%"),
        note="G-code system B or C, increment system IS-E, X by radius",
    ),
    "siemens": Dialect(
        comment="; {}",
        metric="G710",  # G71 would leave the unit of the feed to a setting
        dwell="G4 F{}",
        before_scan=("DIAMOF", "G642", "CTOL=0.0001"),
        c_word="C=IC({})",
        increments="C",
        note="SINUMERIK 840D; C is a rotary axis, not the spindle",
    ),
    "nanotech": Dialect(
        comment="({})", metric="G71", dwell="G04 P{}", note="dwell in seconds; C in position mode"
    ),
}


def steps_gcode(plan: StepPlan, dialect: str = "linuxcnc") -> str:
    """Return a step test in millimetres: each edge a relative G1 at its mean feed, then a rest.

    Edges start at the times of the plan. Where a rest has whole milliseconds only, the move before
    it is longer by the part of a millisecond, so that the dither within the sample period stays.
    The controller limits the jerk: set its S-curve so that an edge takes ``plan.rise``.
    """
    words = DIALECTS[dialect]
    lines = [
        "step test for the identification of the measuring loop",
        f"{len(plan.starts)} edges, rise {plan.rise * 1e3:g} ms, set as S-curve time",
    ]
    # On a lathe, feeds may be per revolution until G94.
    body = [words.metric, *words.measuring, "G91", "G94"]
    step = 10.0**-words.dwell_decimals
    ends = [*plan.starts[1:], plan.duration]
    body.append(words.rest(plan.starts[0]))
    for start, height, following in zip(plan.starts, plan.heights, ends, strict=True):
        left = following - start - plan.rise
        rest = np.floor(left / step + 1e-9) * step
        feed = abs(height) / (following - start - rest) / MILLIMETRE_M * 60
        # Six digits of the feed keep a move's duration within a microsecond.
        body.append(
            f"G1 Z{height / MILLIMETRE_M:.6f} F{feed:.6g} "
            + words.remark(f"{height / MICROMETRE_M:+.3f} um")
        )
        body.append(words.rest(rest))
    return _program(words, lines, [*body, "G90", *words.measured])


def path_gcode(
    path: PlannedPath, remarks: Sequence[str], dialect: str = "linuxcnc", measures: bool = True
) -> str:
    """Return a path as segments of inverse time, in millimetres and degrees.

    Each segment takes the same time, whole cycles of the planner's servo, so C turns steadily
    whatever X and Z do.

    measures: whether the probe measures along the path
    """
    words = DIALECTS[dialect]
    digits = words.decimals
    places = [np.round(v / MILLIMETRE_M, digits) for v in (path.x, path.z)]
    places.append(np.round(np.degrees(path.c), 6))
    x, z, c = (
        np.diff(v) if axis in words.increments else v[1:]
        for axis, v in zip("XZC", places, strict=True)
    )
    per_minute = 60 / path.segment
    lines = [
        *remarks,
        f"{len(path.time)} segments of {path.segment * 1e3:g} ms, whole cycles of {path.cycle:g} s",
        f"within {path.error * 1e9:.3g} nm of the path if C reaches its speed in a cycle: set its",
        f"largest acceleration to {np.degrees(path.c_acceleration):.0f} deg/s2",
    ]

    body = [words.metric, "G90", "G94", *words.before_scan, f"G0 X{places[0][0]:.{digits}f}"]
    body += [f"G0 Z{places[1][0]:.{digits}f} C{places[2][0]:.5f}", words.rest(_SETTLE_S)]
    body += [*(words.measuring if measures else ()), "G93"]
    body += ["G91"] if "X" in words.increments else []
    body += [
        f"G1 X{a:.{digits}f} Z{b:.{digits}f} {words.c_word.format(f'{d:.6f}')} F{per_minute:.4f}"
        for a, b, d in zip(x, z, c, strict=True)
    ]
    return _program(words, lines, [*body, "G90", "G94", *(words.measured if measures else ())])


def _program(words: Dialect, remarks: list[str], body: list[str]) -> str:
    noted = [*remarks, *filter(None, [words.note])]
    return "\n".join([*words.frame, *map(words.remark, noted), *body, *words.end]) + "\n"
