"""Every word after ``omsm``: the module of its command, and what it does, in one line.

The list of all commands comes from here, because loading all that they need takes seconds.
"""

from __future__ import annotations

from typing import NamedTuple


class Word(NamedTuple):
    """One command of the list: ``module``, in this room, knows the rest; ``help`` is one line."""

    module: str
    help: str


# As one comes to need them.
TASKS: dict[str, dict[str, Word]] = {
    "begin": {
        "doctor": Word(
            "starting", "is this computer ready to run a cell? What to do where it is not"
        ),
        "demo": Word("", "calibrate and measure on the digital twin (needs ROS)"),
        "twin": Word("starting", "bags of the digital twin: a step test and a scan to work on"),
        "completion": Word(
            "completing",
            "a script for the shell that completes commands, options and names of files",
        ),
    },
    "recordings": {
        "inspect": Word("inspecting", "show what a bag holds, or repair it"),
        "import": Word(
            "importing",
            "make a bag of CSV, NumPy, MATLAB, HDF5 or TDMS files, or of foreign ROS topics",
        ),
    },
    "dynamics of probe and machine": {
        "plan": Word("calibrating", "write a step test for the machine"),
        "identify": Word(
            "identifying", "the transfer function from encoder to probe, from a step test"
        ),
        "verify": Word(
            "calibrating",
            "check a calibration on a free path: errors and phase lags before and after",
        ),
        "compare": Word(
            "calibrating",
            "has the machine changed between two calibrations? Do three or more repeat?",
        ),
        "calset": Word(
            "calibrating", "calibrations along X, Z or B as one, for dynamics that vary"
        ),
    },
    "latency": {
        "selfcal": Word(
            "resolving",
            "dynamics from two or more scans of one part at different speeds or directions",
        ),
        "reversal": Word(
            "resolving", "is the lag latency? From two scans with opposite spindle directions"
        ),
        "latency": Word(
            "resolving", "declare how much of a calibration's lag is latency, with a reason"
        ),
    },
    "a scan": {
        "surface": Word("forming", "what a nominal surface asks of probe and axes"),
        "predict": Word("measuring", "what a motion will cost, and how fast it may run"),
        "align": Word(
            "aligning", "spindle centre and beam direction from a scan of a reference sphere"
        ),
        "correct": Word("measuring", "correct a recorded scan: cloud, summary and report"),
        "report": Word(
            "reporting", "the page of a finished correction once more, as after --no-report"
        ),
    },
    "the part": {
        "form": Word("forming", "the part's pose and its form: deviation, Zernike terms, texture"),
        "compensate": Word("forming", "offsets of the next cut, from the form that was measured"),
        "difference": Word(
            "comparing", "do two measurements of one part agree? E_n, maps, verdict"
        ),
        "spectrum": Word(
            "rippling",
            "lines in scans of one part, and what each is: on the part, vibration, folded, spindle",
        ),
        "export": Word("exporting", "write a cloud or map in the format of another program"),
    },
    "many scans": {
        "batch": Word(
            "campaigning", "correct every bag of a folder; an index page with outliers and trends"
        ),
        "history": Word(
            "remembering", "what was calibrated and measured, and how each machine drifts"
        ),
    },
    "models of other systems": {
        "validate": Word(
            "identifying", "run a model over another record: how much of it does it account for?"
        ),
    },
}

WORDS = {name: word for words in TASKS.values() for name, word in words.items()}
