"""Fixtures: recordings of the twin that several tests share, made once and never changed.

The order of tests: several processes share the test files, and files with nodes mostly wait. The
process that hands them out imports this file too, so each fixture imports what it needs.
"""

import gc
import signal

import hypothesis
import numpy as np
import pytest


def pytest_configure():
    """Make the tests independent of a busy computer and of a shell in the background.

    Hypothesis limits an example to 200 ms, but each test has its own time-out. Its examples are the
    same in every run. A background shell ignores SIGINT, and so would every node that a test
    starts.
    """
    hypothesis.settings.register_profile(
        "whole tests are timed", deadline=None, max_examples=30, derandomize=True
    )
    hypothesis.settings.load_profile("whole tests are timed")
    pytest.approx = approx
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    gc.disable()  # of half a million objects of the collected tests, none is garbage


def pytest_collection_finish():
    gc.freeze()  # nor is it looked for while they run
    gc.enable()
    gc.set_threshold(50_000)  # of 700: a tree of the syntax of a file has a hundred times as many


_APPROX = pytest.approx
_SMALL = 1e-10


def approx(expected, rel=None, abs=None, nan_ok=False):
    """As ``pytest.approx``, which takes all within 1e-12 for equal: not where values are as small.

    A square of nanometres would equal any other.
    """
    if abs is None:
        values = list(expected.values()) if isinstance(expected, dict) else expected
        sizes = np.abs(np.asarray(values, dtype=complex))
        largest = np.max(sizes[np.isfinite(sizes)], initial=0.0)
        assert not 0 < largest < _SMALL, f"state rel and abs=0 for {largest}"
    return _APPROX(expected, rel=rel, abs=abs, nan_ok=nan_ok)


def pytest_collection_modifyitems(items):
    """Spread the files with nodes evenly among the others; the hour of real time begins first."""
    place, paths = {}, {item.path for item in items}
    for with_nodes in (True, False):
        files = sorted(p for p in paths if (p.parent.name == "system") is with_nodes)
        place |= {file: k / len(files) for k, file in enumerate(files)}
    items.sort(key=lambda item: (item.path.name != "test_soak.py", place[item.path]))


@pytest.fixture(scope="module")
def generators(request):
    """Random generators of a test file, each with its state before the first test."""
    own = [g for g in vars(request.module).values() if isinstance(g, np.random.Generator)]
    return [(g.bit_generator, g.bit_generator.state) for g in own]


@pytest.fixture(autouse=True)
def _same_numbers(generators):
    """Let a test draw the same numbers, whichever tests run before it."""
    for generator, state in generators:
        generator.state = state


@pytest.fixture(scope="session")
def small_scenario():
    """A spiral of 2 mm radius: 40 s, 40 000 samples. The whole mirror has 254 000."""
    from omsm_ros.twin.scenario import Scenario

    return Scenario(start_radius=2e-3)


@pytest.fixture(scope="session")
def small_scan(small_scenario):
    from omsm_ros.twin.scenario import scan_of

    return scan_of(small_scenario)


@pytest.fixture(scope="session")
def small_scan_blocks(small_scan):
    from omsm_ros.twin.cell import blocks_of

    return blocks_of(small_scan)


@pytest.fixture(scope="session")
def step_test(small_scenario):
    from benchmarks.twin_motions import step_test_of

    return step_test_of(small_scenario)


@pytest.fixture(scope="session")
def true_calibration(small_scenario):
    """The calibration that an identification without noise would give."""
    from omsm_ros.core.calibration.calibration import Calibration
    from omsm_ros.core.calibration.certificate import Certificate
    from omsm_ros.twin.plant import PAPER_STATIC_GAIN, Plant

    dynamics = Plant().dynamics
    p = len(dynamics.numerator) + len(dynamics.denominator)
    return Calibration(
        dynamics=dynamics,
        static_gain=PAPER_STATIC_GAIN,
        sample_period=small_scenario.sample_period,
        valid_up_to=100.0,
        covariance=np.zeros((p, p)),
        settings={"machine": "twin"},
        certificate=Certificate(verdict="accepted"),
    )
