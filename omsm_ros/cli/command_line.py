"""Parse the command line, run one command, and return its exit status."""

from __future__ import annotations

import argparse
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

from omsm_ros import __version__, quantities
from omsm_ros.cli import INTERRUPTED, INTERRUPTION, interruptible
from omsm_ros.cli.arguments import OneLineParser, number
from omsm_ros.cli.command import say, say_lines, table, written
from omsm_ros.cli.words import TASKS, WORDS
from omsm_ros.errors import (
    DEBUG,
    ConfigurationError,
    FileError,
    OmsmError,
    defect,
    one_line,
    shortened,
    too_many_open_files,
)
from omsm_ros.io import json_and_yaml
from omsm_ros.messages import COMMAND, written_for
from omsm_ros.pipelines.progress import refresh_in_thread, tick
from omsm_ros.quantities import shown

if TYPE_CHECKING:
    from omsm_ros.cli.command import CliCommand, Facts


# Seconds on the terminal, where a command works for long and nobody can tell how long.

# What is over before that needs no line.
_PATIENCE_S = 1.0


@contextmanager
def progress_in_background(title: str, quiet: bool) -> Iterator[None]:
    """Count the seconds on stderr, with ``title``; silent for programs, in pipes and at first.

    Bars of what can be counted stand below it.
    """
    if quiet or not sys.stderr.isatty():
        yield
        return
    with refresh_in_thread(partial(_show, title)):
        yield


def _show(title: str, done: Event) -> None:
    if done.wait(_PATIENCE_S):
        return
    from tqdm import tqdm

    with tqdm(desc=title, bar_format="{desc}: {elapsed} so far", leave=False) as line:
        line.start_t -= _PATIENCE_S
        tick(line, done)


# A command that is asked to end removes what it has not finished, as it does on Ctrl-C.

# As "kill", "systemctl stop" or a batch system ask, and a terminal that is closed.
_ASKED = (signal.SIGTERM, signal.SIGHUP)


class TerminationRequestedError(KeyboardInterrupt):
    """The signal ``number`` came; like Ctrl-C it is no error of what is being done."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


@contextmanager
def interrupt_on_signal() -> Iterator[None]:
    """Raise TerminationRequestedError where a signal would end the process at once; the second one does."""
    if threading.current_thread() is not threading.main_thread():
        yield  # signals are the main thread's
        return

    def asked(number: int, _: object) -> None:
        signal.signal(number, signal.SIG_DFL)
        raise TerminationRequestedError(number)

    # What is ignored stays so, as SIGHUP below nohup.
    ours = [one for one in _ASKED if signal.getsignal(one) is signal.SIG_DFL]
    for one in ours:
        signal.signal(one, asked)
    try:
        yield
    finally:
        for one in ours:
            signal.signal(one, signal.SIG_DFL)


def end_by_signal(number: int) -> None:
    """End this process by the signal ``number``, so that who waits for it sees by what it ended."""
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


# May results be written there, or would they take the place of what was measured?
#
# A name completed by the shell is easily that of the recording itself. Every command puts its
# result
# in the place of an older one, so what is read, and any recording, is looked for before it begins.

_OUTPUTS = ("out", "plot", "report")
_RECORDINGS = (".mcap", ".db3", ".bag")
# What a command makes of a file is one of the same kind, which may stand for it.
_IN_PLACE = {
    ("latency", "calibration"),
    ("reversal", "calibration"),
    ("selfcal", "calibration"),
    ("align", "geometry"),
}


def check_outputs(args: argparse.Namespace) -> None:
    """Raise ConfigurationError where an output of a command is what it reads, or a recording."""
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
                f"{what} is what is read, and would be lost; give another name"
            )
        # Who writes recordings takes the place of none, and says so.
        taken = args.command != "import" and written.is_file()
        if taken and written.suffix.lower() in _RECORDINGS:
            raise ConfigurationError(f"{what} is a recording, and would be lost; give another name")


def _paths(value: object) -> Iterator[Path]:
    """Yield the paths in what an argument was taken for."""
    if isinstance(value, list | tuple):
        for one in value:
            yield from _paths(one)
    elif isinstance(value, str | Path) and value != "":
        yield Path(value)


def _same(written: Path, path: Path) -> bool:
    """Return whether both are one file, or one folder that is a bag."""
    try:
        alike = os.path.samefile(written, path)
    except (OSError, ValueError):
        return False
    return alike and (written.is_file() or (written / "metadata.yaml").is_file())


DONE, BAD_INPUT, DEFECT = 0, 2, 70  # 70 is EX_SOFTWARE of sysexits.h

_WIDTH, _INDENT = 79, 14

DEMO = "demo"

# What stands after "--" is for the command that these run in turn.
FORWARD_ARGUMENTS = ("batch",)


# What the system says of a disk, without a name where it is said while reading.
_DISK_ERRORS = (errno.EIO, errno.ENOSPC, errno.EFBIG, errno.EDQUOT, errno.EROFS, errno.ESTALE)
_NEXT_STEPS = """\
omsm: measure optics on the machine that cut them, the dynamic error corrected.

  is this computer ready?       omsm doctor
  see it all on a twin          omsm demo --out out/demo
  bags to try things out        omsm twin --out trial/
  on a machine, plan a test     omsm plan steps --out plan/
  your own CSV, HDF5, MATLAB …  omsm import log.csv --map map.yaml --out steps.mcap
  what is in a recording?       omsm inspect steps.mcap
  identify the dynamics         omsm identify steps.mcap --out cal.json --report certificate/
  how fast may a scan be?       omsm predict scan.csv --calibration cal.json
  correct a scan                omsm correct scan.mcap --calibration cal.json --out result/
  what shape is the part?       omsm form result/ --nominal mirror.yaml --out form/
  a folder full of scans        omsm batch scans/ --calibration cal.json --out week/

'omsm --help' has all commands, 'omsm COMMAND --help' its options."""


def _command(word: str) -> CliCommand:
    """Return the command ``word``; nothing is loaded but what its module needs."""
    with interruptible():
        module = importlib.import_module(f"omsm_ros.cli.{WORDS[word].module}")
    return next(command for command in module.COMMANDS if command.name == word)


def _by_task() -> str:
    """Return the commands with what each does, those of one task together."""
    lines = []
    for task, words in TASKS.items():
        lines += ["", f"{task}:"]
        for name, word in words.items():
            lines += textwrap.wrap(
                f"  {name:<{_INDENT - 2}}{word.help}", _WIDTH, subsequent_indent=" " * _INDENT
            )
    return "\n".join([*lines, "", "'omsm COMMAND --help' has the options of each."])


def parser_of(wanted: Collection[str]) -> argparse.ArgumentParser:
    """Return the parser of ``omsm``: it knows every word, and the arguments of those ``wanted``."""
    parser = OneLineParser(
        prog="omsm",
        description="Identify, correct and judge recorded measurements.",
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
        _declare_demo(sub)
        return
    command = _command(word)
    sub.set_defaults(run=command)
    command.declare(sub)


def _declare_demo(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--out", type=Path, default=Path("out/demo"), metavar="DIR")
    lapse, seed = number(quantities.TIME_LAPSE), number(quantities.SEED)
    sub.add_argument("--time-lapse", type=lapse, help="times faster than real (20)")
    sub.add_argument("--device", default="six_channel", help="what the emulated probe speaks")
    sub.add_argument("--disturbances", metavar="FILE", help="what is wrong with the machine")
    sub.add_argument("--view", action="store_true", help="show the scan in a browser")
    sub.add_argument("--seed", type=seed, default=1, help="of the twin's noise")
    sub.add_argument(
        "--experiment",
        choices=("chirp", "circles", "vibration", "mirror"),
        help="one of the paper's, Fig. 9, 10, 11 or 8, beside ours; needs no ROS",
    )


def _experiment(args: argparse.Namespace) -> int:
    from omsm_ros.pipelines.paper_experiments import run_experiment

    facts = run_experiment(args.experiment, args.out, args.seed)
    if args.json:
        print(json_and_yaml.text_of(json_and_yaml.unknown_as_null(facts)), flush=True)
        return DONE
    for row in facts["compared"]:
        say(f"{row['name']}: {row['ours']} (paper: {row['paper'] or '-'}) {row['remark']}")
    table([written(["report.html"], str(args.out))])
    return DONE


def _demo(args: argparse.Namespace) -> int:
    if args.experiment:
        return _experiment(args)
    # The demonstration runs real nodes, so it is one; ROS is imported only there.
    command = [sys.executable, "-m", "omsm_ros.nodes.start", "cell_demo", "--out", str(args.out)]
    command += ["--device", args.device, "--seed", str(args.seed)]
    command += ["--time-lapse", str(args.time_lapse)] if args.time_lapse else []
    command += ["--disturbances", args.disturbances] if args.disturbances else []
    command += ["--view"] if args.view else []
    return subprocess.call([*command, *(["--json"] if args.json else [])])


@written_for(COMMAND)
def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    _make_writable()
    if not given:
        say_lines(_NEXT_STEPS)
        return DONE
    try:
        _check_words(given)
        own, passed_on = _split(given)
        named = [a for a in own if a in WORDS][:1]
        args = parser_of(named).parse_args(own)
        args.passed_on = passed_on
        return _run(args)
    except OmsmError as err:
        _warn(too_many_open_files(err) or str(err))
        return BAD_INPUT
    except KeyboardInterrupt as err:
        _warn(INTERRUPTION)
        if isinstance(err, TerminationRequestedError):
            end_by_signal(err.number)
        return INTERRUPTED
    except BrokenPipeError:
        # Who read our output has enough of it; nothing more may be flushed to it at exit.
        os.dup2(_null_device(), sys.stdout.fileno())
        return DONE
    except MemoryError as err:
        _warn(f"memory is short: {err or 'none is left'}; give less at once")
        return BAD_INPUT
    except Exception as err:
        if os.environ.get(DEBUG):
            raise
        return _report_internal_error(err)


def _make_writable() -> None:
    """Let anything be written to the standard streams, also where they are closed."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # closed by who has started this
            setattr(sys, name, os.fdopen(_null_device(), "w"))
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names of files may be any bytes


def _report_internal_error(err: Exception) -> int:
    """Say what nobody foresaw; return the exit status."""
    if short := too_many_open_files(err):
        _warn(short)
        return BAD_INPUT
    if isinstance(err, OSError) and (err.filename is not None or err.errno in _DISK_ERRORS):
        # Of a place that the system refuses: a name too long, no permission, a broken disk.
        path = "a file" if err.filename is None else shown(os.fsdecode(err.filename))
        _warn(f"{path}: {err.strerror}; check the path, its permissions and the disk")
        return BAD_INPUT
    _warn(defect(err))
    return DEFECT


def _check_words(given: list[str]) -> None:
    """Raise ConfigurationError for a word that ends in the middle, or an option without a value."""
    for word in given:
        if word.startswith("--") and word.endswith("=--"):  # argparse takes it for an empty list
            raise ConfigurationError(f"option {shown(word)} has no value; give one")
        if "\0" in word:
            raise ConfigurationError(f"argument {shown(word)} holds a null character; leave it out")


def _split(given: list[str]) -> tuple[list[str], list[str]]:
    """Return the arguments before and after "--", where the command passes the latter on."""
    if given[0] not in FORWARD_ARGUMENTS or "--" not in given:
        return given, []
    place = given.index("--")
    return given[:place], given[place + 1 :]


def _run(args: argparse.Namespace) -> int:
    check_outputs(args)
    if args.command == DEMO:
        return _demo(args)
    with interrupt_on_signal(), progress_in_background(f"omsm {args.command}", args.json):
        facts = args.run.act(args)
    _tell(args, facts)
    if refusal := args.run.refusal(facts):
        _warn(refusal)
        return BAD_INPUT
    return DONE


def _tell(args: argparse.Namespace, facts: Facts) -> None:
    try:
        if args.json:
            print(json_and_yaml.text_of(json_and_yaml.unknown_as_null(facts)))
        else:
            args.run.show(facts)
        sys.stdout.flush()
    except OSError as err:
        if isinstance(err, BrokenPipeError) or err.filename is not None:
            raise
        os.dup2(_null_device(), sys.stdout.fileno())  # what waits to be printed fails again at exit
        raise FileError(
            f"standard output takes no more: {err.strerror}; the command was carried out; make "
            "room there, or send it elsewhere"
        ) from err


def _warn(text: str) -> None:
    try:
        print("omsm:", one_line(text), file=sys.stderr, flush=True)
    except OSError:  # nobody can be told, but the exit status is right
        os.dup2(_null_device(), sys.stderr.fileno())


def _null_device() -> int:
    return os.open(os.devnull, os.O_WRONLY)
