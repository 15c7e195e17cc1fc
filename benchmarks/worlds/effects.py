"""Make the effects that disturb a machine: each function returns one for `Machine.plus`.

Amplitudes in metres or radians, times in seconds. A phase is fixed when the effect is made, so that
it is the same in all recordings of a machine; ``now.rng`` gives what differs between them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import signal

from benchmarks.worlds.dynamics import LinearSystem, backlash, delayed, presliding
from benchmarks.worlds.machine import Effect, Moment, Recording

Array = np.ndarray
Of = Callable[[Moment], Array]


# Loop: heights that are added to the surface


def axial(per_turn: float, amplitude: float, phase: float = 0.0) -> Effect:
    """Move the spindle along its axis, in step with the machine's C."""
    return lambda now: amplitude * np.cos(per_turn * now.c + phase)


def tilting(per_turn: float, amplitude: float, phase: float = 0.0) -> Effect:
    """Tilt the spindle [rad] in step with C; it acts by the distance from the axis."""
    return lambda now: now.x * amplitude * np.cos(per_turn * now.c + phase)


def asynchronous(amplitude: float, per_turn: float) -> Effect:
    """Move the spindle along its axis ``per_turn`` waves a turn, the phase wandering."""

    def effect(now: Moment) -> Array:
        rng = now.rng("asynchronous")
        wander = np.cumsum(rng.normal(size=len(now.t))) * np.sqrt(now.period) * 0.3
        return amplitude * np.cos(per_turn * now.c + wander + rng.uniform(0, 2 * np.pi))

    return effect


def half_turns(amplitude: float) -> Effect:
    """Change height from half turn to half turn by chance, ``amplitude`` the rms."""

    def effect(now: Moment) -> Array:
        half = np.floor(now.c / np.pi).astype(int)
        levels = now.rng("half").normal(size=int(np.ptp(half)) + 1)
        return amplitude * levels[half - half.min()]

    return effect


def spun(amplitude: float, radius: float) -> Effect:
    """Bow the part by centrifugal force: ``amplitude`` at the rim at 60 rpm, with rpm²."""
    return lambda now: amplitude * (now.path.rpm / 60) ** 2 * np.square(now.x / radius)


def walk(rate: float) -> Effect:
    """Drift as a random walk, ``rate`` in m/√s."""

    def effect(now: Moment) -> Array:
        return rate * np.sqrt(now.period) * np.cumsum(now.rng("walk").normal(size=len(now.t)))

    return effect


def wandering(rms: float, tau: float) -> Effect:
    """Drift about zero with a correlation time ``tau``."""

    def effect(now: Moment) -> Array:
        rng = now.rng("wandering")
        keep = np.exp(-now.period / tau)
        noise = np.sqrt(1 - keep**2) * rng.normal(size=len(now.t))
        return rms * signal.lfilter([1.0], [1.0, -keep], noise, zi=[keep * rng.normal()])[0]

    return effect


def ramp(rate: float) -> Effect:
    """Drift evenly, ``rate`` in m/s, since the part was clamped."""
    return lambda now: rate * now.age


def relaxing(amplitude: float, tau: float, tilt: float = 0.0) -> Effect:
    """Relax exponentially since the clamping by ``amplitude``, and by ``tilt`` × part's x."""

    def effect(now: Moment) -> Array:
        left = np.exp(-now.age / tau)
        return left * (amplitude + tilt * now.x * np.cos(now.c))

    return effect


def growing(amplitude: float, tau: float) -> Effect:
    """Grow along the axis from each start of the spindle, by its speed: amplitude at 60 rpm."""
    return lambda now: amplitude * abs(now.path.rpm) / 60 * (1 - np.exp(-now.t / tau))


def swinging(amplitude: float, period: float, phase: float) -> Effect:
    """Swing slowly in time, as an air conditioner does."""
    return lambda now: amplitude * np.sin(2 * np.pi * now.age / period + phase)


def line(frequency: float, amplitude: float, exposure: float) -> Effect:
    """Vibrate at one frequency, averaged by the exposure; the phase differs by recording."""

    def effect(now: Moment) -> Array:
        phase = now.rng(f"line {frequency}").uniform(0, 2 * np.pi)
        size = amplitude * np.sinc(frequency * exposure)
        return size * np.cos(2 * np.pi * frequency * now.t + phase)

    return effect


def floor(frequency: float, rms: float, damping: float = 0.03) -> Effect:
    """Shake a mode of the floor by chance."""

    def effect(now: Moment) -> Array:
        n, extra = len(now.t), int(4 / (damping * frequency * now.period))
        noise = now.rng("floor").normal(size=n + extra)
        pole = np.exp(2j * np.pi * frequency * now.period * (1j - damping))
        answer = signal.lfilter([1.0], [1.0, -2 * pole.real, abs(pole) ** 2], noise)
        return rms * answer[extra:] / np.std(answer[extra:])

    return effect


def air(rms: float, corner: float = 0.05) -> Effect:
    """Add 1/f noise of air in the beam's path and of temperature, flat below ``corner`` [Hz]."""

    def effect(now: Moment) -> Array:
        n = len(now.t)
        frequency = np.fft.rfftfreq(n, now.period)
        shape = 1 / np.sqrt(np.maximum(frequency, corner))
        shape[0] = 0
        noise = np.fft.irfft(shape * np.fft.rfft(now.rng("air").normal(size=n)), n)
        return rms * noise / np.std(noise)

    return effect


def height_step(amplitude: float, at: float, tilt: float = 0.0) -> Effect:
    """Step by ``amplitude`` and ``tilt`` × part's x when the share ``at`` of a scan is done."""

    def effect(now: Moment) -> Array:
        after = now.t >= at * now.path.duration
        return after * (amplitude + tilt * now.x * np.cos(now.c))

    return effect


def over(of: Of, amplitude: float, power: int = 1) -> Effect:
    """Add ``amplitude`` × a quantity of the moment to a power: bows, cones, hysteresis."""
    return lambda now: amplitude * of(now) ** power


def waving(of: Of, amplitude: float, period: float, phase: float) -> Effect:
    """Add a wave over a quantity of the moment."""
    return lambda now: amplitude * np.sin(2 * np.pi * of(now) / period + phase)


# Place: where the beam lies


def offset_beam(dx: float = 0.0, dy: float = 0.0) -> Effect:
    """Shift the beam against the spindle's axis."""
    return lambda now: (dx, dy)


def offset_beam_by(of: Of, dx: float = 0.0, dy: float = 0.0) -> Effect:
    """Shift the beam in proportion to a quantity of the moment."""

    def effect(now: Moment) -> tuple[Array, Array]:
        amount = of(now)
        return dx * amount, dy * amount

    return effect


# Structure: what the probe does when Z moves


def lagging(delay: Of) -> Effect:
    """Delay the probe's motion further, by a function of the moment [s]."""
    return lambda now, probe: delayed(probe, now.period, delay(now))


def through(system: LinearSystem) -> Effect:
    """Send the motion through one system more."""
    return lambda now, probe: system.respond(probe, now.period)


def playing(width: float) -> Effect:
    """Let the probe's mount have play."""
    return lambda now, probe: backlash(probe, width)


def rubbing(force: float, length: float) -> Effect:
    """Let the mount slide before it yields: Dahl's friction, of ``force`` in metres."""
    return lambda now, probe: presliding(probe, force, length)


def bending(of: Of, amplitude: float, power: int = 1, odd: bool = False) -> Effect:
    """Move the probe by amplitude × quantity^power, or × |quantity|^(power−1) if ``odd``."""

    def effect(now: Moment, probe: Array) -> Array:
        q = of(now)
        return probe + amplitude * (q * np.abs(q) ** (power - 1) if odd else q**power)

    return effect


# Probe: reading beyond distance


def reading(of: Callable[[Moment, Array], Array]) -> Effect:
    """Add a function of moment and distance to the reading."""
    return of


def noisier(rms: Of | float) -> Effect:
    """Add white noise, of one rms or one of the moment."""

    def effect(now: Moment, distance: Array) -> Array:
        size = rms(now) if callable(rms) else rms
        return size * now.rng("noisier").normal(size=len(now.t))

    return effect


def outliers(share: float, size: float) -> Effect:
    """Let dust make a share of readings wrong, in runs of five, by up to ``size``."""

    def effect(now: Moment, distance: Array) -> Array:
        rng = now.rng("dust")
        hit = np.convolve(rng.uniform(size=len(now.t)) < share / 5, np.ones(5))[: len(now.t)] > 0
        return hit * rng.uniform(-size, size, len(now.t))

    return effect


# Record: what is logged


def scaled_column(name: str, error: float) -> Effect:
    """Log a column too large by a factor 1 + ``error``."""

    def effect(rec: Recording, now: Moment) -> None:
        setattr(rec, name, getattr(rec, name) * (1 + error))

    return effect


def waving_column(name: str, amplitude: float, period: float, phase: float) -> Effect:
    """Log a column with a periodic error of its scale."""

    def effect(rec: Recording, now: Moment) -> None:
        value = getattr(rec, name)
        setattr(rec, name, value + amplitude * np.sin(2 * np.pi * value / period + phase))

    return effect


def lost_counts(name: str, amount: float, at: float) -> Effect:
    """Log a column off by ``amount`` from the share ``at`` of the recording on."""

    def effect(rec: Recording, now: Moment) -> None:
        getattr(rec, name)[int(at * len(rec.t)) :] -= amount

    return effect


def ramped_column(name: str, rate: float) -> Effect:
    """Log a column that drifts, ``rate`` per second."""

    def effect(rec: Recording, now: Moment) -> None:
        setattr(rec, name, getattr(rec, name) + rate * rec.t)

    return effect


def missing_rows(share: float) -> Effect:
    """Lose a share of the triggers, in runs of twenty, whole rows."""

    def effect(rec: Recording, now: Moment) -> None:
        start = now.rng("missing").uniform(size=len(rec.t)) < share / 20
        rec.keep(~(np.convolve(start, np.ones(20))[: len(rec.t)] > 0))

    return effect


def no_reading(share: float) -> Effect:
    """Lose a share of the probe's readings, in runs of ten."""

    def effect(rec: Recording, now: Moment) -> None:
        start = now.rng("no reading").uniform(size=len(rec.t)) < share / 10
        lost = np.convolve(start, np.ones(10))[: len(rec.t)] > 0
        rec.distance[lost] = np.nan
        rec.intensity[lost] = 0.0

    return effect


def shifted_distance(samples: int, at: float = 0.0) -> Effect:
    """Store readings ``samples`` triggers late from the share ``at`` of the recording on."""

    def effect(rec: Recording, now: Moment) -> None:
        first = int(at * len(rec.t))
        rec.distance[first:] = np.roll(rec.distance, samples)[first:]

    return effect
