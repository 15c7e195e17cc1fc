"""Scans that several tests of the correction share."""

from __future__ import annotations

import pytest

from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.twin.cell import Cell, Probe, Recording, record

from .corrected_runs import SPIRAL


@pytest.fixture(scope="session")
def scan() -> Recording:
    return record(Cell(), SPIRAL, PAPER_MIRROR)


@pytest.fixture(scope="session")
def quiet_scan() -> Recording:
    probe = Probe(noise=0.0, resolution=0.0)
    return record(Cell(probe=probe, encoder_noise=0.0), SPIRAL, PAPER_MIRROR)
