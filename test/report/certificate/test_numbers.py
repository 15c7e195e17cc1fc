"""Headlines and tables of a certificate, against its entries."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from certified import certified_by

from omsm_ros.core.lti.modes import known_modes
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.report.certificate.tables import (
    mode_table,
    order_table,
    shape_table,
    two_mass_table,
    undetected_table,
)

from .certificates import by_name, certified


class TestNumbers:
    def test_headlines(self, calibration):
        entries, found = calibration.certificate, by_name(calibration)
        delay = re.fullmatch(r"([\d.]+) µs ± ([\d.]+) µs", found["Low-frequency delay"])
        assert float(delay[1]) == pytest.approx(
            1e6 * entries.response.low_frequency_delay_s, abs=0.06
        )
        uncertainty = 1e6 * entries.response.low_frequency_delay_uncertainty_s
        assert float(delay[2]) == pytest.approx(uncertainty, rel=0.05)
        gain = re.fullmatch(r"([\d.]+) ± ([\d.]+)", found["Static gain, probe per encoder"])
        assert float(gain[1]) == pytest.approx(calibration.static_gain, abs=1e-6)
        assert float(gain[2]) == pytest.approx(entries.static_gain.uncertainty, rel=0.05)
        assert found["Noise of one reading"] == f"{1e9 * entries.residual.noise_m:.1f} nm"
        assert found["Structure"].startswith("2 poles")

    def test_the_lowest_bic_has_none_below_it(self, calibration):
        rows = order_table(calibration).rows
        above = [float(row[1]) for row in rows]
        assert min(above) == 0
        assert [row[0] for row in rows if "lowest" in row[3]] == [rows[int(np.argmin(above))][0]]
        chosen = [row[0] for row in rows if "chosen" in row[3]]
        assert chosen == [by_name(calibration)["Structure"]]

    def test_modes_say_whether_the_band_reaches_them(self, calibration):
        for valid, word in ((1.0, "no"), (400.0, "yes")):
            rows = mode_table(replace(calibration, valid_up_to=valid)).rows
            below = [m.frequency <= valid for m in known_modes(calibration.dynamics)]
            assert [row[4] == "yes" for row in rows] == below
            assert word in {row[4] for row in rows}

    def test_a_mode_has_frequency_damping_and_residue_with_uncertainties(self, calibration):
        omega = 2 * np.pi * 60.0
        lone = replace(
            calibration,
            dynamics=TransferFunction.from_ascending([1.0], [1.0, 0.04 / omega, omega**-2]),
            # The stiffness is uncertain by 0.2 %: half of it in the frequency, all in the residue.
            covariance=np.diag([0.0, 0.0, (2e-3 * omega**-2) ** 2, 0.0]),
        )
        (row,) = mode_table(lone).rows
        frequency, damping, residue = (text.replace("\u202f", " ") for text in row[1:4])
        assert frequency == "60.000 Hz ± 0.060 Hz"
        assert damping == "0.020000 ± 0.000020"
        assert residue == "0.14212 ± 0.00028"

    def test_a_point_beyond_the_trusted_band_says_so(self, calibration):
        shape = {"minimum": 347.0, "minimum_gain": 0.882, "bandwidth_1_percent": 40.0}
        entries = certified(calibration, shape=shape, modal_remainder=0.0066)
        rows = shape_table(replace(entries, valid_up_to=100.0)).rows
        assert [row[2] for row in rows] == ["yes", "no", "yes"]
        assert rows[2][1] == "0.66 %"

    def two_mass_rows(self, mass):
        model = {"m1": mass or 1.0, "m2": 2.0, "k1": 3e7, "k2": 5e6, "c1": 900.0, "c2": 80.0}
        spreads = {"m2": 0.01, "k1": 0.02, "k2": 0.03, "c1": 0.04, "c2": 0.05}
        entry = {
            "table_mass_kg": mass, "model": model, "relative_uncertainty": spreads,
            "misfit": 0.9, "collocated": False,
        }  # fmt: skip
        table = two_mass_table(SimpleNamespace(certificate=certified_by({"two_mass": entry})))
        return table.title, {name: text.replace("\u202f", " ") for name, text in table.rows}

    def test_a_two_mass_model_has_units_and_uncertainties(self):
        _, texts = self.two_mass_rows(40.0)
        assert texts["m1"] == "40.00 kg, as given"
        assert texts["m2"] == "2.000 kg ± 0.020 kg"
        assert texts["k2"] == "5.00 MN/m ± 0.15 MN/m"
        assert texts["c2"] == "80.0 N·s/m ± 4.0 N·s/m"
        assert "not the driven one" in texts["probe on the"]

    def test_without_the_mass_of_the_table_all_is_per_mass(self):
        title, texts = self.two_mass_rows(None)
        assert title.endswith("per mass of the table")
        assert "m1" not in texts
        assert texts["m2 / m1"] == "2.000 ± 0.020"
        assert texts["k2 / m1"] == "5.00 MN/(m·kg) ± 0.15 MN/(m·kg)"
        assert texts["c2 / m1"] == "80.0 N·s/(m·kg) ± 4.0 N·s/(m·kg)"


UNDETECTED = {
    "parameter": 0.0, "size": 0.0, "uncertainty": 0.0, "carried": 0.0, "effect_on_scan_m": 11e-9,
}  # fmt: skip


def test_undetected_error_states_its_time_or_frequency_and_its_unit():
    """A share of the motion for what follows it, a length for the rest."""
    entries = {
        "could_hide": [
            UNDETECTED | {"family": "creep", "parameter": 20.0, "missed": 4e-4},
            UNDETECTED
            | {"family": "soft mode", "parameter": 8.0, "missed": 1e-3, "effect_on_scan_m": 5e-9},
            UNDETECTED | {"family": "backlash", "missed": 3e-9, "effect_on_scan_m": 2e-9},
        ],
        "plateau_that_would_tell_s": 60.0,
    }
    found = undetected_table(SimpleNamespace(certificate=certified_by(entries)))
    rows = [[text.replace("\u202f", " ") for text in row] for row in found.rows]
    assert [row[:2] for row in rows[:3]] == [
        ["creep over 20 s", "0.040 % of the motion"],
        ["soft mode at 8.0 Hz", "0.10 % of the motion"],
        ["backlash", "3.00 nm"],
    ]
    assert [row[3] for row in rows[:3]] == ["11.0 nm", "5.00 nm", "2.00 nm"]
    assert rows[3][:2] == ["dwell that would show the slowest creep", "60.0 s"]
