"""The selection from a long stream is even, bounded and independent of its division."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.streams.statistics import EvenSelection


@settings(max_examples=200)
@given(
    total=st.integers(0, 400),
    cuts=st.lists(st.integers(0, 400), max_size=8),
    most=st.integers(1, 50),
)
def test_every_kth_row_is_kept_however_the_stream_is_cut(
    total: int, cuts: list[int], most: int
) -> None:
    rows = np.arange(total)
    kept = EvenSelection(most)
    for part in np.split(rows, sorted(c for c in cuts if c < total)):
        kept.add(part)
    every = 1
    while -(-total // every) > most:
        every *= 2
    assert np.array_equal(kept.rows(), rows[::every])
    assert len(kept) == len(kept.rows()) <= most


@pytest.mark.parametrize("shape", [(7, 3), (7,)])
def test_rows_may_have_any_shape_and_are_copies(shape: tuple[int, ...]) -> None:
    rows = np.random.default_rng(1).normal(size=shape)
    kept = EvenSelection(10)
    kept.add(rows)
    before = rows.copy()
    rows[:] = 0.0
    assert np.array_equal(kept.rows(), before)


def test_memory_is_that_of_the_rows_however_small_the_parts() -> None:
    """A live scan brings parts of a row or two, without end."""
    kept, part = EvenSelection(1000), np.ones((7, 10))
    tracemalloc.start()
    for _ in range(30_000):
        kept.add(part)
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 1.1 * 1000 * part[0].nbytes + 2000
