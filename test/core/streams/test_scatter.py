"""The scatter of a long scan does not depend on how it was cut, however long it is."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.streams.statistics import RunningScatter


@pytest.mark.parametrize("expected", [0.0, 1e-9, 1e-8])
@pytest.mark.parametrize("length", [777, 30_000])
def test_blocks_scatter_as_the_whole_to_the_last_bit(expected: float, length: int) -> None:
    random = np.random.default_rng(4)
    heights = random.normal(0, 1e-8, 150_000) * np.linspace(1, 2, 150_000)
    sample = np.arange(len(heights))
    whole = RunningScatter(expected).excess(0, sample, heights)
    running, parts = RunningScatter(expected), []
    for start in range(0, len(heights), length):
        place = slice(start, start + length)
        parts.append(running.excess(0, sample[place], heights[place]))
    assert np.concatenate(parts).tobytes() == whole.tobytes()
    # Noise has the variance that was put in, to what 2048 differences tell of it.
    end = np.mean(whole[-5000:]) + expected**2
    assert end == pytest.approx((2e-8) ** 2, rel=0.2, abs=1e-17)
