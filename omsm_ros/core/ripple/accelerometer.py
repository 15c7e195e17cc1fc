"""Lines and levels of measured acceleration, and the height error that they may cause."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.ripple.density import Density, density
from omsm_ros.core.ripple.lines import find_lines
from omsm_ros.core.ripple.scan_signal import LEAST_POINTS, ScanSignal
from omsm_ros.core.streams.blocks import SAME_PERIOD, AccelerationBlock, FloatArray, uninterrupted
from omsm_ros.errors import ConfigurationError, DataError

AXES = ("x", "y", "z")
PROBE, SLIDE = "probe", "carriage"
"""Mount of the accelerometer: on the probe, not measured by the encoder, or on the slide."""

LARGEST_GAIN = 30.0
"""Largest ratio of a line in the heights to the motion a/ω² that causes it."""

# A line is spread over ±4 resolutions by the window; four times as many make a band.
_LEAST_RESOLUTIONS = 16
_LOBE = 4
# Blocks of frequencies of which the quietest shows the noise of the sensor, up to this share of
# half its rate, because a filter may lower it above.
_BLOCKS, _BELOW_FILTER = 24, 0.8
# Standard deviations of noise that a level has to exceed, and mean of the square of correlated
# neighbours under the window.
_NOISE_SIGMAS, _CORRELATED = 4.0, 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class AccelerationLine:
    """Spectral line of acceleration.

    axis: x, y or z;  frequency, frequency_uncertainty (k = 1): [Hz]
    acceleration: amplitude [m/s²];  significance: [σ]
    """

    axis: str
    frequency: float
    frequency_uncertainty: float
    acceleration: float
    significance: float

    @property
    def displacement(self) -> float:
        """Amplitude of the motion with this acceleration [m]: ``a / ω²``."""
        return self.acceleration / (2 * np.pi * self.frequency) ** 2


@dataclass(frozen=True, slots=True, kw_only=True)
class AccelerationLines:
    """All lines of an accelerometer.

    highest: half its rate [Hz], beyond which lines appear at their alias;  duration: [s]
    """

    lines: tuple[AccelerationLine, ...]
    highest: float
    duration: float


def accelerations_of(blocks: Sequence[AccelerationBlock]) -> tuple[float, dict[str, FloatArray]]:
    """Return the period [s] and the longest gapless run (n,) of each axis [m/s²].

    Raises DataError for blocks of several periods, or fewer than 256 samples.
    """
    periods = {block.sample_period for block in blocks}
    if not periods or max(periods) - min(periods) > SAME_PERIOD * max(periods):
        raise DataError("ripple.acceleration_periods", periods=sorted(periods))
    run = max(uninterrupted(blocks), key=lambda run: sum(map(len, run)))
    axes = {axis: np.concatenate([getattr(b, axis) for b in run]) for axis in AXES}
    if len(axes["z"]) < LEAST_POINTS:
        raise DataError("ripple.short_acceleration", samples=len(axes["z"]), least=LEAST_POINTS)
    return min(periods), axes


def acceleration_lines(period: float, axes: dict[str, FloatArray]) -> AccelerationLines:
    """Return the lines of accelerations (n,) by axis, sampled every ``period`` [s], NaN where lost.

    For lines with one frequency on several axes the strongest is kept.
    """
    found = [line for axis, values in axes.items() for line in _lines(period, axis, values)]
    kept: list[AccelerationLine] = []
    duration = period * max(map(len, axes.values()))
    for line in sorted(found, key=lambda line: -line.acceleration):
        if all(abs(line.frequency - other.frequency) > 1.0 / duration for other in kept):
            kept.append(line)
    return AccelerationLines(lines=tuple(kept), highest=0.5 / period, duration=duration)


def _lines(period: float, axis: str, values: FloatArray) -> list[AccelerationLine]:
    known = np.flatnonzero(np.isfinite(values))
    if len(known) < LEAST_POINTS or not np.ptp(values[known]):
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


@dataclass(frozen=True, slots=True, kw_only=True)
class VibrationLevels:
    """Vibration averaged over the last windows.

    bands: (from, to) [Hz];  rms: of each axis [m/s²], one value for each band
    line: strongest of all axes: axis, frequency [Hz], amplitude [m/s²]
    height: rms effect on the height for each band [m], without the white noise of the sensor; None
        if unknown
    height_total: of all bands [m];  windows: number averaged so far
    height_noise: what the noise of the sensor would be in all bands, and hides [m]
    height_line: strongest line in the height: frequency [Hz], amplitude [m]
    """

    bands: tuple[tuple[float, float], ...]
    rms: dict[str, tuple[float, ...]]
    line: tuple[str, float, float]
    height: tuple[float, ...] | None
    height_total: float | None
    height_noise: float | None
    windows: int
    height_line: tuple[float, float] | None

    def entry(self) -> dict[str, Any]:
        """Return JSON values in SI units, without ``height_line`` where there is none."""
        names = ("axis", "frequency", "amplitude")
        found = asdict(self) | {"line": dict(zip(names, self.line, strict=True))}
        if (line := found.pop("height_line")) is not None:
            found["height_line"] = dict(zip(names[1:], line, strict=True))
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class MonitorOptions:
    """Settings of the vibration monitor.

    edges: of the bands, rising [Hz];  window: length of a spectrum [s]
    averages: number of spectra over which levels are averaged
    mount: PROBE or SLIDE;  axis: along which a height is measured
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
                "ripple.monitor_bands", edges=self.edges, least=least, window=self.window
            )
        if self.mount not in (PROBE, SLIDE) or self.axis not in AXES:
            raise ConfigurationError(
                "ripple.monitor_mount",
                mount=self.mount,
                axis=self.axis,
                mounts=(PROBE, SLIDE),
                axes=AXES,
            )


@dataclass
class RunningSpectrum:
    """Average spectrum of blocks over half overlapping windows (Welch 1967).

    received, lost: samples;  restarts: number of gaps of the counter or changes of the period
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
        """Add a block."""
        self.received += len(block)
        if block.first_sample != self._next or block.sample_period != self._period:
            self.restarts += self._next >= 0
            self._held = np.empty((3, 0))
            if block.sample_period != self._period:
                self._period, self._mean, self._windows = block.sample_period, {}, 0
        self._next = block.end
        values = np.array([block.x, block.y, block.z], np.float64)
        self.lost += int(np.count_nonzero(~np.isfinite(values).all(axis=0)))
        self._held = np.hstack([self._held, values])
        size = max(round(self.options.window / self._period), 2 * _LEAST_RESOLUTIONS)
        while self._held.shape[1] >= size:
            self._add(self._held[:, :size])
            self._held = self._held[:, size // 2 :]

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
        """Return the present levels, None before the first window is full.

        response: identified, from encoder to probe; the effect of a vibration is ``|1 - G| a / ω²``
            (Eq. 5) on the slide, where the encoder sees it, and ``a / ω²`` on the probe
        """
        if not self._mean:
            return None
        nyquist = 0.5 / self._period
        edges = [edge for edge in self.options.edges if edge < nyquist]
        bands = tuple(
            pairwise([*edges, nyquist] if len(edges) < len(self.options.edges) else edges)
        )
        share = self._height_share(response)
        effect = total = noise = line = None
        if share is not None:
            effect, noise = self._levels(bands, share)
            total = float(np.linalg.norm(effect))
            spectrum = self._mean[self.options.axis]
            most = self._floor(spectrum)[0] * (1 + _NOISE_SIGMAS / self._averaged**0.5)
            clear = np.maximum(spectrum.density - most, 0.0)
            height = Density(spectrum.frequency, clear * share, spectrum.step)
            found = _strongest(height, bands)
            line = found if found[1] > 0 else None
        return VibrationLevels(
            bands=bands,
            rms={axis: _by_band(spectrum, bands) for axis, spectrum in self._mean.items()},
            line=max(
                ((axis, *_strongest(spectrum, bands)) for axis, spectrum in self._mean.items()),
                key=lambda line: line[2],
            ),
            height=effect,
            height_total=total,
            height_noise=noise,
            windows=self._windows,
            height_line=line,
        )

    def _floor(self, spectrum: Density) -> tuple[float, float]:
        """Return density of the sensor's white noise, of the quietest frequencies; relative σ.

        The median of an average of n exponential variables is 1 - 1/(3 n) of their mean, and the
        least of 24 medians two σ below it.
        """
        quiet = spectrum.density[1 : int(_BELOW_FILTER * len(spectrum.density))]
        parts = [part for part in np.array_split(quiet, _BLOCKS) if len(part)]
        sigma = 1.25 * float(np.sqrt(_CORRELATED / (len(parts[-1]) * self._averaged)))
        least = min(float(np.median(part)) for part in parts)
        return least * (1 + 2 * sigma) / (1 - 1 / (3 * self._averaged)), sigma

    @property
    def _averaged(self) -> int:
        return min(self._windows, self.options.averages)

    def _levels(
        self, bands: Sequence[tuple[float, float]], share: FloatArray
    ) -> tuple[tuple[float, ...], float]:
        """Return the height's rms by band beyond noise, and that of the noise in all bands [m].

        Each third of an octave counts that exceeds its own noise, so that noise at 5 Hz, which
        ``a/ω²`` amplifies most, hides no motion at 30 Hz.
        """
        spectrum = self._mean[self.options.axis]
        floor, sigma = self._floor(spectrum)
        levels, total = [], 0.0
        for low, high in bands:
            parts = int(np.ceil(3 * np.log2(high / low)))
            top = high if high == bands[-1][1] else np.nextafter(high, 0)
            edges = list(pairwise([low, *np.geomspace(low, high, parts + 1)[1:-1], top]))
            seen, mean, squared = (
                np.square(_by_band(Density(spectrum.frequency, d, spectrum.step), edges))
                for d in (spectrum.density * share, share, share**2)
            )
            spread = np.hypot(
                np.sqrt(_CORRELATED * spectrum.step * squared / self._averaged), sigma * mean
            )
            noise = floor * (mean + _NOISE_SIGMAS * spread)
            # A level beyond its noise loses the mean of the noise only.
            levels.append(float(np.sqrt(np.sum(np.where(seen > noise, seen - floor * mean, 0.0)))))
            total += float(np.sum(noise))
        return tuple(levels), total**0.5

    def _height_share(self, response: TransferFunction | None) -> FloatArray | None:
        """Return the square of height over acceleration by frequency, None if it is unknown."""
        spectrum, share = self._mean[self.options.axis], np.ones(1)
        if self.options.mount == SLIDE:
            if response is None:
                return None
            share = np.abs(1 - response.response(spectrum.frequency))
        omega = 2 * np.pi * np.maximum(spectrum.frequency, spectrum.step)
        return np.asarray((share / omega**2) ** 2)


def _by_band(spectrum: Density, bands: Sequence[tuple[float, float]]) -> tuple[float, ...]:
    """Return the rms by band; a frequency on an edge counts in the band above it."""
    inner = [np.nextafter(high, 0) for _, high in bands[:-1]] + [bands[-1][1]]
    return tuple(
        spectrum.power(low, high) ** 0.5 for (low, _), high in zip(bands, inner, strict=True)
    )


def _strongest(spectrum: Density, bands: Sequence[tuple[float, float]]) -> tuple[float, float]:
    inside = (spectrum.frequency >= bands[0][0]) & (spectrum.frequency <= bands[-1][1])
    at = float(spectrum.frequency[np.argmax(np.where(inside, spectrum.density, 0.0))])
    near = spectrum.power(at - _LOBE * spectrum.step, at + _LOBE * spectrum.step)
    return at, float(np.sqrt(2 * near))


@dataclass
class Alarm:
    """Alarm with hysteresis: raised at ``limit``, ended below the share ``release`` of it.

    raised: present state;  times: number of times it was raised
    """

    limit: float
    release: float = 0.7
    raised: bool = False
    times: int = 0

    def __post_init__(self) -> None:
        if not (self.limit > 0 and 0 < self.release <= 1):
            raise ConfigurationError("ripple.alarm_limits", limit=self.limit, release=self.release)

    def update(self, value: float | None) -> bool:
        """Return whether it is raised after ``value``; None changes nothing."""
        if value is not None:
            if not self.raised and value >= self.limit:
                self.raised, self.times = True, self.times + 1
            elif self.raised and value < self.release * self.limit:
                self.raised = False
        return self.raised
