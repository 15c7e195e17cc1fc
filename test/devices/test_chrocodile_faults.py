"""Random sequences of faults: the driver lives, and every sample is published once or counted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from omsm_ros.devices.chrocodile import ChrocodileSettings
from omsm_ros.devices.chrocodile_dollar import ChrocodileDevice
from omsm_ros.emulators.chrocodile import AXIS_SCALING, ChrocodileEmulator
from omsm_ros.emulators.instrument import Instrument

# Back at work within this long after the last fault [s]: time-outs and back-off included.
RECOVERY_S = 8.0


def count(name: str, most: int) -> st.SearchStrategy[Callable[[Instrument], None]]:
    return st.integers(1, most).map(lambda n: lambda i: setattr(i.faults, name, n))


def lasting(name: str, seconds: float) -> st.SearchStrategy[Callable[[Instrument], None]]:
    return st.floats(0.05, seconds).map(lambda s: lambda i: getattr(i, name)(s))


FAULTS = st.one_of(
    count("lose", 40),
    count("duplicate", 40),
    count("saturate", 40),
    count("drop_out", 40),
    count("noise", 500),
    count("garbage_answers", 2),
    count("ignore_commands", 2),
    lasting("unplug", 3.0),
    lasting("power_cycle", 3.0),
    lasting("stall", 3.0),
    st.just(lambda i: i.restart()),
    st.just(lambda i: i.reset_counter()),
    st.integers(0, 2**31).map(lambda ns: lambda i: i.step_clock(ns)),
    st.floats(0.05, 0.5).map(lambda s: lambda i: setattr(i.faults, "merge", s)),
    st.just(lambda i: setattr(i.faults, "merge", 0.0)),
)


@pytest.mark.parametrize("form", ["binary", "ascii"])
@settings(
    derandomize=True,
    max_examples=25,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(st.lists(st.tuples(FAULTS, st.floats(0.0, 1.5)), min_size=1, max_size=6))
def test_whatever_happens_in_any_order(
    form: str, bench: Any, story: list[tuple[Callable[[Instrument], None], float]]
) -> None:
    run = bench(
        ChrocodileEmulator,
        ChrocodileDevice,
        ChrocodileSettings(axes=AXIS_SCALING, format=form),
        interval=0.02,
    )
    run.run(0.5)
    for fault, pause in story:
        fault(run.instrument)
        run.run(pause)
    run.instrument.faults.merge = 0.0
    run.run(RECOVERY_S)
    before = run.delivered
    run.run(1.0)
    assert run.delivered >= before + 900, run.troubles
    run.end()
    run.check()
