"""The senders of docs/stream.md compile, run, and are read by the driver as the page says."""

import re
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from omsm_ros.io.bags import BagReader
from omsm_ros.io.topics import AXES_TOPIC, DISTANCE_TOPIC
from omsm_ros.pipelines.record_bags import record_device

PAGE = (Path(__file__).parents[2] / "docs" / "stream.md").read_text()
PER_UNIT = dict(re.findall(r"(\w\.counts_per_unit)=([\d.]+)", PAGE))


def code(language):
    return re.search(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)[1]


def python_sender(folder, port):
    text = code("python").replace("7010", str(port))
    text = text.replace("return 0.0, 0, 0.0, 0.0, 0.0, 0.0, 0.0", VALUES)
    (folder / "sender.py").write_text(text)
    return [sys.executable, folder / "sender.py"]


# Distance, status, X Y Z in millimetres, B C in degrees.
VALUES = "return -12.5, 0, number * 1e-3, 2.0, 3.0, 4.0, number * 0.18"


def c_sender(folder, port):
    text = code("c").replace("7010", str(port))
    values = (
        "v[0] = -12.5, v[1] = number * 1e-3, v[2] = 2, v[3] = 3, v[4] = 4, v[5] = number * 0.18;"
    )
    text = text.replace("for (int i = 0; i < 6; i++) v[i] = 0.0;", values)
    assert values in text
    (folder / "sender.c").write_text(text)
    subprocess.run(
        ["gcc", "-Wall", "-Wextra", "-Werror", "-O1", "-o", folder / "sender", folder / "sender.c"],
        check=True,
    )
    return [folder / "sender"]


@pytest.mark.parametrize("made", [python_sender, c_sender])
def test_a_sender_of_the_page_is_read_completely(tmp_path, made):
    if made is c_sender and not shutil.which("gcc"):
        pytest.skip("gcc is not installed")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    given = {"device": "six_channel_text", "port": f"tcp://127.0.0.1:{port}"}
    given |= {name: float(value) for name, value in PER_UNIT.items()}
    with subprocess.Popen(made(tmp_path, port)) as sender:
        try:
            found = record_device(given, tmp_path / "1.mcap", lambda n, s: n >= 500 or s > 10.0)
        finally:
            sender.kill()
    assert not {"lost", "malformed", "restarts", "duplicates"} & set(found)
    with BagReader(tmp_path / "1.mcap") as reader:
        axes = [block for _, block in reader.records(AXES_TOPIC)]
        distance = [block for _, block in reader.records(DISTANCE_TOPIC)]
    number = np.concatenate([np.arange(b.first_sample, b.first_sample + len(b)) for b in axes])
    assert len(number) == found["samples"] >= 500
    assert np.all(np.diff(number) == 1)
    np.testing.assert_allclose(np.concatenate([b.x for b in axes]), number * 1e-6, atol=1e-12)
    np.testing.assert_allclose(
        np.concatenate([b.c for b in axes]), np.radians(number * 0.18), atol=1e-9
    )
    assert np.all(np.concatenate([b.z for b in axes]) == 3e-3)
    np.testing.assert_allclose(np.concatenate([b.distance for b in distance]), -12.5e-9, rtol=1e-12)
