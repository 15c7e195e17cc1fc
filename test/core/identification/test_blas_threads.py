"""Test that an identification gives the same bits with any number of BLAS threads."""

import os
import subprocess
import sys

import pytest

from omsm_ros.linear_algebra import one_blas_thread

threadpoolctl = pytest.importorskip("threadpoolctl")

_IDENTIFY = """
import hashlib
import numpy as np
from omsm_ros.core.identification.identify import identify
from benchmarks.step_test import StepTest
from omsm_ros.core.streams.motion_record import MotionRecord
from scipy import signal
from threadpoolctl import threadpool_info
time = np.arange(round(StepTest().duration / 1e-3)) * 1e-3
z = StepTest().positions(time).z
seen = signal.lfilter([0.2], [1, -0.8], z) + 2e-7 * np.sin(2 * np.pi * 7.0 * time)
seen += np.random.default_rng(3).normal(0, 1e-8, len(z))
threads = [p["num_threads"] for p in threadpool_info() if p["user_api"] == "blas"]
ok = np.ones(len(z), bool)
found = identify(MotionRecord(sample_period=1e-3, z=z, distance=40e-6 - seen, ok=ok))
assert threads == [p["num_threads"] for p in threadpool_info() if p["user_api"] == "blas"]
known = found.calibration
numbers = [known.dynamics.numerator, known.dynamics.denominator, known.covariance.ravel()]
numbers += [[known.dynamics.delay, known.static_gain], found.fit.residual]
print(max(threads, default=0), hashlib.sha256(np.concatenate(numbers).tobytes()).hexdigest())
"""


def identified(threads: str) -> tuple[int, str]:
    """Return the number of threads that BLAS has outside, and the digest of a calibration."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS")
    environment = os.environ | dict.fromkeys(names, threads)
    done = subprocess.run(
        [sys.executable, "-c", _IDENTIFY],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    outside, digest = done.stdout.split()
    return int(outside), digest


@pytest.mark.soak
def test_threads_of_blas_change_no_bit_of_a_calibration():
    one, two = identified("1"), identified("2")
    if two[0] < 2:
        pytest.skip("BLAS has one thread here, whatever is asked for")
    assert one[1] == two[1]


def threads_of_blas() -> set[int]:
    info = threadpoolctl.threadpool_info()
    return {library["num_threads"] for library in info if library["user_api"] == "blas"}


def test_the_limit_ends_with_the_last_that_asks_for_it():
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        before = threads_of_blas()
        with one_blas_thread():
            with one_blas_thread():
                assert threads_of_blas() <= {1}
            assert threads_of_blas() <= {1}
        assert threads_of_blas() == before
