"""Coverage and false alarms over many machines drawn from their own declarations.

``python test/core/adjustment/coverage.py SEEDS SCANS [PITCH_MM]`` prints them; the tests run few.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from plain_world import MIRROR, RADIUS_M, Machine

from omsm_ros.core.adjustment import Source, adjust
from omsm_ros.core.surface.zernike_terms import zernike_values

SPINDLE = {2: 12e-9, 3: 9e-9, 4: 5e-9}
STRAIGHTNESS_M, STRETCH = 2e-9, 2e-6
LATERAL_M, BEND_M, SQUARENESS_RAD, PARALLELISM_RAD = 3e-8, 1e-9, 1e-7, 1e-5
LAG_S, RAMP_M_S, DECENTRE_M, CLOCKING_RAD = 50e-6, 0.15e-9, 2e-8, 5e-7
PRIORS = (
    Source("lag_change", LAG_S),
    Source("drift_rate", RAMP_M_S),
    Source("drift_walk", 1.2e-9),
    Source("part_shift", DECENTRE_M),
    Source("part_turn", CLOCKING_RAD),
    # What a spiral to the centre does not show.
    Source("straightness_x", STRAIGHTNESS_M, evaluated=True),
    Source("straightness_z", LATERAL_M, evaluated=True),
    Source("pitch", BEND_M, evaluated=True),
    Source("lag_speed", 1e-7, evaluated=True),
    Source("squareness", SQUARENESS_RAD, evaluated=True),
    Source("parallelism", PARALLELISM_RAD, evaluated=True),
    Source("encoder_scale", STRETCH, evaluated=True),
    Source("clocking", 5e-7, evaluated=True),
    Source("probe_slope_square", 1e-8, evaluated=True),
    *(Source(f"spindle_axial/{n}", size) for n, size in SPINDLE.items()),
)
# The drawn machines do not have these; undeclared, each would count with its plausible size.
AS_DRAWN = (
    *PRIORS,
    Source("expansion", 2e-7, evaluated=True),
    Source("c_error/1", 5e-7, evaluated=True),
    Source("c_error/2", 5e-7, evaluated=True),
    Source("positioning_x", 1e-9, evaluated=True),
    Source("spindle_radial/1", 1e-9, evaluated=True),
    # One scan shows none of these.
    Source("probe_latency", 1e-7, evaluated=True),
    *(Source(f"lag_{name}", 1e-7, evaluated=True) for name in ("motion", "x", "time", "c")),
    Source("lag_curvature", 1e-9, evaluated=True),
    Source("creep", 1e-6, evaluated=True),
    Source("part_settling", 1e-9, evaluated=True),
)


def curve(random, first, last, size):
    """Return places, and a curve whose covariance is ``size``² exp(-2 (distance / range)²)."""
    place = np.linspace(first, last, 60)
    kernel = np.exp(-2 * ((place - place[:, np.newaxis]) / (last - first)) ** 2)
    return place, size * random.multivariate_normal(np.zeros(60), kernel, method="eigh")


def drawn(seed, scans, pitch=0.4e-3, **errors):
    """Return a machine whose errors are as large as declared, and scans by it."""
    random = np.random.default_rng(1000 + seed)
    spindle = [(n, *(size * random.standard_normal(2))) for n, size in SPINDLE.items()]
    slide, bow = curve(random, 0.0, RADIUS_M, STRAIGHTNESS_M)
    stretch = STRETCH * random.standard_normal()
    angle = np.linspace(0.0, 2 * np.pi, 60)
    lift = MIRROR.height(RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle))
    more = np.random.default_rng(2000 + seed)
    ways = {}
    for name in ("x_of_z", "y_of_z"):
        height, way = curve(more, min(0.0, *lift), max(lift), LATERAL_M)
        # The mean is the spindle centre, a source of its own.
        ways[name] = height, way - np.mean(way) + PARALLELISM_RAD * more.normal() * height
    ways["bend_of_z"] = curve(more, min(0.0, *lift), max(lift), BEND_M)
    bow = bow + SQUARENESS_RAD * more.normal() * slide
    errors = {"straightness": (slide, bow), "stretch": stretch, **ways, **errors}
    machine = Machine(
        seed, lag=LAG_S * random.standard_normal(), ramp=RAMP_M_S * random.standard_normal(),
        spindle=spindle, pitch=pitch, **errors,
    )  # fmt: skip
    plans = [
        {"rpm": 30.0},
        {"rpm": 60.0, "outward": True},
        {"rpm": 30.0, "clocking": np.deg2rad(80)},
        {"rpm": 60.0, "outward": True, "clocking": np.deg2rad(200)},
    ][:scans]
    made = [machine.scan(**plans[0])]
    for plan in plans[1:]:
        moved = DECENTRE_M * random.standard_normal(2)
        turned = CLOCKING_RAD * random.standard_normal()
        made.append(machine.scan(**plan, moved=moved, turned=turned))
    return machine, made


def true_form(machine, form):
    """Return the true form at the places of ``form`` without piston, tip and tilt [m]."""
    height = machine.truth(form.x, form.y)
    pose = np.stack([np.ones(len(form.x)), form.x, form.y], axis=1)
    root = np.sqrt(form.area)[:, np.newaxis]
    return height - pose @ np.linalg.lstsq(pose * root, height * root[:, 0], rcond=None)[0]


def true_terms(machine, form):
    """Return the coefficients of the reported terms of the true form over the whole disc [m].

    By their orthogonality: Gaussian nodes in the square of the radius, and even angles.
    """
    node, weight = np.polynomial.legendre.leggauss(60)
    turn = np.exp(2j * np.pi * np.arange(180) / 180)
    u, v = (np.outer(np.sqrt((node + 1) / 2), part).ravel() for part in (turn.real, turn.imag))
    disc, area = form.disc, np.repeat(weight / 2 / 180, 180)
    height = machine.truth(disc.x + disc.radius * u, disc.y + disc.radius * v)
    values = zernike_values(u, v, form.terms)
    return (values * area) @ height / (values**2 @ area)


def normalised(machine, found):
    """Return errors over standard uncertainties: PV, rms, lag, terms; and the form's rms error."""
    form = found.form
    truth = true_form(machine, form)
    lag = found.source("lag_change")
    terms = (form.coefficients - true_terms(machine, form)) / np.sqrt(np.diag(form.term_covariance))
    pv = (form.pv.value - np.ptp(truth)) / form.pv.uncertainty
    rms = (form.rms.value - np.sqrt(form.area @ truth**2)) / form.rms.uncertainty
    error = np.sqrt(form.area @ (form.height - truth) ** 2)
    return pv, rms, (lag.found[0] - machine.lag) / lag.uncertainty[0], terms, error


def main(seeds, scans, pitch=0.4e-3):
    rows, alarms, errors, stated, lag, expanded, verdicts = [], 0, [], [], [], [], {}
    for seed in range(seeds):
        machine, made = drawn(seed, scans, pitch)
        found = adjust(made, AS_DRAWN, nominal=MIRROR, accuracy=25e-9)
        pv, rms, delay, terms, error = normalised(machine, found)
        rows.append([pv, rms, delay, *terms])
        errors.append(error)
        expanded.append(found.form.pv.uncertainty)
        stated.append(found.form.mean_uncertainty)
        lag.append(found.source("lag_change").uncertainty[0])
        alarms += bool(found.refutations)
        verdicts[found.verdict.code] = verdicts.get(found.verdict.code, 0) + 1
        if found.refutations or found.verdict.code not in ("verified", "not_verified"):
            print(seed, [r.name for r in found.refutations], found.verdict.reasons, flush=True)
    table = np.abs(rows)
    print(f"{seeds} machines, {scans} scans: alarms {alarms}, verdicts {verdicts}")
    print(
        f"form error {1e9 * np.sqrt(np.mean(np.square(errors))):.2f} nm rms, stated "
        f"{1e9 * np.sqrt(np.mean(np.square(stated))):.2f}; u(lag) {1e6 * np.mean(lag):.2f} µs"
    )
    print(f"U(PV) {2e9 * np.mean(expanded):.1f} nm, largest {2e9 * np.max(expanded):.1f}")
    for name, part in (("PV", table[:, 0]), ("rms", table[:, 1]), ("lag", table[:, 2]),
                       ("terms", table[:, 3:])):  # fmt: skip
        inside = 100 * np.mean(part <= 2)
        size = np.sqrt(np.mean(part**2))
        print(f"{name}: {inside:.1f} % within k = 2, normalised rms {size:.2f}")


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), *(1e-3 * float(a) for a in sys.argv[3:4]))
