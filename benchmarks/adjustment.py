"""Adjust scans of independent machines, and compare with the truth: is a green verdict true?

The machines are those of :mod:`benchmarks.worlds`, which share no code with the product.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.row import Row, at_least, at_most, shown
from benchmarks.worlds.catalogue import KINDS
from benchmarks.worlds.machine import Recording
from benchmarks.worlds.part import slopes
from benchmarks.worlds.world import World
from omsm_ros.core.adjustment import Adjustment, FormMap, ScanData, Source, adjust
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.machine_sources import MachineSources, StatedSource
from omsm_ros.core.correction.surface_points import join_points
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock, Status
from omsm_ros.core.streams.motion_record import assemble
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.core.surface.zernike_terms import terms_up_to, zernike_values
from omsm_ros.errors import OmsmError
from omsm_ros.pipelines.adjust import priors_of

_PERIOD_S, _BLOCK = 1e-3, 20_000
# The pose of the part on the chuck is no error of its form.
REMOVED = ("piston", "tip", "tilt", "x", "y", "clocking")
QUICK = ((30.0, "in", 0.0), (60.0, "out", 0.0))
FULL = (*QUICK, (60.0, "out", np.deg2rad(80.0)))
# Figures beyond three standard uncertainties and 5 nm are wrong.
_WRONG_SIGMAS, _WRONG_M = 3.0, 5e-9


@dataclass(frozen=True)
class Outcome:
    """Verdict on one machine, compared with the truth.

    verdict: code;  refused: True if step test or scans were refused
    deviates: of PV, rms, and the terms of degree 2 to 4, from the truth over their standard
        uncertainty
    wrong: a figure is off by more than three standard uncertainties and 5 nm
    named: families that were refuted;  pv_expanded: U of PV [m]
    """

    verdict: str
    refused: bool = False
    deviates: tuple[float, ...] = ()
    wrong: bool = False
    named: tuple[str, ...] = ()
    pv_expanded: float = float("nan")


def blocks_of(made: Recording) -> Iterator[tuple[AxisBlock, DistanceBlock]]:
    """Yield the channels of a recording as blocks of both streams."""
    count = np.round((made.t - made.t[0]) / _PERIOD_S).astype(np.int64)
    starts = np.flatnonzero(np.diff(count, prepend=count[0] - 2) != 1)
    for first, last in zip(starts, [*starts[1:], len(count)], strict=True):
        for begin in range(first, last, _BLOCK):
            part = slice(begin, min(begin + _BLOCK, last))
            head = {
                "stamp_ns": int(made.t[begin] * 1e9),
                "first_sample": int(count[begin]),
                "sample_period": _PERIOD_S,
            }
            zero = np.zeros(part.stop - part.start)
            axes = AxisBlock(**head, x=made.x[part], y=zero, z=made.z[part], b=zero, c=made.c[part])
            status = np.where(np.isfinite(made.distance[part]), Status.OK, Status.NO_TARGET)
            yield (
                axes,
                DistanceBlock(**head, distance=made.distance[part], status=status.astype(np.uint8)),
            )


def calibrated(world: World) -> Calibration:
    """Identify the world's step test; raise OmsmError where it is refused."""
    pairs = list(blocks_of(world.step_test()))
    found = identify(assemble([a for a, _ in pairs], [d for _, d in pairs])).calibration
    return found


def scan_data(
    made: Recording, calibration: Calibration, latency: float, begin: float, clocking: float
) -> ScanData:
    """Correct one scan, and return it as the adjustment takes it."""
    corrector = Corrector(calibration, CorrectionOptions(probe_latency=latency))
    parts = []
    for axes, distance in blocks_of(made):
        corrector.push_axes(axes)
        corrector.push_distance(distance)
        parts.append(corrector.take())
    parts.append(corrector.finish())
    points = join_points(parts)
    count = np.round((made.t - made.t[0]) / _PERIOD_S).astype(np.int64)
    at = np.searchsorted(count, points.sample)
    return ScanData(
        time=begin + points.sample * _PERIOD_S,
        x=points.x,
        y=points.y,
        height=points.height,
        distance=points.height - made.z[at] + points.dynamic_error,
        motion=made.z[at],
        removed=points.dynamic_error,
        c=made.c[at],
        # The worlds turn the part right-handed about the axis towards the probe.
        clocking=clocking,
        clamping=int(clocking != 0.0),
    )


def declared_of(world: World) -> tuple[tuple[Source, ...], float]:
    """Return the priors that the shop states, and the declared latency [s]."""
    stated = world.declared()
    own = {"source", "value", "how", "reason", "distribution"}
    sources = [
        StatedSource(
            **{k: v for k, v in row.items() if k in own},
            parameters={k: v for k, v in row.items() if k not in own | {"unit"}},
        )
        for row in stated["sources"]
    ]
    priors = priors_of(MachineSources(tuple(sources)), float(stated["abbe_arm"]))
    return priors, float(stated["latency"])


def adjusted(world: World, plan: Sequence[tuple[float, str, float]]) -> Adjustment:
    """Return the adjustment of the scans ``plan`` of a world, as its shop would make it."""
    calibration = calibrated(world)
    priors, latency = declared_of(world)
    data, begin = [], 0.0
    for (_, _, clocking), made in zip(plan, world.scans(plan), strict=True):
        data.append(scan_data(made, calibration, latency, begin, clocking))
        begin = data[-1].time[-1] + 20.0
    return adjust(data, priors, calibration=calibration, nominal=PAPER_MIRROR, removed=REMOVED)


def _true_form(world: World, radius: float) -> tuple[np.ndarray, ...]:
    """Return x, y [m], share of the area, and deviation along Z without the pose ``REMOVED`` [m].

    radius: of the places [m]; those on the rim have no area
    """
    nodes, weights = np.polynomial.legendre.leggauss(160)
    root, angle = np.sqrt((nodes + 1) / 2), 2 * np.pi * np.arange(360) / 360
    r = radius * np.append(root, 1.0)[:, np.newaxis]
    x, y = (r * np.cos(angle)).ravel(), (r * np.sin(angle)).ravel()
    area = np.repeat(np.append(weights / (2 * len(angle)), 0.0), len(angle))
    height = world.part.deviation(x, y)
    along_x, along_y = slopes(world.nominal.height, x, y)
    pose = np.stack([np.ones(len(x)), x, y, along_x, along_y, along_x * y - along_y * x], axis=1)
    pose /= np.max(np.abs(pose), axis=0)
    weight = np.sqrt(area)
    fitted = np.linalg.lstsq(pose * weight[:, np.newaxis], height * weight, rcond=1e-9)[0]
    return x, y, area, height - pose @ fitted


def true_figures(world: World) -> tuple[float, float]:
    """Return PV and rms of the part's deviation along Z, the pose ``REMOVED`` taken away [m]."""
    _, _, area, left = _true_form(world, world.radius)
    return float(np.ptp(left)), float(np.sqrt(area @ left**2))


def _terms_against_truth(world: World, form: FormMap) -> list[tuple[float, float]]:
    """Return error and standard uncertainty of each term of degree 2 to 4, as rms [m]."""
    x, y, area, true = _true_form(world, form.disc.radius)
    terms = terms_up_to(8)
    values = zernike_values(*form.disc.scaled(x, y), terms).T
    kept = [k for k, term in enumerate(terms) if term in form.terms]
    root = np.sqrt(area)
    fitted = np.linalg.lstsq(values * root[:, np.newaxis], root * true, rcond=1e-6)[0][kept]
    size = np.sqrt(area @ values[:, kept] ** 2)
    spread = np.sqrt(np.maximum(np.diag(form.term_covariance), 0.0))
    return list(zip(size * (form.coefficients - fitted), size * spread, strict=True))


def outcome(world: World, plan: Sequence[tuple[float, str, float]]) -> Outcome:
    """Adjust the scans of a world, and hold the result against its truth."""
    try:
        found = adjusted(world, plan)
    except OmsmError:
        return Outcome("refused", refused=True)
    form = found.form
    pairs = [
        (one.value - true, one.uncertainty)
        for one, true in zip((form.pv, form.rms), true_figures(world), strict=True)
    ]
    pairs += _terms_against_truth(world, form)
    deviates = tuple(float(off / u) if u > 0 else np.inf for off, u in pairs)
    wrong = any(abs(off) > _WRONG_SIGMAS * u and abs(off) > _WRONG_M for off, u in pairs)
    return Outcome(
        found.verdict.code,
        deviates=deviates,
        wrong=wrong,
        named=tuple(r.name for r in found.refutations),
        pv_expanded=2 * form.pv.uncertainty,
    )


def rows(full: bool) -> Iterator[Row]:
    """Every study; few machines of each unless ``full``."""
    seeds = range(100) if full else range(6)
    good = [outcome(World(seed=seed), QUICK) for seed in seeds]
    yield at_least("two scans of a good machine: verified",
                   float(np.mean([o.verdict == "verified" for o in good])), "1", 0.95,
                   runs=len(good))  # fmt: skip
    deviates = np.array([o.deviates for o in good if o.deviates])
    yield at_least(
        "PV, rms and terms within k = 2", float(np.mean(np.abs(deviates) < 2)), "1", 0.93
    )
    yield at_most("U of PV, median", float(np.median([o.pv_expanded for o in good])), "m", 25e-9)
    kinds = [k for k, row in KINDS.items() if row.group not in ("benign",)]
    chosen = kinds if full else kinds[::8]
    for name, plan in (("one scan", QUICK[:1]), ("two scans", QUICK)):
        found = [outcome(World(kind=k, size=2, seed=7), plan) for k in chosen]
        green = [o.verdict == "verified" for o in found]
        wrong = [g and o.wrong for g, o in zip(green, found, strict=True)]
        yield at_most(f"{name} of disturbed machines: green and wrong", float(np.mean(wrong)), "1",
                      0.01 if plan is QUICK else 0.0, runs=len(found))  # fmt: skip
        yield shown(f"{name} of disturbed machines: green", float(np.mean(green)), "1")
        within = np.concatenate([np.abs(o.deviates[2:]) < 2 for o in found if o.deviates])
        yield at_least(f"{name} of disturbed machines: terms within k = 2", float(np.mean(within)),
                       "1", 0.93)  # fmt: skip
