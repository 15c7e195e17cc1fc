"""What an accelerometer feels: lines of acceleration, and the height that each may move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.ripple.density import Density, density
from omsm_ros.core.ripple.lines import find_lines
from omsm_ros.core.ripple.scan_signal import ScanSignal
from omsm_ros.core.streams.blocks import SAME_PERIOD, AccelerationBlock, FloatArray, uninterrupted
from omsm_ros.errors import ConfigurationError, DataError

AXES = ("x", "y", "z")
# As few frequencies as a floor of noise can be found among.
_LEAST_SAMPLES = 256


@dataclass(frozen=True, slots=True, kw_only=True)
class AccelerationLine:
    """A line of acceleration.

    axis: x, y or z;  frequency: [Hz], its standard uncertainty
    acceleration: amplitude [m/s²];  significance: [σ]
    """

    axis: str
    frequency: float
    frequency_uncertainty: float
    acceleration: float
    significance: float

    @property
    def displacement(self) -> float:
        """Amplitude of the motion that such an acceleration is [m]: ``a / ω²``."""
        return self.acceleration / (2 * np.pi * self.frequency) ** 2


@dataclass(frozen=True, slots=True, kw_only=True)
class AccelerationLines:
    """All lines of an accelerometer, and how far it reaches.

    highest: half its rate [Hz]: a line from beyond would be felt at its folded image
    duration: of the record [s]
    """

    lines: tuple[AccelerationLine, ...]
    highest: float
    duration: float


def accelerations_of(blocks: Sequence[AccelerationBlock]) -> tuple[float, dict[str, FloatArray]]:
    """Return the period [s] and the longest gapless run (n,) of each axis [m/s²].

    Raises DataError for blocks of several periods, or too few samples.
    """
    periods = {block.sample_period for block in blocks}
    if not periods or max(periods) - min(periods) > SAME_PERIOD * max(periods):
        raise DataError(
            f"acceleration with sample periods {sorted(periods)!r} s, expected one; record again"
        )
    run = max(uninterrupted(blocks), key=lambda run: sum(map(len, run)))
    axes = {axis: np.concatenate([getattr(b, axis) for b in run]) for axis in AXES}
    if len(axes["z"]) < _LEAST_SAMPLES:
        raise DataError(
            f"acceleration of {len(axes['z'])} samples on end, expected {_LEAST_SAMPLES} or more; "
            "record longer"
        )
    return min(periods), axes


def acceleration_lines(period: float, axes: dict[str, FloatArray]) -> AccelerationLines:
    """Return the lines of accelerations (n,) by axis, every ``period`` [s], NaN where lost.

    Of lines of one frequency on several axes the strongest is kept.
    """
    found: list[AccelerationLine] = []
    for axis, values in axes.items():
        found += _lines(period, axis, values)
    found.sort(key=lambda line: -line.acceleration)
    kept: list[AccelerationLine] = []
    duration = period * max(map(len, axes.values()))
    for line in found:
        if all(abs(line.frequency - other.frequency) > 1.0 / duration for other in kept):
            kept.append(line)
    return AccelerationLines(lines=tuple(kept), highest=0.5 / period, duration=duration)


def _lines(period: float, axis: str, values: FloatArray) -> list[AccelerationLine]:
    known = np.flatnonzero(np.isfinite(values))
    if len(known) < _LEAST_SAMPLES or not np.ptp(values[known]):
        return []
    still = np.zeros(len(known))
    signal = ScanSignal(
        name=axis, period=period, sample=known - known[0], height=values[known],
        path=still, radius=still, turn=still,
    )  # fmt: skip
    return [
        AccelerationLine(
            axis=axis,
            frequency=line.frequency,
            frequency_uncertainty=line.frequency_uncertainty,
            acceleration=line.amplitude,
            significance=line.significance,
        )
        for line in find_lines(signal, signal.height - np.mean(signal.height)).lines
    ]


# The spectrum of acceleration as it comes: levels by band and axis, and the height they move.

PROBE, SLIDE = "probe", "carriage"
"""Where the accelerometer sits: what it feels the encoder does not see, or sees."""

# A line is spread over ±4 resolutions by the window; four times as many make a band.
_LEAST_RESOLUTIONS = 16
_LOBE = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class VibrationLevels:
    """What shakes, averaged over the last windows.

    bands: (from, to) [Hz];  rms: of each axis [m/s²], one value a band
    line: strongest of all axes: axis, frequency [Hz], amplitude [m/s²]
    effect: on a height, rms, one value a band [m]; None where it is not known
    total_effect: of all bands together [m];  windows: averaged so far
    height_line: what moves the height most: frequency [Hz], amplitude [m]
    """

    bands: tuple[tuple[float, float], ...]
    rms: dict[str, tuple[float, ...]]
    line: tuple[str, float, float]
    effect: tuple[float, ...] | None
    total_effect: float | None
    windows: int
    height_line: tuple[float, float] | None = None

    def entry(self) -> dict[str, Any]:
        """Return JSON values, in SI: ``height`` is the effect by band, ``height_total`` of all."""
        axis, frequency, amplitude = self.line
        return {
            "bands": [list(band) for band in self.bands],
            "rms": {axis: list(levels) for axis, levels in self.rms.items()},
            "line": {"axis": axis, "frequency": frequency, "amplitude": amplitude},
            "height": None if self.effect is None else list(self.effect),
            "height_total": self.total_effect,
            "windows": self.windows,
        } | self._height_line_entry()

    def _height_line_entry(self) -> dict[str, Any]:
        if self.height_line is None:
            return {}
        frequency, amplitude = self.height_line
        return {"height_line": {"frequency": frequency, "amplitude": amplitude}}


@dataclass(frozen=True, slots=True, kw_only=True)
class MonitorOptions:
    """How to look.

    edges: of the bands, rising [Hz];  window: length of a spectrum [s]
    averages: spectra over which levels are averaged
    mount: ``probe`` or ``slide``;  axis: along which a height is measured
    """

    edges: tuple[float, ...] = (5.0, 50.0, 150.0, 500.0, 2000.0)
    window: float = 1.0
    averages: int = 4
    mount: str = PROBE
    axis: str = "z"

    def __post_init__(self) -> None:
        rising = len(self.edges) > 1 and all(a < b for a, b in pairwise(self.edges))
        least = _LEAST_RESOLUTIONS / self.window
        if not rising or not self.edges[0] > 0 or self.edges[1] - self.edges[0] < least:
            raise ConfigurationError(
                f"bands {self.edges!r} Hz, expected two or more rising edges above zero, the "
                f"first {least:g} Hz or more wide for a window of {self.window:g} s"
            )
        if self.mount not in (PROBE, SLIDE) or self.axis not in AXES:
            raise ConfigurationError(
                f"accelerometer on {self.mount!r}, height along {self.axis!r}; expected "
                f"{PROBE!r} or {SLIDE!r}, and one of {AXES!r}"
            )


@dataclass
class RunningSpectrum:
    """Takes blocks, keeps the average of half overlapping windows (Welch 1967).

    received, lost: samples;  restarts: where the counter did not go on or the period changed
    """

    options: MonitorOptions
    received: int = 0
    lost: int = 0
    restarts: int = 0
    _period: float = 0.0
    _next: int = -1
    _held: FloatArray = field(default_factory=lambda: np.empty((3, 0)))
    _mean: dict[str, Density] = field(default_factory=dict)
    _windows: int = 0

    def push(self, block: AccelerationBlock) -> None:
        """Take the next block."""
        self.received += len(block)
        if block.first_sample != self._next or block.sample_period != self._period:
            self.restarts += self._next >= 0
            self._begin(block)
        self._next = block.end
        values = np.array([block.x, block.y, block.z], np.float64)
        self.lost += int(np.count_nonzero(~np.isfinite(values).all(axis=0)))
        self._held = np.hstack([self._held, values])
        size = self._size
        while self._held.shape[1] >= size:
            self._add(self._held[:, :size])
            self._held = self._held[:, size // 2 :]

    @property
    def _size(self) -> int:
        return max(round(self.options.window / self._period), 2 * _LEAST_RESOLUTIONS)

    def _begin(self, block: AccelerationBlock) -> None:
        self._held = np.empty((3, 0))
        if block.sample_period != self._period:
            self._mean, self._windows = {}, 0
        self._period = block.sample_period

    def _add(self, window: FloatArray) -> None:
        if not np.isfinite(window).all():
            return
        self._windows += 1
        share = 1.0 / min(self._windows, self.options.averages)
        for axis, values in zip(AXES, window, strict=True):
            new = density(values - np.mean(values), self._period)
            old = self._mean.get(axis, new)
            mixed = old.density + share * (new.density - old.density)
            self._mean[axis] = Density(new.frequency, np.asarray(mixed), new.step)

    def levels(self, response: TransferFunction | None = None) -> VibrationLevels | None:
        """Return the levels now; None before the first window is full.

        response: from encoder to probe, as identified; needed for the effect of a vibration that
            the encoder sees, ``|1 - G| a / ω²`` (Eq. 5). What it does not see is ``a / ω²``.
        """
        if not self._mean:
            return None
        nyquist = 0.5 / self._period
        edges = [edge for edge in self.options.edges if edge < nyquist]
        bands = tuple(
            pairwise([*edges, nyquist] if len(edges) < len(self.options.edges) else edges)
        )
        height = self._height(response)
        effect = None if height is None else _by_band(height, bands)
        return VibrationLevels(
            bands=bands,
            rms={axis: _by_band(spectrum, bands) for axis, spectrum in self._mean.items()},
            line=max(
                ((axis, *_strongest(spectrum, bands)) for axis, spectrum in self._mean.items()),
                key=lambda line: line[2],
            ),
            effect=effect,
            total_effect=None if effect is None else float(np.sqrt(np.sum(np.square(effect)))),
            windows=self._windows,
            height_line=None if height is None else _strongest(height, bands),
        )

    def _height(self, response: TransferFunction | None) -> Density | None:
        seen = self.options.mount == SLIDE
        if seen and response is None:
            return None
        spectrum = self._mean[self.options.axis]
        omega = 2 * np.pi * np.maximum(spectrum.frequency, spectrum.step)
        share = np.ones(len(omega))
        if seen and response is not None:
            share = np.abs(1 - response.response(spectrum.frequency))
        return Density(
            spectrum.frequency, spectrum.density * (share / omega**2) ** 2, spectrum.step
        )


def _by_band(spectrum: Density, bands: Sequence[tuple[float, float]]) -> tuple[float, ...]:
    """Return the rms by band. What lies on an edge counts once, in the band above it."""
    inner = [np.nextafter(high, 0) for _, high in bands[:-1]] + [bands[-1][1]]
    return tuple(
        spectrum.power(low, high) ** 0.5 for (low, _), high in zip(bands, inner, strict=True)
    )


def _strongest(spectrum: Density, bands: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return frequency and amplitude of the strongest line within the bands."""
    inside = (spectrum.frequency >= bands[0][0]) & (spectrum.frequency <= bands[-1][1])
    at = float(spectrum.frequency[np.argmax(np.where(inside, spectrum.density, 0.0))])
    near = spectrum.power(at - _LOBE * spectrum.step, at + _LOBE * spectrum.step)
    return at, float(np.sqrt(2 * near))


@dataclass
class Alarm:
    """Raised at ``limit``, ended below ``release`` of it: it does not flutter about the limit.

    raised: now;  times: how often it was raised
    """

    limit: float
    release: float = 0.7
    raised: bool = False
    times: int = 0

    def __post_init__(self) -> None:
        if not (self.limit > 0 and 0 < self.release <= 1):
            raise ConfigurationError(
                f"alarm at {self.limit!r}, ended at {self.release!r} of it; expected a positive "
                "limit and a share up to 1"
            )

    def update(self, value: float | None) -> bool:
        """Return whether it is raised after ``value``; what is not known changes nothing."""
        if value is not None:
            if not self.raised and value >= self.limit:
                self.raised, self.times = True, self.times + 1
            elif self.raised and value < self.release * self.limit:
                self.raised = False
        return self.raised
