"""Parse the command line, run one command, and return its exit status."""

from __future__ import annotations

import argparse
import difflib
import errno
import importlib
import io
import os
import signal
import subprocess
import sys
import textwrap
import threading
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

from omsm_ros import __version__
from omsm_ros.cli import INTERRUPTED, INTERRUPTION, interruptible
from omsm_ros.cli.arguments import Arguments, OneLineParser, UsageError
from omsm_ros.cli.command import CliCommand, null_device, say, say_lines, table, warn, written
from omsm_ros.cli.words import TASKS, WORDS
from omsm_ros.errors import (
    DEBUG,
    ConfigurationError,
    FileError,
    OmsmError,
    defect,
    shortened,
    too_many_open_files,
)
from omsm_ros.io import json_and_yaml
from omsm_ros.messages import COMMAND, written_for
from omsm_ros.pipelines.progress import refresh_in_thread, state_progress, stated_progress, tick
from omsm_ros.quantities import SEED, TIME_LAPSE, shown

if TYPE_CHECKING:
    from omsm_ros.cli.command import Facts, Rows

# Commands that end sooner show no elapsed time.
_DELAY_S = 1.0
_ELAPSED = "{desc}: {elapsed} so far"
# Whether something is done, and not yet all of a known number.
_LAYOUTS = {
    (False, False): _ELAPSED,
    (True, False): "{desc}: {n} done, {elapsed} so far",
    (True, True): "{desc}: {percentage:3.0f} % |{bar:24}| {elapsed} so far, {remaining} left",
}


@contextmanager
def progress_in_background(title: str, quiet: bool) -> Iterator[None]:
    """Show elapsed seconds and stated progress on stderr, with ``title``.

    Nothing is shown if quiet or without a terminal.
    """
    state_progress(0, 0)
    if quiet or not sys.stderr.isatty():
        yield
        return
    with refresh_in_thread(partial(_show, title)):
        yield


def _show(title: str, done: Event) -> None:
    if done.wait(_DELAY_S):
        return
    from tqdm import tqdm

    def refresh() -> None:
        line.n, line.total = stated_progress()
        line.bar_format = _LAYOUTS[line.n > 0, 0 < line.n < line.total]
        line.refresh()

    with tqdm(desc=title, bar_format=_ELAPSED, leave=False) as line:
        line.start_t -= _DELAY_S
        tick(refresh, done)


# Sent by "kill", "systemctl stop", a batch system, or a terminal that is closed.
_TERMINATION_SIGNALS = (signal.SIGTERM, signal.SIGHUP)


class TerminationRequestedError(KeyboardInterrupt):
    """The signal ``number`` came; like Ctrl-C it ends the command, which removes its files."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


@contextmanager
def interrupt_on_signal() -> Iterator[None]:
    """Raise TerminationRequestedError on a termination signal; a second one ends the process."""
    if threading.current_thread() is not threading.main_thread():
        yield  # Python handles signals in the main thread only.
        return

    def asked(number: int, _: object) -> None:
        signal.signal(number, signal.SIG_DFL)
        raise TerminationRequestedError(number)

    # Ignored signals stay ignored, such as SIGHUP under nohup.
    ours = [one for one in _TERMINATION_SIGNALS if signal.getsignal(one) is signal.SIG_DFL]
    for one in ours:
        signal.signal(one, asked)
    try:
        yield
    finally:
        for one in ours:
            signal.signal(one, signal.SIG_DFL)


_OUTPUTS = ("out", "plot", "report")
_RECORDINGS = (".mcap", ".db3", ".bag")
# Commands that may replace this input by their output, which is of the same kind.
_IN_PLACE = {
    ("latency", "calibration"),
    ("reversal", "calibration"),
    ("selfcal", "calibration"),
    ("align", "geometry"),
}


def check_outputs(args: argparse.Namespace) -> None:
    """Raise ConfigurationError if an output would overwrite an input or a recording."""
    given = vars(args)
    read = {
        name: [*_paths(value)]
        for name, value in given.items()
        if name not in (*_OUTPUTS, "command") and (args.command, name) not in _IN_PLACE
    }
    for output in _OUTPUTS:
        written = given.get(output)
        if not isinstance(written, Path) or not os.path.lexists(written):
            continue
        what = f"--{output} {shortened(repr(str(written)), 200)}"
        if any(_same(written, path) for paths in read.values() for path in paths):
            raise ConfigurationError(
                f"{what} is an input and would be overwritten; give another name"
            )
        # 'import' refuses an existing bag itself.
        taken = args.command != "import" and written.is_file()
        if taken and written.suffix.lower() in _RECORDINGS:
            raise ConfigurationError(
                f"{what} is a recording and would be overwritten; give another name"
            )


def _paths(value: object) -> Iterator[Path]:
    if isinstance(value, list | tuple):
        for one in value:
            yield from _paths(one)
    elif isinstance(value, str | Path) and value != "":
        yield Path(value)


def _same(written: Path, path: Path) -> bool:
    """Return True if both are one file, or one folder that is a bag."""
    try:
        alike = os.path.samefile(written, path)
    except (OSError, ValueError):
        return False
    return alike and (written.is_file() or (written / "metadata.yaml").is_file())


DONE, BAD_INPUT, DEFECT = 0, 2, 70  # 70 is EX_SOFTWARE of sysexits.h

_WIDTH, _INDENT = 79, 14

DEMO = "demo"
# Where each experiment of the paper is repeated.
EXPERIMENTS = {"mirror": "paper_mirror:mirror"} | {
    name: f"paper_experiments:{name}" for name in ("steps", "chirp", "circles", "vibration")
}

# Commands that pass the arguments after "--" on to another command.
FORWARD_ARGUMENTS = ("batch",)

# Errors of a disk; those raised while reading carry no file name.
_DISK_ERRORS = (errno.EIO, errno.ENOSPC, errno.EFBIG, errno.EDQUOT, errno.EROFS, errno.ESTALE)
_NEXT_STEPS = """\
omsm: on-machine surface measurement, corrected for the dynamic error of machine and probe.

  check this computer           omsm doctor
  demonstrate on a twin         omsm demo --out out/demo
  write bags to try it out      omsm twin --out trial/
  plan a step test              omsm plan steps --out plan/
  import CSV, HDF5, MATLAB …    omsm import log.csv --map map.yaml --out steps.mcap
  inspect a recording           omsm inspect steps.mcap
  identify the dynamics         omsm identify steps.mcap --out cal.json --report certificate/
  predict error and speed       omsm predict scan.csv --calibration cal.json
  correct a scan                omsm correct scan.mcap --calibration cal.json --out result/
  evaluate the form             omsm form result/ --nominal mirror.yaml --out form/
  correct a folder of scans     omsm batch scans/ --calibration cal.json --out week/

'omsm --help' lists all commands, 'omsm COMMAND --help' the options of one."""


def _by_task() -> str:
    lines = []
    for task, words in TASKS.items():
        lines += ["", f"{task}:"]
        for name, word in words.items():
            lines += textwrap.wrap(
                f"  {name:<{_INDENT - 2}}{word.help}", _WIDTH, subsequent_indent=" " * _INDENT
            )
    return "\n".join([*lines, "", "'omsm COMMAND --help' lists the options of a command."])


def parser_of(wanted: Collection[str]) -> argparse.ArgumentParser:
    """Return the parser of ``omsm`` with every command, and the arguments of those ``wanted``."""
    parser = OneLineParser(
        prog="omsm",
        description="Identify dynamics, correct recorded scans and evaluate form.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=_by_task(),
    )
    if len(wanted) == 1:
        (parser.word,) = wanted
    parser.add_argument("--version", action="version", version=__version__)
    words = parser.add_subparsers(required=True, metavar="command", dest="command")
    for name, word in WORDS.items():
        sub = words.add_parser(name, description=word.help)
        sub.add_argument("--json", action="store_true", help="print one JSON object, in SI units")
        if name in wanted:
            _declare(name, sub)
    return parser


def _declare(word: str, sub: argparse.ArgumentParser) -> None:
    if word == DEMO:
        command = CliCommand(DEMO, _declare_demo, _experiment, _show_experiment)
    else:
        with interruptible():  # only the module of this command is loaded
            module = importlib.import_module(f"omsm_ros.cli.{WORDS[word].module}")
        command = next(command for command in module.COMMANDS if command.name == word)
    sub.set_defaults(run=command)
    command.declare(Arguments(sub, word))


def _declare_demo(add: Arguments) -> None:
    add("--out", "DIR", default=Path("out/demo"))
    add("--time-lapse", TIME_LAPSE, "speed relative to real time; 20 if the device allows")
    add("--device", str, "model of the emulated probe", default="six_channel")
    add("--disturbances", str, "errors of the emulated machine", metavar="FILE")
    add("--view", None, "show the scan in a browser")
    add("--seed", SEED, "seed of the twin's noise", default=1)
    add("--experiment", str, choices=tuple(EXPERIMENTS))


def _experiment(args: argparse.Namespace) -> Facts:
    from omsm_ros.pipelines.paper_experiments import run_experiment

    module, _, task = EXPERIMENTS[args.experiment].partition(":")
    run = getattr(importlib.import_module(f"omsm_ros.pipelines.{module}"), task)
    return run_experiment(args.experiment, run, args.out, args.seed) | {"out": str(args.out)}


def _show_experiment(facts: Facts) -> Rows:
    for row in facts["compared"]:
        paper = row["paper"] or "not printed"
        say(f"{row['name']}: {row['ours']} (paper: {paper}) {row['remark']}".rstrip())
    return [written(["report.html"], facts["out"])]


@written_for(COMMAND)
def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    _make_writable()
    if not given:
        say_lines(_NEXT_STEPS)
        return DONE
    try:
        own, passed_on = _split(given)
        named = [a for a in own if a in WORDS][:1]
        if not named and (near := difflib.get_close_matches(own[0], WORDS, 1)):
            raise UsageError(
                f"{own[0]!r}: unknown command, did you mean {near[0]!r}? see 'omsm --help'"
            )
        args = parser_of(named).parse_args(own)
        args.passed_on = passed_on
        return _run(args, own)
    except OmsmError as err:
        warn(too_many_open_files(err) or str(err))
        return BAD_INPUT
    except KeyboardInterrupt as err:
        warn(INTERRUPTION)
        if isinstance(err, TerminationRequestedError):  # its parent shall see the cause
            signal.signal(err.number, signal.SIG_DFL)
            os.kill(os.getpid(), err.number)
        return INTERRUPTED
    except BrokenPipeError:
        # The reader closed the pipe, so nothing more may be flushed to it at exit.
        os.dup2(null_device(), sys.stdout.fileno())
        return DONE
    except MemoryError as err:
        warn(f"out of memory: {err or 'none is left'}; process less data at once")
        return BAD_INPUT
    except Exception as err:
        if os.environ.get(DEBUG):
            raise
        return _report_internal_error(err)


def _make_writable() -> None:
    """Make the standard streams accept any text, also if they are closed."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # closed by the parent process
            setattr(sys, name, os.fdopen(null_device(), "w"))
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # file names may be any bytes


def _report_internal_error(err: Exception) -> int:
    known = too_many_open_files(err)
    if isinstance(err, FileNotFoundError) and err.filename is None:  # of os.getcwd
        known = "the folder in which this command runs was deleted; change to one that exists"
    elif isinstance(err, OSError) and (err.filename is not None or err.errno in _DISK_ERRORS):
        # The system refuses a path: a name too long, no permission, a broken disk.
        path = "a file" if err.filename is None else shown(os.fsdecode(err.filename))
        known = known or f"{path}: {err.strerror}; check the path, its permissions and the disk"
    warn(known or defect(err))
    return BAD_INPUT if known else DEFECT


def _split(given: list[str]) -> tuple[list[str], list[str]]:
    """Return the arguments before and after "--" of a command that passes the latter on.

    Raises ConfigurationError for a null character, or an option without a value.
    """
    for word in given:
        if word.startswith("--") and word.endswith("=--"):  # argparse reads it as an empty list
            raise ConfigurationError(f"option {shown(word)} has no value; give one")
        if "\0" in word:
            raise ConfigurationError(f"argument {shown(word)} holds a null character; leave it out")
    if given[0] not in FORWARD_ARGUMENTS or "--" not in given:
        return given, []
    place = given.index("--")
    return given[:place], given[place + 1 :]


def _run(args: argparse.Namespace, given: list[str]) -> int:
    check_outputs(args)
    if args.command == DEMO and not args.experiment:
        # The demonstration is a node itself, so that only its process imports ROS.
        command = [sys.executable, "-m", "omsm_ros.nodes.start", "cell_demo"]
        return subprocess.call([*command, *given[given.index(DEMO) + 1 :]])
    with interrupt_on_signal(), progress_in_background(f"omsm {args.command}", args.json):
        facts = args.run.act(args)
    _tell(args, facts)
    if refusal := args.run.refusal(facts):
        warn(refusal)
        return BAD_INPUT
    return DONE


def _tell(args: argparse.Namespace, facts: Facts) -> None:
    try:
        if args.json:
            print(json_and_yaml.text_of(json_and_yaml.unknown_as_null(facts)))
        else:
            table(args.run.show(facts) or [])
        sys.stdout.flush()
    except OSError as err:
        if isinstance(err, BrokenPipeError) or err.filename is not None:
            raise
        os.dup2(null_device(), sys.stdout.fileno())  # the rest would fail again at exit
        raise FileError(
            f"cannot write to standard output: {err.strerror}; the command itself is done; free "
            "space there, or redirect the output"
        ) from err
