"""Run every command on a page as it is printed, except those in ``NOT_RUN``."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from own_domain import own_domain

from .pages import PAGES, ROOT, filled_in, is_name, lines_of, shown_on
from .workshop import Workshop

HERE = Path(__file__).resolve().parent
REAL_ROS2 = shutil.which("ros2") or ""

# Commands that no test can run, and why; a new command on a page is run.
NOT_RUN = {
    r"git clone|cd ~/ws && git clone": "needs the network, and a repository that is public",
    r"(\S+=\S+ )?rosdep |colcon |\. install/setup\.bash": "need a ROS distribution from apt; "
    "'make setup' builds with colcon, test_package.py holds package.xml and setup.py together",
    r"pip install": "needs the network; test_wheel.py installs the wheel in a fresh environment",
    r"\. \./env\.sh": "the tests run in the shell that it makes",
    r"python -m benchmarks": "minutes to an hour; test_benchmarks.py runs their parts",
    r"dask |.*--scheduler ": "Dask is optional; benchmarks of campaigns run two workers of it",
    r"ros2 security ": "the wheels' Fast DDS is built without security",
    r"ros2 run omsm_ros replay$": "the name of a node; it is run with its bag in recordings.md",
    r"omsm record --(port|device six)|omsm inspect check": "need a sender, which "
    "test_stream_page.py has",
    r"omsm identify STEPS --multisine ": "needs a recording of that plan; see test_several_bags.py",
    r"omsm (demo|history)$": "the name of a command; both are run with their options elsewhere",
    r"omsm (COMMAND|sources KIND)": "a word in capitals stands for others",
    r".*device:=lamp": "needs the package of that page installed; test_adding_a_probe.py has it",
}
NEEDS_LAUNCH = {
    r"ros2 launch omsm_ros replay\.launch\.py": "the stand-in for launch has no events; the node "
    "that it starts is run, and the whole where there is a real ros2"
}
NEEDS_ACTIONS = {
    r"ros2 action ": "the stand-in for ros2 has no actions; test_actions.py sends the same goal"
}
NOT_RUN |= {} if REAL_ROS2 else NEEDS_LAUNCH | NEEDS_ACTIONS

# Commands that a page assumes to have been run before.
CELL = "ros2 launch omsm_ros cell.launch.py params:=my_cell/"
CALIBRATOR = "ros2 run omsm_ros calibrator --ros-args -r __ns:=/omsm"
CHROCODILE = "ros2 launch omsm_ros cell.launch.py emulated:=true device:=chrocodile"
BEFORE = {
    "ros2 service call /omsm/calibrator/identify ": "ros2 play step_test",
    "ros2 service call /omsm/calibrator/identify/_action": CALIBRATOR,
    "ros2 service call /omsm/confocal_driver": CHROCODILE,
    "ros2 lifecycle": CELL,
    "omsm history --machine": "export OMSM_CATALOGUE=shop.sqlite; "
    'omsm identify steps.mcap --out cal.json --settings \'{"machine": "twin"}\'',
    "omsm inspect --repair": "truncate --size=-9999 scan.mcap",
}
EMULATOR = "ros2 run omsm_ros cell_emulator --ros-args -p link:={port} -p time_lapse:=20.0"

# A few seconds of them are in every run, all in `make soak`.
QUICK = re.compile(
    r"docs/commands.md.* omsm (plan steps|surface|completion)"
    r"|README.md.* make |CONTRIBUTING.md|docs/import.md.*import steps|docs/form.md.*surface"
)


def not_run(line):
    return any(re.match(pattern, line) for pattern in NOT_RUN)


def cases():
    """Yield all blocks of a page together, and each command of the text by itself, once."""
    seen = set()
    for path in PAGES:
        shown = shown_on(path)
        # Those of LinuxCNC's page are run by test_linuxcnc.py, where LinuxCNC is installed.
        blocks = [part for part in shown if part.block and path.name != "linuxcnc.md"]
        if blocks:
            yield blocks
        for part in shown:
            if not part.block and part.text not in seen and not is_name(part.text):
                seen.add(part.text)
                yield [part]


def script_of(case):
    """Return the shell script of a case, and the commands in it."""
    script, commands, has = [], [], set()
    for shown in case:
        text = shown.text
        if re.search(r"\b(BAG|SCAN|CAL\.json|[A-Z]{2,}\.yaml|DIR|FILE|MORE|NEW|RECORD)\b", text):
            filled = [filled_in(line) for line in lines_of(shown)]
            text = "\n".join(
                line.replace("--out made", f"--out made{k or ''}") for k, line in enumerate(filled)
            )
        if "FROM TO" not in shown.text:
            commands += lines_of(shown)
        for raw in text.splitlines():
            line = raw.strip()
            if not_run(line):
                continue
            for begin, needed in BEFORE.items():
                if line.startswith(begin) and begin not in has:
                    script.append(needed)
                    has.add(begin)
            script.append(raw)
    return script, [line for line in commands if not not_run(line)]


CASES = [(case, *script_of(case)) for case in cases()]


def parameters():
    for case, script, commands in CASES:
        if commands or script:
            name = f"{case[0].page}:{case[0].line} {case[0].text.splitlines()[0][:60]}"
            quick = QUICK.search(name) and not any("ros2 " in line for line in script)
            marks = () if quick else pytest.mark.soak
            yield pytest.param(case, script, id=name, marks=marks)


@pytest.fixture(scope="session")
def workshop(tmp_path_factory):
    folder = tmp_path_factory.mktemp("workshop")
    return Workshop(folder, folder / "port")


@pytest.fixture(scope="session")
def programs(tmp_path_factory):
    """Return a folder with the programs of the pages: omsm, and substitutes for ros2 and make."""
    folder = tmp_path_factory.mktemp("bin")
    python = f'exec "{sys.executable}"'
    for name, line in (
        ("omsm", f'{python} -W error -m omsm_ros.cli "$@"'),
        ("ros2", f'{python} "{HERE / "ros2.py"}" "$@"'),
        # Dry run, because make would set up or test the checkout that is being tested.
        ("make", f'exec "{shutil.which("make")}" -n -C "{ROOT}" "$@"'),
    ):
        (folder / name).write_text(f"#!/bin/sh\n{line}\n")
        (folder / name).chmod(0o755)
    return folder


@pytest.mark.timeout(400)
@pytest.mark.parametrize(("case", "script"), list(parameters()))
def test_every_command_runs_as_it_stands(case, script, tmp_path, workshop, programs):
    text = "\n".join(script).replace("/path/to/", "config/")
    nodes = tmp_path / "log" / "nodes"
    home, there = tmp_path / "home", tmp_path / "there"
    for folder in (nodes.parent, home, there):
        folder.mkdir()
    workshop.lay_out(text, there)
    if "ros2 " in text:
        pytest.importorskip("rclpy", reason="ROS 2 is not installed")
        text = f"{EMULATOR.format(port=workshop.port)} -p start_radius:=0.001\n{text}"
    with own_domain() as domain:
        done = subprocess.run(
            ["bash", "-c", f"set -eu\n{text}"],
            cwd=there, capture_output=True, text=True, check=False, timeout=390,
            env={
                **{k: v for k, v in os.environ.items() if k not in ("MAKEFLAGS", "MAKELEVEL")},
                "PATH": f"{programs}:{os.environ['PATH']}", "HOME": str(home),
                "MPLCONFIGDIR": str(programs / "matplotlib"), "OMP_NUM_THREADS": "1",
                "PYTHONPATH": f"{HERE.parent}:{os.environ.get('PYTHONPATH', '')}",
                "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
                "PAGE_NODES": str(nodes), "REAL_ROS2": REAL_ROS2,
            },
        )  # fmt: skip
        said = done.stdout[-2000:] + done.stderr[-2000:]
        ended(nodes)
    assert done.returncode == 0, f"{case[0]}: {said}"
    assert "success=False" not in done.stdout, said
    wrote_what_they_say(done.stdout, there)


def ended(nodes):
    """Stop all nodes that `ros2 run` and `ros2 launch` started; fail if one does not stop."""
    lines = nodes.read_text().splitlines() if nodes.exists() else []
    running = [line.split() for line in lines]
    left = {int(pid): name for pid, name in running if alive(pid)}
    for pid in left:
        os.killpg(pid, signal.SIGINT)  # as Ctrl-C does, to the whole group
    until = time.monotonic() + 30
    while any(map(alive, left)) and time.monotonic() < until:
        time.sleep(0.05)
    for pid in filter(alive, left):
        os.killpg(pid, signal.SIGKILL)
        pytest.fail(f"{left[pid]} did not end")
    for log in nodes.parent.glob("*.log"):
        assert "Traceback" not in log.read_text(errors="replace"), log.read_text()[-2000:]


def alive(pid):
    """Return whether a process runs; a zombie does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(") ", 1)[1][0] != "Z"
    except FileNotFoundError:
        return False


def wrote_what_they_say(text, folder):
    for line in re.findall(r"^written +(.+)$", text, re.MULTILINE):
        names, _, where = line.partition(" in ")
        if not where.startswith("/"):
            assert all((folder / where / n).exists() for n in names.split(", ")), line


def test_every_exception_is_of_use():
    """Fail for an exception that no page needs any more."""
    lines = [line for path in PAGES for shown in shown_on(path) for line in lines_of(shown)]
    for pattern in NOT_RUN:
        assert any(re.match(pattern, line) for line in lines), pattern


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_no_command_stands_where_it_is_not_looked_for(path):
    """Fail for a command in a block that only its indentation marks."""
    assert not re.findall(r"^    (?:omsm|ros2) .*--.*", path.read_text("utf-8"), re.MULTILINE)
