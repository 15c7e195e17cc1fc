"""Numbers as text: prefixes, rounding, and which rows a table has."""

from __future__ import annotations

from dataclasses import replace

from certified import certified_by

from omsm_ros.core.calibration.certificate import Certificate
from omsm_ros.report import tables


def test_part_finds_what_is_there_and_nothing_else():
    nested = {"a": {"b": 3}, "c": 4}
    assert tables.part(nested, "a", "b") == 3
    assert tables.part(nested, "a", "x") is None
    assert tables.part(nested, "c", "b") is None


class TestSampleTable:
    def test_has_a_row_a_reason_and_a_column_a_stream(self, summary):
        summary["samples"]["distance"]["counted"] = {"invalid": 7, "settling": 33}
        table = tables.sample_table(summary)
        assert table.columns == ("axes", "distance")
        assert ("settling", "40", "33") in table.rows
        assert ("invalid", "0", "7") in table.rows

    def test_what_waits_is_shown_only_if_something_does(self, summary):
        assert "still pending" not in {row[0] for row in tables.sample_table(summary).rows}
        summary["samples"]["axes"]["pending"] = 3
        assert ("still pending", "3", "0") in tables.sample_table(summary).rows

    def test_without_an_account_there_are_no_rows(self):
        assert not tables.sample_table({}).rows


class TestCalibrationTable:
    def test_has_what_a_metrologist_asks_for(self, certified):
        certificate = certified_by(
            {
                "static_gain_uncertainty": 3.4e-6,
                "low_frequency_delay_s": 339.7e-6,
                "low_frequency_delay_uncertainty_s": 1.13e-6,
            },
            certified.certificate,
        )
        given_calibration = replace(certified, certificate=certificate)
        rows = dict(tables.calibration_table(given_calibration).rows)
        assert rows["static gain, probe per encoder"] == "0.9921260 ± 0.0000034"
        assert rows["low-frequency delay"] == "339.7 µs ± 1.1 µs"
        assert rows["valid up to"] == "100 Hz"
        assert rows["verdict"] == "accepted"

    def test_leaves_out_what_the_certificate_does_not_say(self, certified):
        rows = dict(tables.calibration_table(replace(certified, certificate=Certificate())).rows)
        assert "verdict" not in rows
        assert "edges used" not in rows
        assert rows["low-frequency delay"] == "339.7 µs"


def test_a_mapping_keeps_its_names_and_writes_its_values_as_json():
    table = tables.mapping_table(
        "Settings", {"probe_rate": 1000, "on": True, "name": "B", "x": [1]}
    )
    assert table.rows == [("probe_rate", "1000"), ("on", "true"), ("name", "B"), ("x", "[1]")]


class TestBudgetAndMotion:
    def test_the_largest_part_comes_first_and_what_nobody_looked_at_is_there(self):
        def row(source, size, height, status="evaluated"):
            return {
                "source": source, "says": "of it", "kind": "random", "status": status,
                "standard_uncertainty": size, "unit": "m", "height": height, "reason": "because",
            }  # fmt: skip

        sources = [
            row("tilt_of_it", None, None, "not evaluated"),
            row("encoder_noise", 2e-9, 1e-9),
            row("probe_noise", 1e-8, 1e-8),
        ]
        rows = tables.budget_table({"budget": {"sources": sources}}).rows
        names = ["of it (probe_noise)", "of it (encoder_noise)", "not evaluated"]
        assert [row[0] for row in rows] == names
        assert rows[2][-1] == "of it (tilt_of_it)"
        assert rows[0][2] == "10.0 nm"
        assert rows[1][1] == "2.0 nm"
        assert rows[2][1:4] == ("–", "–", "–")
        assert tables.budget_table({}).rows == []
