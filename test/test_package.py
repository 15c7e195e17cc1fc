"""package.xml is valid after REP 149 and names all that the package needs, and nothing else."""

import ast
import re
import sys
from pathlib import Path

import pytest

import omsm_ros

ROOT = Path(omsm_ros.__file__).resolve().parent.parent
# Python modules that are not ROS packages: what pip and what rosdep call them.
ROSDEP = {
    "numpy": ("numpy", "python3-numpy"),
    "scipy": ("scipy", "python3-scipy"),
    "matplotlib": ("matplotlib", "python3-matplotlib"),
    "rosbags": ("rosbags", "python3-rosbags-pip"),
    "serial": ("pyserial", "python3-serial"),
    "yaml": ("PyYAML", "python3-yaml"),
    "lz4": ("lz4", "python3-rosbags-pip"),  # which brings it: rosdep has no key
    "jinja2": ("jinja2", "python3-jinja2"),
    "jsonschema": ("jsonschema", "python3-jsonschema"),
    "tqdm": ("tqdm", "python3-tqdm"),
    "control": ("control", "python-control-pip"),
    "cobs": ("cobs", "python-cobs-pip"),
    "mcap": ("mcap", "mcap-ros2-support"),
    # rosdep has no key; it is optional.
    "threadpoolctl": ("threadpoolctl", None),
}

# Imported where they are used, and only there; `pip install omsm_ros[extra]` has them.
OPTIONAL = {
    "h5py": "formats",
    "nptdms": "formats",
    "distributed": "campaign",
    "pyads": "devices",
    "pandablocks": "devices",
    "shtab": "completion",
    "websockets": "viewer",
    "nidaqmx": "devices",
    "sqlalchemy": "catalogue",
    "pandas": "pandas",
    "xarray": "pandas",
}


def parsed(folder):
    package = pytest.importorskip("catkin_pkg.package", reason="catkin_pkg is not installed")
    warnings = []
    found = package.parse_package(str(folder / "package.xml"), warnings=warnings)
    assert warnings == []
    return found


def imported(folder):
    """Foreign top-level modules that the Python files below ``folder`` import."""
    for path in (ROOT / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [node.module]
            yield from (name.split(".")[0] for name in names)


@pytest.fixture(scope="module")
def needed():
    own = {*sys.stdlib_module_names, *OPTIONAL, "omsm_ros"}
    return {*imported("omsm_ros"), *imported("launch")} - own


@pytest.mark.parametrize("folder", [ROOT, ROOT / "msg_defs"], ids=["omsm_ros", "omsm_msgs"])
def test_the_manifest_is_valid(folder):
    package = parsed(folder)
    package.validate()
    assert package.package_format == 3
    assert package.version == omsm_ros.__version__


def test_the_manifest_names_all_that_is_imported_and_nothing_else(needed):
    declared = {dependency.name for dependency in parsed(ROOT).exec_depends}
    keys = {ROSDEP[name][1] if name in ROSDEP else name for name in needed}
    assert declared == keys - {None}


def test_the_manifest_names_the_ros_packages_that_the_tests_import():
    package = parsed(ROOT)
    declared = {each.name for each in (*package.exec_depends, *package.test_depends)}
    texts = (path.read_text(encoding="utf-8") for path in (ROOT / "test").rglob("*.py"))
    used = {
        name
        for text in texts
        for name in re.findall(r"^(?:from|import) (\w+_(?:msgs|srvs|interfaces))\b", text, re.M)
    }
    assert {"action_msgs", "std_srvs"} <= used <= declared


def test_what_is_built_against_is_also_there_at_run_time():
    package = parsed(ROOT)
    built = {dependency.name for dependency in package.build_depends}
    assert built <= {dependency.name for dependency in package.exec_depends}


def test_pip_installs_what_is_imported_and_not_ros(needed):
    lines = (ROOT / "bootstrap" / "runtime.in").read_text(encoding="utf-8").splitlines()
    listed = {line.split(">")[0].split("<")[0].split("=")[0].strip() for line in lines if line}
    assert listed == {ROSDEP[name][0] for name in needed if name in ROSDEP}


def test_the_readme_says_what_rosdep_cannot_install():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for name, key in ROSDEP.values():
        assert key or f"`{name}`" in readme


def test_what_is_optional_is_an_extra():
    setup = (ROOT / "setup.py").read_text(encoding="utf-8")
    found = re.search(r"extras_require=(\{.*?\}),", setup, re.DOTALL)
    extras = ast.literal_eval(found[1])
    for package, extra in OPTIONAL.items():
        assert any(line.lower().startswith(package) for line in extras[extra])


def test_each_locked_package_has_its_hashes():
    text = (ROOT / "bootstrap" / "lock.txt").read_text(encoding="utf-8")
    locked = re.split(r"^(?=\w)", text, flags=re.MULTILINE)[1:]
    assert len(locked) > 200
    assert all("==" in package and "--hash=sha256:" in package for package in locked)
    assert "--require-hashes" in (ROOT / "bootstrap" / "install.sh").read_text(encoding="utf-8")
