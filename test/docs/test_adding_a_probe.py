"""Run the worked example of the page."""

import re
from pathlib import Path

import numpy as np

import omsm_ros

PAGE = Path(omsm_ros.__file__).resolve().parent.parent / "docs" / "adding_a_probe.md"


def test_the_page_runs_from_top_to_bottom():
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == 5
    names = {"__name__": "page"}
    exec("\n".join(blocks), names)
    assert len(names["blocks"]) > 30
    line = names["Loopback"]()
    line.instrument = names["faulty"](names["PolledEmulator"])(line.line, clock=line.clock)
    settings = names["BlockSettings"](sample_period=0.02, block_size=10)
    polled = names["PolledLamp"](line, settings, line.clock.nanoseconds, line.clock)
    polled.open()
    blocks = [block for _ in range(1500) for block in polled.poll(0.05)]
    polled.close()
    counts = np.concatenate([b.distance.first_sample + np.arange(len(b.distance)) for b in blocks])
    read = np.concatenate([b.distance.distance for b in blocks])
    assert len(counts) > 200
    assert polled.statistics.lost <= 0.02 * len(counts)  # an answer that came a moment late
    assert np.all(np.diff(counts) > 0)
    # The source encodes the number of the sample; answers are some milliseconds of it late.
    number = np.round(read * 1e6) - 10
    off = (20 * (counts - counts[0]) - (number - number[0]) + 40) % 80 - 40
    assert np.all(np.abs(off) <= 20)


def test_every_name_the_page_points_at_exists():
    from wire_trace import ReplayTransport

    from omsm_ros.instruments.emulator_factory import EMULATED
    from omsm_ros.instruments.parameters import PARAMETERS
    from omsm_ros.instruments.registry import PROBES

    assert PROBES
    assert PARAMETERS
    assert EMULATED
    assert ReplayTransport.name == "trace"


def test_every_device_stands_in_the_table():
    from omsm_ros.instruments.registry import PROBES

    table = (PAGE.parent / "devices.md").read_text(encoding="utf-8")
    for name in PROBES:
        assert f"| `{name}` |" in table
