"""The commands of ``omsm``: the module of each, and its line of help.

They are listed here so that ``omsm --help`` need not load their modules, which takes seconds.
"""

from typing import NamedTuple

from omsm_ros.messages import catalogue


class Word(NamedTuple):
    """One command: its ``module`` in this package, and its line of ``help``."""

    module: str
    help: str


# In the order of use.
_HELP = {
    "begin": """
doctor: check whether this computer can run a cell, with remedies
demo: calibrate and measure on the digital twin (needs ROS)
twin: write bags of the digital twin: a step test and a scan
completion: print a shell script that completes commands, options and file names
""",
    "recordings": """
record: record a device to a bag without ROS
inspect: list the streams and faults of a bag, or repair it
import: convert CSV, NumPy, MATLAB, HDF5 or TDMS files, or other ROS topics, to a bag
""",
    "dynamics of probe and machine": """
plan: write a step test for the machine, or scans of a part
identify: identify the transfer function from encoder to probe from a step test
verify: verify a calibration on a free path: errors and phase lags before and after
compare: test two calibrations for a change, or the repeatability of three or more
calset: combine calibrations at several positions of X, Z or B, for dynamics that vary
""",
    "latency": """
selfcal: estimate dynamics from scans of one part at different speeds or directions
reversal: estimate the probe latency from two scans with opposite spindle directions
latency: declare how much of a calibration's lag is probe latency, with a reason
""",
    "a scan": """
surface: show extent and slopes of a nominal surface, and whether probe and axes can follow
predict: predict the dynamic error of a motion and its maximum speed
align: estimate spindle centre and beam direction from a scan of a reference sphere
sources: evaluate error sources of the machine from a recording made for it
correct: correct a recorded scan: cloud, summary and report
adjust: adjust two or more scans of one part together: form, sources, verdict
report: write the report of a finished correction again
""",
    "the part": """
form: fit the pose and evaluate the form: deviation, Zernike terms, texture
compensate: compute offsets of the next cut from the measured form
difference: compare two measurements of one part: E_n, maps, verdict
spectrum: find spectral lines in scans of one part and their sources: part, vibration, aliased
    vibration, spindle
export: write a cloud or map in the format of another program
""",
    "many scans": """
batch: correct every bag of a folder; index page with outliers and trends
history: list past calibrations and measurements, and each machine's drift
""",
    "models of other systems": """
validate: simulate a model on another record and compare with its output
""",
}
# Modules that are not named as their only command; the demonstration is a node.
_MODULES = {
    "": ("demo",),
    "start": ("twin", "completion"),
    "recordings": ("record", "inspect", "import"),
    "calibration": ("verify", "compare", "calset"),
    "latency": ("selfcal", "reversal"),
    "form": ("surface", "compensate"),
    "correct": ("predict", "align", "report"),
    "campaign": ("batch",),
    "identify": ("validate",),
}


def _module_of(command: str) -> str:
    return next((module for module, words in _MODULES.items() if command in words), command)


TASKS: dict[str, dict[str, Word]] = {
    task: {name: Word(_module_of(name), help) for name, help in catalogue(text).items()}
    for task, text in _HELP.items()
}
WORDS = {name: word for words in TASKS.values() for name, word in words.items()}
