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
        "doctor": Word("start", "is this computer ready to run a cell? What to do where it is not"),
        "demo": Word("", "calibrate and measure on the digital twin (needs ROS)"),
        "twin": Word("start", "bags of the digital twin: a step test and a scan to work on"),
        "completion": Word(
            "completion",
            "a script for the shell that completes commands, options and names of files",
        ),
    },
    "recordings": {
        "inspect": Word("inspect", "show what a bag holds, or repair it"),
        "import": Word(
            "import_recording",
            "make a bag of CSV, NumPy, MATLAB, HDF5 or TDMS files, or of foreign ROS topics",
        ),
    },
    "dynamics of probe and machine": {
        "plan": Word("calibration", "write a step test for the machine"),
        "identify": Word(
            "identify", "the transfer function from encoder to probe, from a step test"
        ),
        "verify": Word(
            "calibration",
            "check a calibration on a free path: errors and phase lags before and after",
        ),
        "compare": Word(
            "calibration",
            "has the machine changed between two calibrations? Do three or more repeat?",
        ),
        "calset": Word(
            "calibration", "calibrations along X, Z or B as one, for dynamics that vary"
        ),
    },
    "latency": {
        "selfcal": Word(
            "latency",
            "dynamics from two or more scans of one part at different speeds or directions",
        ),
        "reversal": Word(
            "latency", "is the lag latency? From two scans with opposite spindle directions"
        ),
        "latency": Word(
            "latency", "declare how much of a calibration's lag is latency, with a reason"
        ),
    },
    "a scan": {
        "surface": Word("form", "what a nominal surface asks of probe and axes"),
        "predict": Word("correct", "what a motion will cost, and how fast it may run"),
        "align": Word(
            "align", "spindle centre and beam direction from a scan of a reference sphere"
        ),
        "correct": Word("correct", "correct a recorded scan: cloud, summary and report"),
        "adjust": Word(
            "adjust", "adjust two or more scans of one part together: form, sources, verdict"
        ),
        "report": Word(
            "report", "the page of a finished correction once more, as after --no-report"
        ),
    },
    "the part": {
        "form": Word("form", "the part's pose and its form: deviation, Zernike terms, texture"),
        "compensate": Word("form", "offsets of the next cut, from the form that was measured"),
        "difference": Word(
            "difference", "do two measurements of one part agree? E_n, maps, verdict"
        ),
        "spectrum": Word(
            "spectrum",
            "lines in scans of one part, and what each is: on the part, vibration, folded, spindle",
        ),
        "export": Word("export", "write a cloud or map in the format of another program"),
    },
    "many scans": {
        "batch": Word(
            "campaign", "correct every bag of a folder; an index page with outliers and trends"
        ),
        "history": Word("history", "what was calibrated and measured, and how each machine drifts"),
    },
    "models of other systems": {
        "validate": Word(
            "identify", "run a model over another record: how much of it does it account for?"
        ),
    },
}

WORDS = {name: word for words in TASKS.values() for name, word in words.items()}
