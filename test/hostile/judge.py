"""What every command owes to every input, however hostile."""

from __future__ import annotations

import contextlib
import io
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from omsm_ros import cli
from omsm_ros.io.results import CloudFile

LONGEST_S = 5.0
MOST_BYTES = 1024**3
RESULT = "out"
# Words of a remedy: what a message says to do.
REMEDIES = (
    "check", "delete", "expected", "give", "install", "use", "record", "identify", "write", "see",
    "call", "make", "move", "remove", "sample", "look", "plan", "choose", "leave", "convert",
    "start", "both are", "are needed", "reverse", "scan the", "scan at",
    "invert", "add ", "process less", "wait until",
    "scan one", "name columns", "at least", "more than",
    "set the", "needs", "must", "state ", "thin it", "save it", "name the", "name it", "name each",
    "measure", "hold what",
    "widen", "split it", "calibrate every", "end it in", "again",
    "correct the scan", "import the parts", "sort them", "correct it",
    "turn its", "take it as", "drop", "shorten", "cut them", "publish",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A command line, and the files it is given by their names in the working folder."""

    arguments: tuple[str, ...]
    files: dict[str, bytes] = field(default_factory=dict)

    def lay(self, folder: Path) -> None:
        """Write the files into ``folder``, where nothing is left of another command's result."""
        shutil.rmtree(folder / RESULT, ignore_errors=True)
        for name, content in self.files.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(content)


@dataclass(frozen=True)
class Answer:
    """What a command said; seconds: of the processor, for others use the machine too."""

    status: int
    out: str
    err: str
    seconds: float


def ask(case: Case, folder: Path) -> Answer:
    """Run a command in this process, in ``folder``."""
    case.lay(folder)
    out, err = io.StringIO(), io.StringIO()
    before = os.getcwd()
    os.chdir(folder)
    start, held = time.process_time(), peak_bytes()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = cli.main(list(case.arguments))
    finally:
        os.chdir(before)
    grown = peak_bytes() - held
    assert grown < MOST_BYTES, f"took {grown / 1e6:.0f} MB more"
    return Answer(status, out.getvalue(), err.getvalue(), time.process_time() - start)


def ask_process(case: Case, folder: Path) -> Answer:
    """Run a command as a process of its own that may hold 1 GB of data, in ``folder``."""
    case.lay(folder)
    start = _seconds_of_children()
    done = subprocess.run(
        [sys.executable, "-m", "omsm_ros.cli", *case.arguments],
        cwd=folder,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        encoding="utf-8",
        errors="backslashreplace",
        timeout=200,
        preexec_fn=_only_a_gigabyte,
    )
    seconds = _seconds_of_children() - start
    return Answer(done.returncode, done.stdout, done.stderr, seconds)


def _seconds_of_children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _only_a_gigabyte() -> None:
    # Data, not addresses: what libraries map without touching it takes no memory.
    resource.setrlimit(resource.RLIMIT_DATA, (MOST_BYTES, MOST_BYTES))


def peak_bytes() -> int:
    """Largest memory this process ever held."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def judge(case: Case, answer: Answer, folder: Path) -> None:
    """Fail unless the answer is a refusal in one line that helps, or right."""
    said = f"{answer.status}: {answer.err!r} {answer.out[:300]!r}"
    assert answer.seconds < LONGEST_S, f"took {answer.seconds:.1f} s, {said}"
    assert answer.status in (0, 2), said
    assert "Traceback" not in answer.err, said
    if answer.status == 2:
        assert answer.err.count("\n") == 1, said
        assert answer.err.startswith("omsm: "), said
        assert 20 < len(answer.err) < 2000, said
        assert any(word in answer.err.lower() for word in REMEDIES), said
    leftovers = [name for name in os.listdir(folder) if name.endswith(".part")]
    assert not leftovers, leftovers
    if answer.out and "--json" in case.arguments:
        facts = json.loads(answer.out, parse_constant=_no_constant)
        assert isinstance(facts, dict), said
        if answer.status == 0:
            _check(facts, folder)


def _no_constant(name: str) -> float:
    raise AssertionError(f"{name} is no JSON")


def _check(facts: dict[str, object], folder: Path) -> None:
    """Samples are accounted for, and what stands in a cloud is a number."""
    samples = facts.get("samples")
    if isinstance(samples, dict):
        for account in (a for a in samples.values() if isinstance(a, dict)):
            assert account["received"] == account["corrected"] + sum(account["counted"].values())
        if (folder / RESULT / "cloud.ply").exists():
            cloud = CloudFile(folder / RESULT / "cloud.ply").read()
            assert len(cloud) == samples["axes"]["corrected"]
            for name in ("x", "y", "height", "dynamic_error", "uncertainty"):
                assert np.isfinite(cloud[name]).all(), name
            assert (cloud["uncertainty"] >= 0).all()


def refused(place: Path, words: Sequence[str], name: str, raw: bytes) -> str:
    """Return what the command ``words`` says of the file ``name``, whose content is ``raw``."""
    case = Case((*(word.replace("{}", name) for word in words), "--json"), {name: raw})
    answer = ask(case, place)
    assert answer.status == 2, answer
    judge(case, answer, place)
    return answer.err
