"""Where scans count from, and noise of the encoder in the columns."""

from dataclasses import replace

import numpy as np
import pytest
from coverage import PRIORS
from plain_world import MIRROR, Machine

from omsm_ros.core.adjustment.adjust import _network
from omsm_ros.core.adjustment.agreement import agreement_of
from omsm_ros.core.adjustment.network import solve
from omsm_ros.core.adjustment.refutation import start_scales
from omsm_ros.core.adjustment.scan_data import ScanData, delayed, view_of, zero_of
from omsm_ros.core.adjustment.sources import prior_sizes


@pytest.fixture(scope="module")
def scans():
    machine = Machine(1, pitch=0.8e-3)
    return [machine.scan(60), machine.scan(90, outward=True)]


def test_zeros_of_machine_and_probe_are_no_error_of_either(scans):
    """Z a quarter of a metre off, the gap half a millimetre: the same design and heights."""
    far = [
        replace(s, motion=s.motion - 0.25, distance=s.distance + 5e-4, height=s.height - 0.2495)
        for s in scans
    ]
    networks = [
        _network(all_, [view_of(s, k, zero_of(all_, MIRROR), MIRROR) for k, s in enumerate(all_)],
                 PRIORS)
        for all_ in (scans, far)
    ]  # fmt: skip
    near, moved = (network.blocks for network in networks)
    np.testing.assert_allclose(moved.deviation, near.deviation, atol=1e-15)
    size = np.max(np.abs(near.columns), axis=0)
    # The rate of Z less that of the part, here nearly zero: rounded as each of the two is.
    place = networks[0].place
    size[place["latency_change"]] = size[place["lag_change"]]
    # Steps of doubles at 0.25 m are 5e-17 m: 1e-10 m/s² over 1 ms², of up to 0.1 m/s².
    np.testing.assert_allclose(moved.columns / size, near.columns / size, atol=1e-9)


def test_the_acceleration_has_no_noise_of_its_own_turn(scans):
    """White noise of 3 nm: its product with the acceleration, which in one turn is −n² times the
    middle of the differentiator, is zero within chance; the acceleration itself is kept."""
    scan = scans[0]
    noise = 3e-9 * np.random.default_rng(3).standard_normal(len(scan))
    noisy = replace(scan, motion=scan.motion + noise)
    clean, seen = (
        view_of(s, 0, zero_of([s], MIRROR), MIRROR).motion_acceleration for s in (scan, noisy)
    )
    middle = slice(1500, -1500)
    off = (seen - clean)[middle]
    product = noise[middle] * off
    assert abs(np.mean(product)) < 4 * np.std(product) / np.sqrt(len(product))
    exact = np.gradient(np.gradient(scan.motion, 1e-3), 1e-3)[middle]
    assert np.std(clean[middle] - exact) < 0.02 * np.std(exact)


def test_scans_of_one_form_have_one_rms(scans):
    """A machine without errors, tracks half a pitch apart: rms as of the part, in both scans."""
    machine = Machine(5, noise=0.1e-9, walk=1e-12, ramp=0.0, spindle=(), pitch=0.9e-3)
    two = [machine.scan(30), machine.scan(60, outward=True, start=12.25e-3, end=0.45e-3)]
    zero = zero_of(two, MIRROR)
    views = [view_of(s, k, zero, MIRROR) for k, s in enumerate(two)]
    network = _network(two, views, PRIORS)
    sizes = prior_sizes(network.families, PRIORS)
    solution = solve(network, network.blocks.deviation, start_scales(network, 1e-12), sizes)
    pose = ("piston", "tip", "tilt")
    one, other = (a.alone[1].value for a in agreement_of(solution, MIRROR, pose))
    assert one == pytest.approx(other, rel=2e-3)


@pytest.mark.parametrize("lost", [[], [2000, 2001, 2500]])
def test_motions_of_the_fourth_degree_have_exact_derivatives(lost):
    """On a spiral, and next to readings that are missing."""
    t = np.delete(1e-3 * np.arange(4000), lost)
    z = 1e-6 * (3.0 + 2.0 * t - 4.0 * t**2 + 0.7 * t**3 - 0.2 * t**4)
    place, rate = (10e-3 - 1e-3 * t) * np.exp(-6j * t), -1e-3 - 6j * (10e-3 - 1e-3 * t)
    scan = ScanData(time=t, x=place.real, y=place.imag, height=z, distance=0 * z, motion=z,
                    removed=0 * z, c=6 * t)  # fmt: skip
    seen = view_of(scan, 0, zero_of([scan], MIRROR), MIRROR)
    np.testing.assert_allclose(
        seen.motion_rate, 1e-6 * (2.0 - 8.0 * t + 2.1 * t**2 - 0.8 * t**3), atol=1e-13
    )
    rate = rate * np.exp(-6j * t)
    # A wave of one a second is no polynomial: a millionth at the ends of a run.
    np.testing.assert_allclose(seen.x_rate + 1j * seen.y_rate, rate, atol=6e-8)
    late = 3e-3
    before = (10e-3 - 1e-3 * (t - late)) * np.exp(-6j * (t - late))
    moved = delayed(scan, late)
    np.testing.assert_allclose(moved.x + 1j * moved.y, before, atol=1e-15)
