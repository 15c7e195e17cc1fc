"""Run the worked example of the page."""

import re
from pathlib import Path

import omsm_ros

PAGE = Path(omsm_ros.__file__).resolve().parent.parent / "docs" / "adding_a_probe.md"


def test_the_page_runs_from_top_to_bottom():
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == 4
    names = {"__name__": "page"}
    exec("\n".join(blocks), names)
    assert len(names["blocks"]) > 30


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
