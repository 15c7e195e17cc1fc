"""A probe of another package is found by its entry point, and a broken package is named."""

import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import omsm_ros

ROOT = Path(omsm_ros.__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "adding_a_probe.md"
LOOK = """
import json
from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.emulator_factory import EMULATED, emulated
from omsm_ros.instruments.factory import make_device
from omsm_ros.instruments.parameters import PARAMETERS, defaults
from omsm_ros.instruments.registry import PROBES
given = defaults() | {"device": "lamp", "port": "tcp://127.0.0.1:1"}
device = make_device(given)
try:
    make_device(given | {"device": "broken"})
except ConfigurationError as err:
    said = str(err)
(known,) = (p for p in PARAMETERS if p.name == "device")
print(json.dumps([type(device).__name__, "lamp" in known.choices, "lamp" in EMULATED,
                  emulated("lamp").make.__name__, PROBES["chrocodile"].driver, said]))
"""


def install(folder):
    """Write the package of the page as pip installs it."""
    text = PAGE.read_text(encoding="utf-8")
    example = [block.partition("```")[0] for block in text.split("```python\n")[1:]]
    protocol, device, emulator = example[:3]
    made = text.partition("<!-- make -->\n```\n")[2].partition("```")[0]
    assert made
    (folder / "lamp_probe.py").write_text("\n".join([protocol, device, emulator, made]))
    (folder / "broken_probe.py").write_text("import no_such_library\n")
    about = folder / "lamp_probe-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: lamp_probe\nVersion: 1.0\n")
    entries = """
        [omsm_ros.instruments]
        lamp = lamp_probe:make
        broken = broken_probe:make
        chrocodile = lamp_probe:make
        [omsm_ros.emulators]
        lamp = lamp_probe:EMULATED
    """
    (about / "entry_points.txt").write_text(textwrap.dedent(entries))


def test_a_probe_of_another_package_is_used_and_ours_stay(tmp_path):
    install(tmp_path)
    paths = [str(tmp_path), str(ROOT), os.environ.get("PYTHONPATH", "")]
    ran = subprocess.run(
        [sys.executable, "-c", LOOK],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    kind, chosen, played, emulator, ours, said = json.loads(ran.stdout)
    assert (kind, chosen, played, emulator) == ("LampDevice", True, True, "LampEmulator")
    assert ours == ".chrocodile.dollar_device:make"
    assert "broken_probe:make" in said
    assert "no_such_library" in said
