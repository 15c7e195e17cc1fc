"""Effects of the options of ``omsm form`` and ``compensate``, against closed forms."""

import json

import numpy as np
import pytest

from omsm_ros import cli
from omsm_ros.errors import ConfigurationError

RADIUS, POINTS = 10e-3, 30_000
COARSE_M, FINE_M = 2e-3, 0.5e-3


def passed(wavelength, cutoff):
    """Return the share of a wave that a Gaussian filter passes (ISO 16610-21)."""
    return 2.0 ** -((cutoff / wavelength) ** 2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Write a paraboloid with a wave of 20 nm rms across and a finer one of 10 nm along."""
    made = tmp_path_factory.mktemp("part")
    share = (np.arange(POINTS) + 0.5) / POINTS
    r, angle = RADIUS * np.sqrt(share), np.pi * (1 + 5**0.5) * np.arange(POINTS)
    x, y = r * np.cos(angle), r * np.sin(angle)
    coarse = 20e-9 * np.sqrt(2) * np.sin(2 * np.pi * x / COARSE_M)
    fine = 10e-9 * np.sqrt(2) * np.sin(2 * np.pi * y / FINE_M)
    np.savetxt(made / "part.xyz", np.stack([x, y, r**2 / 0.2 + coarse + fine], 1), fmt="%.15g")
    (made / "mirror.yaml").write_text("shape: asphere\nradius: 0.1\nconic_constant: -1\n")
    return made


@pytest.fixture
def facts(capsys, tmp_path, folder):
    """Run a command on the part; return its JSON and its folder."""

    def run(command, *more):
        out = tmp_path / f"out{len(list(tmp_path.iterdir()))}"
        words = [command, folder / "part.xyz", "--nominal", folder / "mirror.yaml", "--unit", "m"]
        words += ["--fit", "piston,tip,tilt", "--out", out, *more, "--json"]
        status = cli.main([str(word) for word in words])
        said = capsys.readouterr()
        assert status == 0, said.err
        return json.loads(said.out), out

    return run


def roughness(found):
    return found["deviation"]["Sq"]["value"]


@pytest.mark.soak
def test_the_s_filter_takes_shorter_waves_out_of_the_texture(facts):
    cutoffs = (1.0e-3, 1.5e-3)
    left = [roughness(facts("form", "--no-report", "--s-filter", c)[0]) for c in cutoffs]
    # At most a sixteenth of the fine wave is left, which is negligible in squares; at the rim a
    # filter has half of its weights.
    expected = passed(COARSE_M, cutoffs[1]) / passed(COARSE_M, cutoffs[0])
    assert left[1] / left[0] == pytest.approx(expected, rel=0.02)


@pytest.mark.soak
def test_the_l_filter_takes_longer_waves_out_of_the_texture(facts):
    cutoffs = (2e-3, 4e-3)
    fine = ("--s-filter", 1e-3)
    left = [roughness(facts("form", "--no-report", *fine, "--l-filter", c)[0]) for c in cutoffs]
    expected = (1 - passed(COARSE_M, cutoffs[0])) / (1 - passed(COARSE_M, cutoffs[1]))
    assert left[0] / left[1] == pytest.approx(expected, rel=0.03)


@pytest.mark.soak
@pytest.mark.parametrize("per_turn", [90, 240])
def test_the_spiral_of_the_next_cut_has_so_many_places_a_turn(facts, per_turn):
    feed = 5e-4
    found, out = facts(
        "compensate", "--low-pass", 4e-3, "--spiral", feed, "--per-turn", per_turn,
    )  # fmt: skip
    lines = [line for line in (out / "compensation.nc").read_text().splitlines() if "X" in line]
    assert found["path_places"] <= len(lines) + 1
    assert found["path_places"] == pytest.approx(per_turn * RADIUS / feed, rel=0.1)


@pytest.mark.parametrize("per_turn", ["-360", "1"])
def test_a_spiral_needs_places_on_each_turn(per_turn, tmp_path, capsys):
    words = ["compensate", "any.ply", "--nominal", "any.yaml", "--low-pass", "4e-3"]
    words += ["--spiral", "1e-4", f"--per-turn={per_turn}", "--out", str(tmp_path / "out")]
    assert cli.main(words) == 2
    assert "places a turn is" in capsys.readouterr().err


@pytest.mark.soak
def test_a_compensation_is_of_the_aperture_alone(facts):
    whole, _ = facts("compensate", "--low-pass", 4e-3)
    part, out = facts("compensate", "--low-pass", 4e-3, "--aperture", "5e-3")
    table = np.loadtxt(out / "compensation.csv", delimiter=",", skiprows=1)
    assert np.max(np.hypot(table[:, 0], table[:, 1])) < 5.2e-3
    assert part["places"] < whole["places"]


def test_the_title_block_stands_on_the_page_and_an_unknown_entry_is_named(tmp_path):
    """The same file serves a report and a certificate."""
    from omsm_ros.cli.arguments import _origin
    from omsm_ros.report.measurement.page import Report, render

    file = tmp_path / "origin.yaml"
    file.write_text("title: First cut\npart: S80-07\ntemperature_c: 20.1\n")
    page = render(Report("Surface", "today", {}, origin=_origin(str(file))))
    assert "<h1>First cut</h1>" in page
    assert "<dt>part</dt><dd>S80-07</dd>" in page
    assert "<dt>temperature</dt><dd>20.1" in page
    with pytest.raises(ConfigurationError, match="'pert'"):
        _origin('{"pert": "S80-07"}')
