"""How omsm_ros is installed: by colcon into a workspace, or by pip where there is no ROS."""

import os
import re
from contextlib import suppress
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

ROOT = Path(__file__).resolve().parent  # --symlink-install runs a link to this file elsewhere
PACKAGE = "omsm_ros"
INTERFACES = f"{PACKAGE}.interfaces"
LINUXCNC = f"{PACKAGE}.instruments.linuxcnc.machine"
NODES = (
    "corrector",
    "calibrator",
    "confocal_driver",
    "axis_driver",
    "reference_driver",
    "accelerometer_driver",
    "vibration_monitor",
    "recorder",
    "player",
    "viewer",
    "cell_emulator",
    "cell_demo",
)
# A command in a workspace. The usual text of setuptools loads other modules for a tenth of a second
# first, to look up what to run, and Ctrl-C meanwhile ends with a traceback.
COMMAND = """\
import signal
import sys
from importlib import import_module

before = signal.getsignal(signal.SIGINT)
if before is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
main = import_module("omsm_ros.cli" if %(name)r == "omsm" else "omsm_ros.nodes.start").main
signal.signal(signal.SIGINT, before)
sys.exit(main())
"""
with suppress(ImportError):  # later than 79, which colcon does not use
    from setuptools.command.easy_install import ScriptWriter

    ScriptWriter.template = COMMAND

setup(
    name=PACKAGE,
    version=re.search(r'__version__ = "(.+)"', (ROOT / PACKAGE / "__init__.py").read_text())[1],
    description="On-machine surface measurement, the dynamic error of the measuring loop corrected",
    license="Apache-2.0",
    python_requires=">=3.10",
    install_requires=(ROOT / "bootstrap" / "runtime.in").read_text().splitlines(),
    extras_require={
        "test": ["pytest", "pytest-timeout", "hypothesis"],  # colcon test: use pytest
        "formats": [
            "h5py",
            "npTDMS",
            "x3pio>=2; python_version >= '3.11'",
            "SurfaceTopography>=1.20",
        ],
        "viewer": ["websockets>=14"],
        "devices": ["pyads", "pandablocks", "nidaqmx"],
        "campaign": ["distributed"],
        "completion": ["shtab"],
        "pandas": ["pandas", "xarray"],
        "catalogue": ["sqlalchemy>=2", "psycopg[binary]>=3.1"],
    },
    # Bags are read where ROS is not installed, too, so the texts of our interfaces travel with the
    # code: msg_defs/ is installed as omsm_ros/interfaces/. In a source checkout, and in a workspace
    # built with --symlink-install, the code finds msg_defs/ itself:
    #     package = Path(omsm_ros.__file__).resolve().parent       (omsm_ros/)
    #     package / "interfaces" / "msg"  if it exists, else  package.parent / "msg_defs" / "msg"
    packages=[*find_packages(include=[PACKAGE, f"{PACKAGE}.*"]), INTERFACES, LINUXCNC],
    package_dir={
        INTERFACES: os.path.relpath(ROOT / "msg_defs"),
        LINUXCNC: os.path.relpath(ROOT / "config" / "linuxcnc"),
    },
    package_data={
        INTERFACES: ["msg/*.msg", "srv/*.srv", "action/*.action"],
        LINUXCNC: ["*"],
        PACKAGE: ["**/*.html", "**/*.css", "**/*.js", "**/*.json", "**/*.yaml", "**/*.xml"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", [path for path in glob("config/*") if Path(path).is_file()]),
        (f"share/{PACKAGE}/launch", glob("launch/*.py")),
    ],
    entry_points={
        "console_scripts": [
            *(f"{node} = {PACKAGE}.nodes.start:main" for node in (*NODES, "replay", "cell")),
            f"omsm = {PACKAGE}.cli:main",
        ]
    },
)
