"""A campaign corrects every bag, survives a crash of one, and continues where it was."""

import contextlib
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from itertools import islice
from unittest import mock

import pytest

from omsm_ros import cli
from omsm_ros.cli import campaign
from omsm_ros.cli.campaign import CRASHED, DONE, REFUSED, load_campaign, run_campaign
from omsm_ros.errors import ConfigurationError, FileError
from omsm_ros.io import bags, calibration_file
from omsm_ros.io.bag_writer import BagWriter

OPTIONS = ("--no-report",)


@pytest.fixture(scope="module")
def shop(tmp_path_factory, small_scan_blocks, true_calibration):
    """Three good bags, one of them in a folder, one that is damaged, and a calibration."""
    folder = tmp_path_factory.mktemp("shop")
    (folder / "bags" / "monday").mkdir(parents=True)
    for name in ("a", "b", "monday/c"):
        with BagWriter(
            folder / "bags" / f"{name}.mcap", (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)
        ) as bag:
            for axes, distance in islice(iter(small_scan_blocks), 30):
                bag.write_block(axes)
                bag.write_block(distance)
    (folder / "bags" / "torn.mcap").write_bytes(b"\x89MCAP0\r\n and then nothing")
    (folder / "few").mkdir()
    for name, copy in (("a", "a"), ("a", "b"), ("torn", "torn")):
        shutil.copy(folder / "bags" / f"{name}.mcap", folder / "few" / f"{copy}.mcap")
    calibration_file.save_calibration(folder / "cal.json", true_calibration)
    return folder


@pytest.fixture(scope="module")
def finished(shop, tmp_path_factory):
    """A campaign over the shop, and its entries.

    The process of one bag is killed, that of one runs; two commands run here, as a start takes
    longer than they do.
    """
    folder, run = tmp_path_factory.mktemp("finished"), subprocess.run

    def sometimes_killed(command, **options):
        if any("b.mcap" in part for part in command):
            command = [sys.executable, "-c", "import os; os.kill(os.getpid(), 9)"]
        elif not any("c.mcap" in part for part in command):
            said = io.StringIO()
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(said):
                status = cli.main(command[command.index("omsm_ros.cli") + 1 :])
            return subprocess.CompletedProcess(command, status, "", said.getvalue())
        return run(command, **options)

    with mock.patch.object(campaign.subprocess, "run", sometimes_killed):
        return folder, run_campaign(shop / "bags", shop / "cal.json", folder, OPTIONS, jobs=1)


def states(entries):
    return {entry.bag: entry.state for entry in entries}


def test_every_bag_becomes_a_result_or_a_reason(shop, finished, tmp_path):
    folder, entries = finished
    assert states(entries) == {
        "a.mcap": DONE, "b.mcap": CRASHED, "monday/c.mcap": DONE, "torn.mcap": REFUSED,
    }  # fmt: skip
    assert "SIGKILL" in entries[1].said
    assert "torn.mcap" in entries[-1].said
    assert load_campaign(folder) == entries
    alone = tmp_path / "alone"
    cli.main(
        ["correct", str(shop / "bags/a.mcap"), "--calibration", str(shop / "cal.json"),
         "--out", str(alone), *OPTIONS]
    )  # fmt: skip
    for name in ("a", "monday/c"):
        cloud = (folder / name / "cloud.ply").read_bytes()
        assert cloud == (alone / "cloud.ply").read_bytes()


def test_what_is_done_is_not_done_again(shop, finished, tmp_path, monkeypatch):
    shutil.copytree(finished[0], tmp_path, dirs_exist_ok=True)
    started = []

    def note(task, _):
        started.append(task.bag)
        return replace(task, state=REFUSED, said="still torn")

    monkeypatch.setattr(campaign, "correct_one", note)
    run_campaign(shop / "bags", shop / "cal.json", tmp_path, OPTIONS)
    assert started == ["b.mcap", "torn.mcap"]
    started.clear()
    (tmp_path / "a" / "summary.json").unlink()
    run_campaign(shop / "bags", shop / "cal.json", tmp_path, OPTIONS)
    assert sorted(started) == ["a.mcap", "b.mcap", "torn.mcap"]
    started.clear()
    run_campaign(shop / "bags", shop / "cal.json", tmp_path, (*OPTIONS, "--probe-latency", "1e-4"))
    assert len(started) == 4


def test_a_bag_with_which_every_worker_died_costs_no_other(shop, tmp_path, monkeypatch):
    """Dask gives up a task that killed four workers, and raises its own error."""

    class KilledWorker(Exception):
        pass

    def corrected(task, _):
        if task.bag == "a.mcap":
            raise KilledWorker("Attempted to run task 'a' on 4 different workers")
        return replace(task, state=DONE)

    monkeypatch.setattr(campaign, "correct_one", corrected)
    entries = run_campaign(shop / "bags", shop / "cal.json", tmp_path, OPTIONS, jobs=1)
    assert [(e.bag, e.said) for e in entries if e.state == CRASHED] == [
        ("a.mcap", "no worker finished it (KilledWorker)")
    ]
    assert len(entries) == 4
    assert load_campaign(tmp_path) == entries


@pytest.mark.soak
def test_a_campaign_that_is_killed_goes_on(shop, tmp_path):
    command = [
        sys.executable, "-m", "omsm_ros.cli", "batch", str(shop / "few"), "--calibration",
        str(shop / "cal.json"), "--out", str(tmp_path), "--jobs", "1", "--json", "--", *OPTIONS,
    ]  # fmt: skip
    running = subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True)
    while not load_campaign(tmp_path):
        time.sleep(0.02)
        assert running.poll() is None
    os.killpg(running.pid, signal.SIGKILL)
    running.wait()
    before = load_campaign(tmp_path)
    assert 1 <= len(before) < 3
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    entries = json.loads(done.stdout)["entries"]
    assert [e["state"] for e in entries] == [DONE, DONE, REFUSED]
    assert done.returncode == 2
    assert "1 bags gave no result" in done.stderr
    page = (tmp_path / "index.html").read_text()
    assert "torn.mcap" in page
    assert "refused" in page


def test_two_campaigns_do_not_share_a_folder(shop, tmp_path):
    with campaign._locked(tmp_path), pytest.raises(FileError, match="another campaign writes"):
        run_campaign(shop / "bags", shop / "cal.json", tmp_path, OPTIONS)


def test_a_folder_without_bags_is_refused(shop, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileError, match="no bag below"):
        run_campaign(tmp_path / "empty", shop / "cal.json", tmp_path / "out")
    with pytest.raises(FileError, match="no folder"):
        run_campaign(tmp_path / "none", shop / "cal.json", tmp_path / "out")


@pytest.mark.parametrize(
    ("text", "said"), [("[]", "expected a JSON object"), ("{}", "required"), ("{", "is not JSON")]
)
def test_a_damaged_state_is_named(tmp_path, text, said):
    (tmp_path / "campaign.json").write_text(text)
    with pytest.raises(FileError, match=said):
        load_campaign(tmp_path)


def test_a_scheduler_that_is_no_address_is_refused(shop, tmp_path):
    with pytest.raises(ConfigurationError, match="no address: Invalid IPv6"):
        run_campaign(shop / "bags", shop / "cal.json", tmp_path, scheduler="tcp://[31m:5")


@pytest.mark.parametrize("address", ["tcp://10.0.0.7:8786", "ws://localhost:1", "localhost"])
def test_a_scheduler_beyond_this_host_needs_tls(shop, tmp_path, address):
    with pytest.raises(ConfigurationError, match="tls://"):
        run_campaign(shop / "bags", shop / "cal.json", tmp_path, scheduler=address)


@pytest.mark.soak
def test_two_dask_workers_give_the_same_though_one_is_killed(shop, tmp_path):
    distributed = pytest.importorskip("distributed", reason="Dask is an optional package")
    options = (*OPTIONS, "--probe-latency", "1e-4")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        killed = []

        def kill_once(done, total):
            if done == 1 and not killed:
                killed.append(os.kill(next(iter(cluster.workers.values())).pid, signal.SIGKILL))

        entries = run_campaign(
            shop / "bags", shop / "cal.json", tmp_path, options,
            scheduler=cluster.scheduler_address, progress=kill_once,
        )  # fmt: skip
    assert killed
    assert sorted(states(entries).values()) == [DONE, DONE, DONE, REFUSED]
