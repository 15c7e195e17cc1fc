"""The Python interface: arrays in, results out, the same numbers as the commands."""

import doctest
import inspect
import subprocess
import sys

import numpy as np
import pytest

import omsm_ros as omsm
from omsm_ros.errors import BagError, ConfigurationError, DataError, FileError
from omsm_ros.pipelines.record_bags import write_recording
from omsm_ros.twin.plant import PAPER_DYNAMICS
from omsm_ros.twin.scenario import Scenario, planned_test_of, scan_of

PUBLIC = {
    "Adjusted", "Calibration", "Difference", "Form", "Plan", "Points", "Prediction", "Recording",
    "Spectrum", "adjust", "correct", "difference", "form", "identify", "load", "plan", "predict",
    "read", "simulate", "spectrum", "surface",
}  # fmt: skip
MIRROR = omsm.surface("off_axis_paraboloid", parent_focal_length=25.4e-3,
                      off_axis_distance=50.8e-3)  # fmt: skip


@pytest.fixture(scope="module")
def identified():
    return omsm.identify(omsm.simulate("step_test"))


@pytest.fixture(scope="module")
def points(identified):
    return omsm.correct(omsm.simulate("scan"), identified)


def test_the_public_names_stay():
    assert set(omsm.__all__) == PUBLIC
    assert set(dir(omsm)) >= PUBLIC
    assert all(getattr(omsm, name).__doc__ for name in PUBLIC)
    with pytest.raises(AttributeError, match="nothing_of_ours"):
        omsm.nothing_of_ours  # noqa: B018


def test_importing_the_package_loads_neither_numpy_nor_ros():
    code = (
        "import sys, omsm_ros; print(*{'numpy', 'scipy', 'rclpy', 'matplotlib'} & {*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_the_lag_is_that_of_the_simulated_machine(identified):
    truth = PAPER_DYNAMICS.low_frequency_delay
    assert abs(identified.lag - truth) < 3 * identified.lag_uncertainty
    assert identified.lag_uncertainty < 0.02 * truth
    assert identified.verdict.startswith("accepted")


@pytest.mark.soak
def test_arrays_give_the_same_as_a_recording(identified):
    made = omsm.simulate("step_test")
    again = omsm.identify(made.z, made.distance, made.period)
    assert again.core.id == identified.core.id
    with pytest.raises(ConfigurationError, match="distance and period"):
        omsm.identify(made.z)


def test_paths_and_exchanged_arguments_are_named_with_the_remedy(identified):
    for call in (
        lambda: omsm.correct("scan.mcap", identified),
        lambda: omsm.correct(omsm.simulate("scan", radius=1e-3), "cal.json"),
        lambda: omsm.predict(omsm.plan(), "cal.json"),
        lambda: omsm.form("cloud.ply", omsm.surface("flat", level=0.0)),
    ):
        with pytest.raises(ConfigurationError, match=r"is no .*; use omsm\.read or omsm\.load"):
            call()
    with pytest.raises(ConfigurationError, match=r"omsm\.read\(path\)"):
        omsm.identify("steps.mcap")


def test_a_bag_is_read_as_it_was_written(tmp_path):
    made = scan_of(Scenario(start_radius=5e-4))
    back = omsm.read(write_recording(tmp_path / "scan.mcap", made))
    assert np.array_equal(back.z, made.axes.z)
    assert np.array_equal(back.distance, made.distance.distance, equal_nan=True)
    assert back.period == made.axes.sample_period


def test_corrected_heights_are_those_of_the_surface(points):
    truth = scan_of(Scenario(start_radius=2e-3)).surface_height[points.sample]
    off = points.height - truth
    off -= off.mean()
    assert np.std(off) < 1.1 * np.median(points.uncertainty)
    received = points.counted["axes"]["received"]
    left_out = sum(points.counted["axes"]["counted"].values())
    assert len(points) == received - left_out


def test_a_control_system_goes_out_and_back(identified):
    import control  # takes a second to load

    system = identified.to_control()
    frequency = np.array([0.5, 2.0, 10.0])
    np.testing.assert_allclose(
        system(2j * np.pi * frequency), identified.response(frequency), rtol=1e-9
    )
    back = omsm.Calibration.from_control(system, identified.core.sample_period)
    np.testing.assert_allclose(back.response(frequency), system(2j * np.pi * frequency), rtol=1e-9)
    given = omsm.Calibration.from_control(control.ss(control.tf([6.0], [2e-3, 3.0])), 1e-3)
    assert given.lag == pytest.approx(2e-3 / 3, rel=1e-12)
    assert given.core.static_gain == pytest.approx(2.0)
    assert given.verdict == ""
    for refused in (control.tf([1.0], [1.0, 0.5], 1e-3), control.tf([1.0], [1.0, 0.0])):
        with pytest.raises(ConfigurationError, match="continuous"):
            omsm.Calibration.from_control(refused, 1e-3)


def test_the_spectrum_holds_the_mean_square():
    values = np.random.default_rng(1).normal(size=4096)
    found = omsm.spectrum(values, 1e-3)
    assert found.rms() == pytest.approx(np.std(values), rel=0.1)
    line = omsm.spectrum(np.sin(2 * np.pi * 50 * np.arange(4000) * 1e-3), 1e-3)
    assert line.rms(45, 55) == pytest.approx(0.5**0.5, rel=1e-3)


@pytest.fixture(scope="module")
def results(identified, points):
    mirror = MIRROR
    fast = omsm.twin("scan", seed=2, part=1, rpm=60, radius=1e-3)
    scans = [omsm.twin("scan", radius=1e-3), fast]
    return (
        identified,
        scans[0],
        points,
        omsm.form(points, mirror, fit=("piston", "tip", "tilt")),
        omsm.adjust(scans, identified, nominal=mirror),
        omsm.difference(points, omsm.correct(fast, identified), nominal=mirror),
        omsm.spectrum(points.x, 1.0),
        omsm.plan(mirror, radius=1e-3),
        omsm.predict(omsm.plan(mirror, radius=1e-3), identified),
    )


def test_the_same_scan_twice_does_not_verify_itself(results):
    identified, scan, *_ = results
    with pytest.raises(BagError, match="the same scan"):
        omsm.adjust([scan, scan], identified)


def test_points_of_another_surface_are_reported_before_any_other_remedy(results):
    identified, scan, *_ = results
    found = omsm.adjust([scan], identified, nominal=omsm.surface("sphere", radius=-0.02))
    assert str(found).index("another surface") < str(found).index("next: scan")


def test_results_print_in_a_few_lines_and_draw(results):
    assert {type(result).__name__ for result in results} == {n for n in PUBLIC if n[0].isupper()}
    for result in results:
        lines = str(result).splitlines()
        assert 0 < len(lines) <= 15
        assert repr(result) == str(result)
        assert result._repr_html_().count("<tr>") == len(lines)
        assert result.plot().figure.axes
        assert result.to_dict()


def test_what_is_saved_is_loaded(results, tmp_path):
    """Each result reads back with the same arrays and the same text."""
    for result in results:
        kind = "json" if isinstance(result, omsm.Calibration) else "npz"
        result.save(tmp_path / f"a.{kind}")
        back = omsm.load(tmp_path / f"a.{kind}")
        assert type(back) is type(result)
        assert str(back) == str(result)
        for name, values in result.to_dict().items():
            if isinstance(values, np.ndarray):
                assert np.array_equal(getattr(back, name), values, equal_nan=True)
    np.savez(tmp_path / "foreign.npz", x=np.zeros(3))
    for broken in ("foreign.npz", "missing.npz"):
        with pytest.raises(FileError, match="not a saved result"):
            omsm.load(tmp_path / broken)
    with pytest.raises(ConfigurationError, match=r"\.npz"):
        results[2].save(tmp_path / "points.txt")


def test_tables_hold_the_arrays(results):
    pandas = pytest.importorskip("pandas")
    xarray = pytest.importorskip("xarray")
    for result in results:
        assert isinstance(result.to_pandas(), pandas.DataFrame)
        assert isinstance(result.to_xarray(), xarray.Dataset)
    points = results[2]
    assert np.array_equal(points.to_pandas()["height"], points.height)
    assert points.to_xarray()["x"].dims == ("point",)


def test_files_of_the_commands_are_read(results, tmp_path):
    """A bag, a cloud and a table of another instrument."""
    scan, points = results[1], results[2]
    scan.save(tmp_path / "scan.mcap")
    assert np.array_equal(omsm.read(tmp_path / "scan.mcap").z, scan.z)
    table = np.column_stack([points.x, points.y, points.height])[:5] * 1e3
    np.savetxt(tmp_path / "m.csv", table, delimiter=",", header="x_mm,y_mm,z_mm", comments="")
    back = omsm.load(tmp_path / "m.csv")
    np.testing.assert_allclose(back.height, points.height[:5], rtol=1e-12)
    assert np.all(np.isnan(back.uncertainty))
    (tmp_path / "log.csv").write_text("time [ms];z [mm];gap [um]\n0;1,5;25\n1;1,5;50\n2;1,5;25\n")
    still = "".join(f"  {axis}: {{constant: 0}}\n" for axis in "xybc")
    (tmp_path / "map.yaml").write_text(
        'delimiter: ";"\ndecimal: ","\ncolumns:\n  time: {name: "time [ms]", unit: ms}\n'
        '  z: {name: "z [mm]", unit: mm}\n'
        '  distance: {name: "gap [um]", unit: um, sign: -1}\n' + still
    )
    found = omsm.read(tmp_path / "log.csv", tmp_path / "map.yaml")
    np.testing.assert_allclose(found.distance, [-25e-6, -50e-6, -25e-6])
    np.testing.assert_allclose(found.z, 1.5e-3)


def test_the_examples_of_the_functions_run(results, monkeypatch, tmp_path):
    """They go on from a calibration, a scan, its points and surface, as the module's lines do."""
    monkeypatch.chdir(tmp_path)
    names = {
        "np": np, "omsm": omsm, "calibration": results[0], "scan": results[1],
        "points": results[2], "mirror": MIRROR,
    }  # fmt: skip
    functions = [name for name in omsm.__all__ if name[0].islower()]
    examples = [*functions, "Recording"]
    for name in examples:
        (found,) = doctest.DocTestFinder(recurse=False).find(getattr(omsm, name), name)
        assert found.examples, f"{name} has no example"
        found.globs = dict(names)
        ran = doctest.DocTestRunner().run(found)
        assert (ran.attempted, ran.failed) == (len(found.examples), 0), name
    for name in functions:
        assert "\nParameters\n----------\n" in inspect.getdoc(getattr(omsm, name))


FLAT = omsm.surface("flat")
NUMBERS = {
    "period": lambda v: omsm.plan(period=v),
    "rpm": lambda v: omsm.plan(FLAT, rpm=v),
    "radius": lambda v: omsm.plan(FLAT, radius=v),
    "feed": lambda v: omsm.plan(FLAT, feed=v),
    "step": lambda v: omsm.plan(step=v),
    "count": lambda v: omsm.plan(count=v),
    "part": lambda v: omsm.simulate(part=v),
    "accuracy": lambda v: omsm.predict(None, None, accuracy=v),
    "tolerance": lambda v: omsm.adjust([], None, tolerance=v),
    "latency": lambda v: omsm.correct(None, None, latency=v),
    "order": lambda v: omsm.identify([], [], order=v),
    "uncertainty": lambda v: omsm.difference(None, None, uncertainty=v),
}


@pytest.mark.parametrize(
    ("name", "value"),
    [*((name, np.nan) for name in NUMBERS), *(("feed", v) for v in (np.inf, 1e300, "1", True))],
)
def test_a_number_that_cannot_be_is_named_with_its_range(name, value):
    with pytest.raises(ConfigurationError, match=rf"^{name} is .*, expected .* from "):
        NUMBERS[name](value)


@pytest.mark.parametrize("asked", [{"rpm": 1e-3}, {"radius": 1.0}])
def test_a_simulation_that_is_too_large_is_refused(asked):
    with pytest.raises(ConfigurationError, match="expected at most"):
        omsm.simulate(**asked)


def test_a_plan_is_the_motion_of_its_program(results):
    plan = results[7]
    assert plan.gcode.endswith("M2\n")
    assert np.ptp(plan.c) == pytest.approx(2 * np.pi * 30 / 60 * plan.time[-1])
    with pytest.raises(ConfigurationError, match="none of linuxcnc"):
        omsm.plan(dialect="heidenhain")
    with pytest.raises(ConfigurationError, match="rpm, feed: of a scan; give the nominal surface"):
        omsm.plan(rpm=30, feed=1e-4)
    with pytest.raises(ConfigurationError, match="step: of a step test; leave out the nominal"):
        omsm.plan(omsm.surface("flat"), step=1e-6)
    # Its lag makes the error that is predicted: lag times the speed of Z, but for the settling.
    error = results[8].error
    expected = results[0].lag * np.gradient(plan.z, plan.period)[-len(error) :]
    inner = slice(50, -50)
    assert np.std(error[inner] - expected[inner]) < 0.01 * np.std(expected[inner])


def test_what_cannot_be_is_refused():
    with pytest.raises(DataError, match="shape"):
        omsm.Recording(z=np.zeros(3), distance=np.zeros(4), period=1e-3)
    with pytest.raises(ConfigurationError, match="unknown"):
        omsm.simulate("waltz")


def test_the_step_test_is_that_of_the_twin():
    made = omsm.simulate("step_test", seed=4)
    assert np.array_equal(made.z, planned_test_of(Scenario(seed=4, start_radius=2e-3)).axes.z)
