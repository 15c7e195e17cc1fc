"""The catalogue in a real PostgreSQL, started on loopback if it is installed."""

import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from omsm_ros.errors import FileError
from omsm_ros.pipelines.history import history, keep_calibration, keep_measurement

pytest.importorskip("sqlalchemy", reason="SQLAlchemy is an optional package")
pytest.importorskip("psycopg", reason="psycopg is an optional package")


def _programs():
    """Return the folder of the newest server of Debian's packages, or on PATH; None without one."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    name = str(found[-1]) if found else shutil.which("initdb")
    return Path(name).resolve().parent if name else None


def _user():
    """Run as user nobody if the tests run as root, which PostgreSQL refuses."""
    if os.geteuid() != 0:
        return []
    if shutil.which("runuser") is None:
        pytest.skip("PostgreSQL does not run as root, and there is no runuser")
    return ["runuser", "-u", "nobody", "--"]


@pytest.fixture(scope="module")
def server():
    """Start a server on a free port with a temporary folder."""
    programs, user = _programs(), _user()
    if programs is None:
        pytest.skip("PostgreSQL is not installed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    folder = Path(tempfile.mkdtemp(prefix="omsm_pg"))
    if user:
        shutil.chown(folder, "nobody")
    data = folder / "data"
    environment = {**os.environ, "LC_ALL": "C"}
    found = Server(f"postgresql://omsm@127.0.0.1:{port}/postgres", data, user, programs)
    try:
        subprocess.run(
            [*user, programs / "initdb", "-D", data, "-A", "trust", "-U", "omsm", "--no-sync"],
            check=True, capture_output=True, cwd=folder, env=environment,
        )  # fmt: skip
        running = subprocess.Popen(
            [*user, programs / "postgres", "-D", data, "-p", str(port), "-k", folder,
             "-c", "listen_addresses=127.0.0.1", "-c", "fsync=off"],
            cwd=folder, env=environment, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            _wait_for(port, running)
            yield found
        finally:
            found.stop()
            running.wait(30)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _wait_for(port, running):
    deadline = time.monotonic() + 30
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), 1).close()
            return
        except OSError:
            assert running.poll() is None, "PostgreSQL did not start"
            assert time.monotonic() < deadline
            time.sleep(0.1)


class Server:
    def __init__(self, address, data, user, programs):
        self.address, self._data, self._user, self._programs = address, data, user, programs

    def stop(self):
        command = [*self._user, self._programs / "pg_ctl", "-D", self._data, "-m", "immediate"]
        # It may have ended already.
        subprocess.run([*command, "stop"], check=False, capture_output=True, cwd=self._data.parent)


def result(folder):
    folder.mkdir(parents=True)
    summary = {"bag": "scan.mcap", "calibration": "c" * 64, "settings": {"machine": "lathe 1"}}
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


WRITER = """
import sys
from pathlib import Path
from omsm_ros.pipelines.history import keep_measurement
for i in range(10):
    assert keep_measurement(sys.argv[1], Path(sys.argv[2]) / str(i))
"""


def test_two_writers_and_a_server_that_goes_away(server, tmp_path, true_calibration):
    """One test for all, because starting a server takes long."""
    for writer in "ab":
        for i in range(10):
            result(tmp_path / writer / str(i))
    writers = [
        subprocess.Popen([sys.executable, "-c", WRITER, server.address, str(tmp_path / writer)])
        for writer in "ab"
    ]
    assert [writer.wait() for writer in writers] == [0, 0]
    (machine,) = history(server.address)[0]
    assert len({row["folder"] for row in machine["measurements"]}) == 20

    assert keep_calibration(server.address, true_calibration, tmp_path / "cal.json")
    assert not keep_calibration(server.address, true_calibration, tmp_path / "cal.json")
    (twin,) = [m for m in history(server.address)[0] if m["machine"] == "twin"]
    assert twin["calibrations"][0]["delay"] == true_calibration.dynamics.low_frequency_delay

    server.stop()
    begin = time.monotonic()
    with pytest.raises(FileError, match=r"127\.0\.0\.1"):
        keep_measurement(server.address, result(tmp_path / "late"))
    assert time.monotonic() - begin < 15
