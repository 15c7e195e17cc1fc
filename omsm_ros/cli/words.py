"""The commands of ``omsm``: the module of each, and its line of help.

They are listed here so that ``omsm --help`` need not load their modules, which takes seconds.
"""

from typing import NamedTuple


class Word(NamedTuple):
    """One command: its ``module`` in this package, and its line of ``help``."""

    module: str
    help: str


# In the order of use.
TASKS: dict[str, dict[str, Word]] = {
    "begin": {
        "doctor": Word("doctor", "check whether this computer can run a cell, with remedies"),
        "demo": Word("", "calibrate and measure on the digital twin (needs ROS)"),
        "twin": Word("start", "write bags of the digital twin: a step test and a scan"),
        "completion": Word(
            "start", "print a shell script that completes commands, options and file names"
        ),
    },
    "recordings": {
        "record": Word("recordings", "record a device to a bag without ROS"),
        "inspect": Word("recordings", "list the streams and faults of a bag, or repair it"),
        "import": Word(
            "recordings",
            "convert CSV, NumPy, MATLAB, HDF5 or TDMS files, or other ROS topics, to a bag",
        ),
    },
    "dynamics of probe and machine": {
        "plan": Word("plan", "write a step test for the machine, or scans of a part"),
        "identify": Word(
            "identify", "identify the transfer function from encoder to probe from a step test"
        ),
        "verify": Word(
            "calibration",
            "verify a calibration on a free path: errors and phase lags before and after",
        ),
        "compare": Word(
            "calibration",
            "test two calibrations for a change, or the repeatability of three or more",
        ),
        "calset": Word(
            "calibration",
            "combine calibrations at several positions of X, Z or B, for dynamics that vary",
        ),
    },
    "latency": {
        "selfcal": Word(
            "latency", "estimate dynamics from scans of one part at different speeds or directions"
        ),
        "reversal": Word(
            "latency", "estimate the probe latency from two scans with opposite spindle directions"
        ),
        "latency": Word(
            "latency", "declare how much of a calibration's lag is probe latency, with a reason"
        ),
    },
    "a scan": {
        "surface": Word(
            "form",
            "show extent and slopes of a nominal surface, and whether probe and axes can follow",
        ),
        "predict": Word("correct", "predict the dynamic error of a motion and its maximum speed"),
        "align": Word(
            "correct",
            "estimate spindle centre and beam direction from a scan of a reference sphere",
        ),
        "sources": Word(
            "sources", "evaluate error sources of the machine from a recording made for it"
        ),
        "correct": Word("correct", "correct a recorded scan: cloud, summary and report"),
        "adjust": Word(
            "adjust", "adjust two or more scans of one part together: form, sources, verdict"
        ),
        "report": Word("correct", "write the report of a finished correction again"),
    },
    "the part": {
        "form": Word(
            "form", "fit the pose and evaluate the form: deviation, Zernike terms, texture"
        ),
        "compensate": Word("form", "compute offsets of the next cut from the measured form"),
        "difference": Word(
            "difference", "compare two measurements of one part: E_n, maps, verdict"
        ),
        "spectrum": Word(
            "spectrum",
            "find spectral lines in scans of one part and their sources: part, vibration, aliased "
            "vibration, spindle",
        ),
        "export": Word("export", "write a cloud or map in the format of another program"),
    },
    "many scans": {
        "batch": Word(
            "campaign", "correct every bag of a folder; index page with outliers and trends"
        ),
        "history": Word(
            "history", "list past calibrations and measurements, and each machine's drift"
        ),
    },
    "models of other systems": {
        "validate": Word(
            "identify", "simulate a model on another record and compare with its output"
        )
    },
}

WORDS = {name: word for words in TASKS.values() for name, word in words.items()}
