"""Scans at a constant pace and their spectral lines, as numbers without heights, to save time.

Lines of the part, of vibration and of the spindle appear at their alias frequencies; all images are
searched.
"""

from types import SimpleNamespace

import numpy as np

from omsm_ros.core.ripple.coordinates import Coordinate
from omsm_ros.core.ripple.scan_signal import PATH, RADIUS, TIME, TURN, ScanSignal
from omsm_ros.core.ripple.spectral_line import SpectralLine

NM = 1e-9


def scan(
    rate=1000.0, pace=0.04, turning=0.5, seconds=20.0, lines=(), path_like=TIME, sigma=0.1 * NM,
    feed=1e-4, name="A", acceleration_lines=None, on_circle=False,
    rings=(0.0, 0.0),
):  # fmt: skip
    """Return a scan of ``seconds`` at ``pace`` [m/s], ``turning`` [turns/s] and ``feed`` [m/turn].

    sigma: of the amplitude of a line [m];  rings: the radii at which it begins and ends [m]
    """
    ends = np.array([0.0, seconds])

    def coordinate(name, speed, like, highest):
        return Coordinate(name, speed * ends, speed, like, highest)

    coordinates = {
        TIME: coordinate(TIME, 1.0, TIME, rate / 2),
        PATH: coordinate(PATH, pace, path_like, rate / 2 / pace),
        TURN: coordinate(TURN, turning, TIME, rate / 2 / turning),
    }
    if feed:
        crossing = feed * turning
        coordinates[RADIUS] = coordinate(RADIUS, crossing, TIME, rate / 2 / crossing)
    count = round(seconds * rate)
    # Looked at are its rate, its turns and how many samples it has.
    few = np.arange(count) if path_like == PATH else np.array([0, count - 1])
    at, turn = np.zeros(len(few)), np.linspace(0.0, turning * seconds, len(few))
    return SimpleNamespace(
        signal=ScanSignal(
            name=name,
            period=1 / rate,
            sample=few,
            height=at,
            path=at,
            radius=np.linspace(*rings, len(few)),
            turn=turn,
        ),
        coordinates=coordinates,
        lines=tuple(lines),
        formless=SimpleNamespace(degree=2, on_circle=on_circle),
        spectrum=SimpleNamespace(sigma_at=lambda frequency: sigma, noise=5 * NM),
        resolution=lambda name: coordinates[name].resolution,
        acceleration_lines=acceleration_lines,
    )


def line(frequency, amplitude=5 * NM, uncertainty=1e-4, coordinate=TIME, **possible):
    """Return a line of ``frequency`` in waves per unit of ``coordinate``, and its alternatives."""
    return SpectralLine(
        coordinate=coordinate, frequency=frequency, cosine=amplitude, sine=0.0,
        frequency_uncertainty=uncertainty, possible={coordinate: frequency, **possible},
    )  # fmt: skip


def aliased(frequency, rate):
    """The lowest frequency with the same samples, by looking at all its images."""
    return min(abs(frequency - k * rate) for k in range(int(frequency / rate) + 2))


def seen_by(one, over, frequency, amplitude=5 * NM):
    """The line that a wave over t, s, r or c makes in an even scan."""
    name = {"t": TIME, "s": PATH, "r": RADIUS, "c": TURN}[over]
    in_time = frequency * one.coordinates[name].pace
    if over != "t":  # a sample averages over its period
        amplitude *= abs(np.sinc(in_time * one.signal.period))
    at = aliased(in_time, one.signal.rate)
    return line(
        at, amplitude, **{n: at / one.coordinates[n].pace for n in one.coordinates if n != TIME}
    )
