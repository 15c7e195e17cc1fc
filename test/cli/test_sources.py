"""Sources of a machine from recordings: of plain formulas, and of the twin by command."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from soaked import soaked

from omsm_ros import cli
from omsm_ros.core.adjustment.scan_data import ScanData
from omsm_ros.core.adjustment.source_evaluation import KINDS, evaluate_sources
from omsm_ros.core.adjustment.verdict import Reason, Verdict
from omsm_ros.core.correction.machine_sources import NAMES, OF_CALIBRATION
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import DataError
from omsm_ros.io.descriptions import load_sources
from omsm_ros.pipelines.adjust import priors_of, verdict_entry

from .written import facts

RATE_HZ, NOISE = 500.0, 8e-9


def recording(kind, seed, walk=1e-9, rate=0.3e-9):
    """Return a recording by formulas of this file alone, and the true sizes of its sources."""
    random = np.random.default_rng(seed)
    time = np.arange(30 * RATE_HZ) / RATE_HZ
    zero = np.zeros_like(time)
    slide, c, distance, made = zero + 5e-3, zero, zero, zero
    true = {"drift_rate": rate, "drift_walk": walk}
    if kind == "still":
        true["probe_noise"] = NOISE
    if kind == "passes":
        slide = 5e-3 * (1 - np.cos(2 * np.pi * time / 3))
        made = 40e-9 * np.sin(slide / 2e-3)
    if kind in ("turned", "stand_offs"):
        c = 2 * np.pi * time
        true = {}
    if kind == "turned":
        slide = 1e-2 * (1 - time / time[-1])
        made = 10e-9 * np.cos(2 * c + 1) + 6e-9 * np.sin(3 * c) + 20e-9 * (slide / 1e-2) ** 2
        true = {"spindle_axial/2": 10e-9 / 2**0.5, "spindle_axial/3": 6e-9 / 2**0.5,
                "spindle_axial/5": 0.0}  # fmt: skip
    if kind == "stand_offs":
        distance = 3e-5 * np.sin(2 * np.pi * np.floor(time) / 15)
        made = 30e-9 * np.cos(3 * c) - 2e-4 * distance + 15e-9 * (distance / 3e-5) ** 3
        true = {"static_gain": 2e-4, "probe_linearity": 15e-9}
    steps = random.normal(size=len(time)) / RATE_HZ**0.5
    height = made + rate * time + walk * np.cumsum(steps) + random.normal(0, NOISE, len(time))
    x, y = slide * np.cos(c), -slide * np.sin(c)
    scan = ScanData(time=time, x=x, y=y, height=height, distance=distance, motion=height - distance,
                    removed=zero, c=c)  # fmt: skip
    return scan, true


@pytest.mark.parametrize("seeds", [1, *soaked(4)])
@pytest.mark.parametrize("kind", KINDS)
def test_each_source_is_found_within_its_uncertainty(kind, seeds):
    deviates = {}
    for seed in range(seeds):
        scan, true = recording(kind, seed)
        found, missing = evaluate_sources(kind, scan, Flat())
        assert not missing
        sizes = {f"{s.name}/{s.per_turn:g}" if s.per_turn else s.name: s for s in found}
        for name, size in true.items():
            one = sizes[name]
            deviates.setdefault(name, []).append((one.found - size) / one.uncertainty)
            # The declared value covers what the machine has, and is no mere bound.
            assert size / 2 < one.value < 2.5 * size + 3 * one.uncertainty
    assert set(deviates) == set(true)
    for name, found in deviates.items():
        assert np.sqrt(np.mean(np.square(found))) < 2.5, name


@pytest.mark.parametrize("kind", ["still", "passes"])
def test_a_recording_of_another_kind_is_refused(kind):
    scan, _ = recording("turned", 0)
    with pytest.raises(DataError, match="the axes do not move as in a recording"):
        evaluate_sources(kind, scan, Flat())


def test_the_twin_makes_recordings_of_which_the_command_writes_the_sources(
    capsys, tmp_path, calibration
):
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(
        "machine:\n  mount: {centre_x: 3.0e-6, centre_y: -5.0e-6}\n"
        "  drift: {ramp_m_per_s: 2.0e-10, random_walk_m_per_root_s: 1.5e-9}\n"
    )
    made = ("twin", "--out", tmp_path, "--disturbances", wrong, "--recordings", "still", "sphere")
    assert cli.main([*map(str, made)]) == 0
    capsys.readouterr()
    out = tmp_path / "sources.yaml"
    out.write_text("# Lathe 1\nschema: omsm-sources/1\nsources:\n"
                   "  - {source: drift_walk, value: 9e-9, unit: m/√s, how: declared, reason: old}\n"
                   "  - {source: beam, value: 1.0e-3, unit: '1', how: declared, reason: old}\n",
                   encoding="utf-8")  # fmt: skip
    words = ("--calibration", calibration, "--out", out)
    facts(capsys, "sources", "still", tmp_path / "still.mcap", *words)
    sphere = facts(
        capsys, "sources", "sphere", tmp_path / "sphere.mcap", "--radius", "0.05", *words
    )
    assert sphere["not_shown"] == ["beam"]
    text = out.read_text(encoding="utf-8")
    assert text.startswith("# Lathe 1\n")
    entries = {item["source"]: item for item in yaml.safe_load(text)["sources"]}
    assert entries["beam"]["how"] == "declared"
    for name, size in (("centre_x", 3e-6), ("centre_y", 5e-6), ("drift_walk", 1.5e-9)):
        item = entries[name]
        assert abs(item["found"] - size) < 3 * item["uncertainty"], name
        assert item["uncertainty"] < 0.3 * size
        assert item["recording"].endswith(".mcap")
        assert "UTC" in item["date"]
        assert item["command"].startswith("omsm sources ")
    assert {s.source: s.origin for s in load_sources(out).stated}["centre_y"] == "evaluated"


def test_a_stated_linearity_counts_for_the_square_of_the_distance_too(tmp_path):
    """A file of sources knows one linearity error; the adjustment has two shapes of it."""
    (tmp_path / "sources.yaml").write_text(
        "schema: omsm-sources/1\nsources:\n  - {source: probe_linearity, value: 3.0e-9, unit: m, "
        "half_range: 5.0e-5, how: evaluated, reason: five stand-offs of 2026-03-02}\n",
        encoding="utf-8",
    )  # fmt: skip
    priors = priors_of(load_sources(tmp_path / "sources.yaml"))
    assert {(p.name, p.uncertainty, p.evaluated, p.half_range) for p in priors} == {
        ("probe_linearity", 3e-9, True, 5e-5),
        ("probe_square", 3e-9, True, 5e-5),
    }


@pytest.mark.parametrize(
    ("entry", "counts"),
    [
        ("reason: sphere.mcap of 2026-03-02", True),
        ("reason: test report, date: 2026-03-02", True),
        ("reason: r, recording: still.mcap, date: 2026-03-02 10:00 UTC", True),
        ("reason: test report of X", True),
        ("reason: '2026-03-02'", False),
        *((f"reason: {text}, date: 2026-03-02", False)
          for text in ("none", "n/a", "'-'", "assumed", "a guess", "unknown")),
    ],
)  # fmt: skip
def test_an_evaluation_says_from_what(tmp_path, entry, counts):
    path = tmp_path / "sources.yaml"
    source = "{source: centre_x, value: 1.0e-6, unit: m, how: evaluated, "
    listed = f"schema: omsm-sources/1\nsources:\n  - {source}{entry}}}\n"
    path.write_text(listed, encoding="utf-8")
    stated = load_sources(path)
    assert stated.stated[0].origin == ("evaluated" if counts else "declared")
    assert [p.evaluated for p in priors_of(stated)] == [counts]
    assert [s.origin for s in stated.scan_sources()] == [stated.stated[0].origin]


def test_a_verdict_says_what_would_verify_each_source_it_rests_on():
    resting = (("squareness", 3e-9, "beyond_centre"), ("pitch", 2e-9, "reference_artefact"),
               ("centre_x", 1e-9, "beyond_centre"))  # fmt: skip
    text = verdict_entry(Verdict("verified", (), resting))["rests_on"]["text"]
    _, scan, artefact = text.split(". ")
    assert scan == (
        "To verify squareness of X to the spindle, spindle centre in x, scan the part again at "
        "twice the speed, with X in the other direction and beyond the centre by 0.3 of the radius"
    )
    assert artefact.endswith("measure a reference artefact")


@pytest.mark.parametrize(
    ("family", "declared"),
    [("creep", None), ("probe_square", "probe_linearity"), ("spindle_axial/3", "spindle_axial"),
     ("centre_x", "centre_x"), ("lag_x", None), ("c_error/2", "c_error"),
     ("positioning_x", "positioning_x")],
)  # fmt: skip
def test_only_what_a_file_of_sources_accepts_is_to_be_declared(family, declared):
    reason = Reason("not_evaluated", (family, "other_speed"), 3e-8, 2e-8)
    (said,) = verdict_entry(Verdict("not_verified", (reason,)))["reasons"]
    assert said["names"][0] == family
    assert (f"or declare {declared} with" in said["text"]) == (declared is not None)
    assert ("declare" in said["text"]) == (declared is not None)
    assert declared in (None, *(set(NAMES) - set(OF_CALIBRATION)))
