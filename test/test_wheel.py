"""The wheel: ``pip install`` gives the offline commands where there is no ROS."""

import ast
import importlib.metadata
import json
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import yaml

import omsm_ros
from omsm_ros.nodes import start

ROOT = Path(omsm_ros.__file__).resolve().parent.parent
SOURCES = ("omsm_ros", "msg_defs", "config", "launch", "resource", "bootstrap")
FILES = ("setup.py", "setup.cfg", "pyproject.toml", "package.xml", "MANIFEST.in", "README.md")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel of this tree, built from a copy, for setuptools writes beside its sources."""
    pytest.importorskip("setuptools", reason="setuptools builds the wheel")
    copy = tmp_path_factory.mktemp("copy")
    for folder in SOURCES:
        shutil.copytree(ROOT / folder, copy / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for name in FILES:
        shutil.copy(ROOT / name, copy / name)
    out = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps"]
    command += ["--no-build-isolation", "--disable-pip-version-check", "--wheel-dir", out, copy]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (built,) = out.glob("omsm_ros-*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """Where the wheel lies unpacked, far from this tree."""
    folder = tmp_path_factory.mktemp("site")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def run(installed, *arguments):
    """``omsm`` of the unpacked wheel, in a Python that sees neither this tree nor ROS's paths."""
    program = (
        f"import sys; sys.path.insert(0, {str(installed)!r})\n"
        "sys.modules['rclpy'] = sys.modules['omsm_msgs'] = None  # importing either fails\n"
        "import omsm_ros, omsm_ros.cli\n"
        f"assert omsm_ros.__file__.startswith({str(installed)!r}), omsm_ros.__file__\n"
        f"sys.exit(omsm_ros.cli.main({[str(a) for a in arguments]!r}))"
    )
    return subprocess.run(
        [sys.executable, "-I", "-c", program],
        cwd=installed, capture_output=True, text=True, timeout=200, check=False,
    )  # fmt: skip


def test_it_plans_and_predicts_without_ros(installed, tmp_path):
    planned = run(installed, "plan", "steps", "--out", tmp_path / "plan", "--json")
    assert planned.returncode == 0, planned.stderr
    assert json.loads(planned.stdout)


def test_what_a_command_reads_at_run_time_is_in_it(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    tracked = {
        path.relative_to(ROOT).as_posix()
        for kind in ("html", "css", "js", "json", "yaml", "xml", "py")
        for path in (ROOT / "omsm_ros").rglob(f"*.{kind}")
        if "interfaces" not in path.parts
    }
    assert tracked <= names
    texts = {f"omsm_ros/interfaces/{p.parent.name}/{p.name}" for p in ROOT.glob("msg_defs/*/*.*")}
    assert {t for t in texts if t.endswith((".msg", ".srv"))} <= names


def test_it_installs_every_command(wheel):
    with zipfile.ZipFile(wheel) as archive:
        (points,) = [n for n in archive.namelist() if n.endswith("entry_points.txt")]
        reported = archive.read(points).decode()
    assert set(re.findall(r"^(\w+) = ", reported, re.MULTILINE)) == {"omsm", *start.NODES}


@pytest.mark.parametrize("absent", ["rclpy", "omsm_msgs"])
def test_a_node_that_finds_no_ros_ends_in_one_line(installed, absent):
    """Covers ``pip install`` without ROS, and ``ros2 run`` without the messages."""
    program = (
        f"import sys, types; sys.path.insert(0, {str(installed)!r})\n"
        "sys.modules['rclpy'] = sys.modules['omsm_msgs'] = types.ModuleType('stand_in')\n"
        f"sys.modules[{absent!r}] = None  # importing it fails\n"
        "from omsm_ros.nodes import start\n"
        "sys.argv = ['/usr/bin/corrector']\n"
        "start.main()"
    )
    done = subprocess.run(
        [sys.executable, "-I", "-c", program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"corrector: import of {absent} halted")
    assert "make setup" in line


def licence(package):
    """Return the licence that a package states: expression, classifiers, or its first lines."""
    about = importlib.metadata.metadata(package)
    classifiers = [c for c in about.get_all("Classifier", []) if c.startswith("License")]
    return " ".join([about.get("License-Expression", ""), *classifiers, about.get("License", "")])


@pytest.mark.parametrize(
    "package",
    [
        re.split(r"[<>=]", line)[0].strip()
        for line in (ROOT / "bootstrap" / "runtime.in").read_text().splitlines()
        if line.strip()
    ],
)
def test_no_required_package_is_under_the_gpl(package):
    reported = licence(package)[:400]
    assert reported, f"{package} states no licence"
    assert not re.search(r"(?<!L)GPL|(?<!Lesser )General Public", reported)
    listed = (ROOT / "docs" / "licences.md").read_text(encoding="utf-8")
    assert f"| {package} |" in listed


def test_the_licence_of_each_optional_package_is_named():
    (extras,) = [
        ast.literal_eval(keyword.value)
        for node in ast.walk(ast.parse((ROOT / "setup.py").read_text(encoding="utf-8")))
        if isinstance(node, ast.Call)
        for keyword in node.keywords
        if keyword.arg == "extras_require"
    ]
    listed = (ROOT / "docs" / "licences.md").read_text(encoding="utf-8")
    named = {
        re.split(r"[\[<>=;]", one)[0] for name in extras.keys() - {"test"} for one in extras[name]
    }
    assert {"h5py", "websockets"} <= named
    assert not {name for name in named if not re.search(rf"^\| {name}\b", listed, re.I | re.M)}


def test_workflows_and_citation_are_whole():
    workflow = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text(encoding="utf-8"))
    assert workflow["jobs"]["wheels"]["strategy"]["matrix"]["python"][0] == "3.10"
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == omsm_ros.__version__
