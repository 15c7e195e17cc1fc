"""Scans written down in plain numpy: a sum of sines over time, path, radius and turns.

Nothing here is taken from what is tested but the record that it goes into.
"""

import numpy as np
import pytest

from omsm_ros.core.ripple.scan_signal import scan_signal

NM = 1e-9


def spiral(
    name, lines, *, seconds=14.0, rpm=30.0, feed=1e-4, radius=12.7e-3, rate=1000.0, noise=5 * NM,
    seed=1, jitter=0.0, lost=0.0, gap=(0.0, 0.0),
):  # fmt: skip
    """lines: (over, frequency, amplitude) with over one of t, s, r, c; feed 0 is a circle."""
    rng = np.random.default_rng(seed)
    count = int(seconds * rate)
    time = np.arange(count) / rate
    wander = np.convolve(rng.normal(size=count), np.ones(200) / 14, "same")
    turn = np.cumsum(rpm / 60 * (1 + jitter * wander)) / rate
    turn -= turn[0]
    r = radius - feed * turn
    path = np.concatenate([[0.0], np.cumsum(2 * np.pi * (r[1:] + r[:-1]) / 2 * np.diff(turn))])
    height = rng.normal(0, noise, count)
    for over, frequency, amplitude in lines:
        place = {"t": time, "s": path, "r": r, "c": turn}[over]
        height = height + amplitude * np.sin(2 * np.pi * frequency * place + rng.uniform(0, 6))
    kept = rng.uniform(size=count) >= lost
    kept &= (time < gap[0]) | (time >= gap[1])
    sample = np.arange(count)
    axes = (sample, r, np.zeros(count), 2 * np.pi * turn)
    return scan_signal(name, 1 / rate, (sample[kept], height[kept]), axes), height[kept]


@pytest.fixture(scope="session")
def made():
    return lambda *a, **k: spiral(*a, **k)[0]
