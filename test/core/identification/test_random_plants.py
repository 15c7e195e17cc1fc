"""Whatever is accepted can be used and is true, for random plants that plain numpy simulates."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
import pytest
from scipy import signal
from soaked import soaked

from omsm_ros.core.estimation.sampled_fit import SampledRecord
from omsm_ros.core.estimation.sampled_model import SampledModel, free_run
from omsm_ros.core.identification.sampled_identification import identify_samples

SAMPLES, FINER = 3000, 8


@dataclass(frozen=True)
class Plant:
    """Poles and residues of a continuous system in units of the sampling rate, and its test."""

    poles: np.ndarray
    residues: np.ndarray
    hold: str
    delay: float
    noise: float
    colour: float
    gaps: bool

    def response(self, cycles):
        s = 2j * np.pi * cycles[:, None]
        if self.hold == "band-limited":
            value = np.sum(self.residues / (s - self.poles), axis=1)
        else:
            q, p = np.exp(s), np.exp(self.poles)
            value = np.sum(self.residues * (p - 1) / self.poles / (q - p), axis=1)
        return value * np.exp(-2j * np.pi * cycles * self.delay)

    def record(self, rng):
        """Return input and output (SAMPLES,), cut out of a longer motion."""
        long = SAMPLES + 2000
        if self.hold == "band-limited":
            u = signal.lfilter(*signal.butter(4, 0.6), rng.normal(size=long))
            cycles = np.fft.rfftfreq(long)
            y = np.fft.irfft(np.fft.rfft(u) * self.response(cycles), long)
        else:
            u = np.repeat(rng.choice([-1.0, 1.0], long // 3 + 1), 3)[:long]
            late = np.concatenate([np.zeros(int(self.delay)), u])[:long]
            p = np.exp(self.poles)
            y = np.zeros(long)
            for pole, gain in zip(p, self.residues * (p - 1) / self.poles, strict=True):
                y = y + signal.lfilter([0, gain], [1, -pole], late).real
        e = signal.lfilter([1.0], [1.0, -self.colour], rng.normal(size=long))
        y = y.real + self.noise * np.std(y.real) * e / np.std(e)
        return u[1500:-500], y[1500:-500]


def plant_of(seed):
    rng = np.random.default_rng(seed)
    order = int(rng.integers(1, 21))
    pairs = order // 2
    rate = np.exp(rng.uniform(np.log(0.02), np.log(1.2), pairs))
    damping = np.exp(rng.uniform(np.log(0.005), np.log(0.7), pairs))
    upper = rate * (-damping + 1j * np.sqrt(1 - damping**2))
    gains = rate * rng.uniform(0.2, 1.0, pairs) * np.exp(1j * rng.uniform(-1, 1, pairs)) / 1j
    single = -np.exp(rng.uniform(np.log(0.02), np.log(1.0), order % 2))
    hold = str(rng.choice(["band-limited", "zero-order"]))
    delay = float(rng.integers(0, 4)) if hold == "zero-order" else float(rng.uniform(0, 4))
    return Plant(
        np.concatenate([upper, upper.conj(), single]),
        np.concatenate([gains * damping, (gains * damping).conj(), -0.6 * single]),
        hold,
        delay if rng.random() < 0.5 else 0.0,
        float(np.exp(rng.uniform(np.log(1e-3), np.log(0.3)))),
        float(rng.choice([0.0, 0.9])),
        bool(rng.random() < 0.3),
    )  # fmt: skip


def judged(seed):
    """Return the verdict, the true order, and what is wrong with it."""
    plant, rng = plant_of(seed), np.random.default_rng(10_000 + seed)
    (u, y), (u2, y2) = plant.record(rng), plant.record(rng)
    used = np.ones(SAMPLES, bool)
    if plant.gaps:
        for start in rng.integers(50, SAMPLES - 200, 8):
            used[start : start + int(rng.integers(1, 60))] = False
    record = SampledRecord(u[:, None], np.where(used, y, np.nan), used)
    model = identify_samples([record], 1e-3, hold=plant.hold)
    verdict, wrong = str(model.certificate["verdict"]), []
    if not verdict.startswith("accepted"):
        return verdict, plant, wrong, model
    model = SampledModel.from_content(json.loads(json.dumps(model.content())))
    if not np.max(model.sections.poles().real, initial=-1.0) < 0:
        wrong.append("unstable")
    run = free_run(model, u2, y2)
    if run.explained < (1 - plant.noise**2 / (1 + plant.noise**2)) - 0.15:
        wrong.append(f"explains {run.explained:.3f}")
    lines = np.geomspace(*model.valid[0], 200)
    truth = plant.response(lines * 1e-3)
    off = np.abs(model.sections.response(lines)[0] / truth - 1)
    if np.mean(off > 0.1 * np.sqrt(2)) > 0.1:
        wrong.append(f"{100 * np.mean(off > 0.14):.0f} % of the lines are off")
    apart = np.abs(_by_scipy(model.sections, lines) / model.sections.response(lines)[0] - 1)
    if np.max(apart) > 1e-6:
        wrong.append(f"scipy differs by {np.max(apart):.2g}")
    return verdict, plant, wrong, model


def _by_scipy(sections, lines):
    """Return the response at ``lines`` [Hz] of each section by itself, the bilinear one if held."""
    total = np.full(len(lines), sections.direct[0], complex)
    for (d1, d2), (b0, b1) in zip(sections.denominators, sections.numerators[0], strict=True):
        down = np.trim_zeros([d2, d1, 1.0], "f")
        up = [b1, b0][-len(down) :]
        if sections.hold == "band-limited":
            total += signal.freqs(up, down, 2 * np.pi * lines)[1]
        else:
            held = signal.bilinear(up, down, 1 / sections.period)
            total += signal.freqz(*held, 2 * np.pi * lines * sections.period)[1]
    return total * np.exp(-2j * np.pi * lines * sections.delays[0])


@pytest.mark.parametrize("seed", [1, *soaked(0)])
def test_what_is_accepted_of_a_random_plant_is_true(seed):
    assert judged(seed)[2] == []


@pytest.mark.soak
def test_what_is_accepted_of_a_hundred_random_plants_is_true():
    """At most two of a hundred bands may be off, and most plants are accepted."""
    found = [judged(seed) for seed in range(100, 200)]
    accepted = [one for one in found if one[0].startswith("accepted")]
    assert len(accepted) >= 85
    assert not any("unstable" in one[2] for one in found)
    assert sum(bool(one[2]) for one in accepted) <= 2
