"""Parse the command line, run one command, and return its exit status."""

from __future__ import annotations

import argparse
import importlib
import io
import os
import subprocess
import sys
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

from omsm_ros import __version__, quantities
from omsm_ros.cli.arguments import OneLineParser, number
from omsm_ros.cli.command import Command
from omsm_ros.errors import DEBUG, OmsmError, defect
from omsm_ros.storage import strict_json

DONE, BAD_INPUT, DEFECT, INTERRUPTED = 0, 2, 70, 130  # 70 is EX_SOFTWARE of sysexits.h

_LONGEST_LINE = 1500
_WIDTH, _INDENT = 79, 14

# A correction takes a quarter of a second; loading what identifies would take twice that.
WORDS = {
    "omsm_ros.cli.inspecting": ("inspect",),
    "omsm_ros.cli.measuring": ("predict", "correct"),
    "omsm_ros.cli.resolving": ("selfcal", "reversal", "latency"),
    "omsm_ros.cli.aligning": ("align",),
    "omsm_ros.cli.forming": ("form", "compensate", "surface"),
    "omsm_ros.cli.identifying": ("identify", "validate"),
    "omsm_ros.cli.calibrating": ("plan", "verify", "compare", "calset"),
    "omsm_ros.cli.starting": ("twin", "doctor"),
    "omsm_ros.cli.importing": ("import",),
    "omsm_ros.cli.reporting": ("report",),
    "omsm_ros.cli.completing": ("completion",),
    "omsm_ros.cli.campaigning": ("batch",),
    "omsm_ros.cli.remembering": ("history",),
    "omsm_ros.cli.exporting": ("export",),
    "omsm_ros.cli.comparing": ("difference",),
    "omsm_ros.cli.rippling": ("spectrum",),
}

DEMO = "demo"
_DEMO_HELP = "calibrate and measure on the digital twin (needs ROS)"

# As one comes to need them, for the list of all commands.
TASKS = {
    "begin": ("doctor", DEMO, "twin", "completion"),
    "recordings": ("inspect", "import"),
    "dynamics of probe and machine": ("plan", "identify", "verify", "compare", "calset"),
    "latency": ("selfcal", "reversal", "latency"),
    "a scan": ("surface", "predict", "align", "correct", "report"),
    "the part": ("form", "compensate", "difference", "spectrum", "export"),
    "many scans": ("batch", "history"),
    "models of other systems": ("validate",),
}

# What stands after "--" is for the command that these run in turn.
PASS_ON = ("batch",)


_WHAT_NEXT = """\
omsm: measure optics on the machine that cut them, the dynamic error corrected.

  is this computer ready?       omsm doctor
  see it all on a twin          omsm demo --out out/demo
  bags to try things out        omsm twin --out trial/
  on a machine, plan a test     omsm plan steps --out plan/
  what is in a recording?       omsm inspect steps.mcap
  identify the dynamics         omsm identify steps.mcap --out cal.json --report certificate/
  how fast may a scan be?       omsm predict scan.csv --calibration cal.json
  correct a scan                omsm correct scan.mcap --calibration cal.json --out result/
  what shape is the part?       omsm form result/ --nominal mirror.yaml --out form/

'omsm --help' has all commands, 'omsm COMMAND --help' its options."""


def _commands(word: str) -> list[Command]:
    """The commands of the module that knows ``word``; all of them if none does."""
    wanted = [module for module, words in WORDS.items() if word in words] or list(WORDS)
    return [c for module in wanted for c in importlib.import_module(module).COMMANDS]


def _by_task(helps: Mapping[str, str]) -> str:
    """The commands with what each does, those of one task together."""
    lines, placed = [], {word for words in TASKS.values() for word in words}
    others = tuple(word for word in helps if word not in placed)
    for task, words in {**TASKS, "others": others}.items():
        lines += ["", f"{task}:"] if words else []
        for word in words:
            told = helps.get(word, "")
            lines += textwrap.wrap(
                f"  {word:<{_INDENT - 2}}{told}", _WIDTH, subsequent_indent=" " * _INDENT
            )
    return "\n".join([*lines, "", "'omsm COMMAND --help' has the options of each."])


def parser_of(word: str) -> argparse.ArgumentParser:
    """Return the parser of ``omsm``: with the command ``word``, or with all of them."""
    parser = OneLineParser(
        prog="omsm",
        description="Identify, correct and judge recorded measurements.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.word = word if any(word in words for words in WORDS.values()) else ""
    parser.add_argument("--version", action="version", version=__version__)
    words = parser.add_subparsers(required=True, metavar="command", dest="command")
    commands = _commands(word)
    parser.epilog = _by_task({DEMO: _DEMO_HELP, **{c.name: c.help for c in commands}})
    for command in commands:
        sub = words.add_parser(command.name, description=command.help)
        sub.add_argument("--json", action="store_true", help="print one JSON object, in SI units")
        sub.set_defaults(run=command)
        command.declare(sub)
    demo = words.add_parser(DEMO, description=_DEMO_HELP)
    demo.add_argument("--json", action="store_true", help="print one JSON object, in SI units")
    demo.add_argument("--out", type=Path, default=Path("out/demo"), metavar="DIR")
    lapse, seed = number(quantities.TIME_LAPSE), number(quantities.SEED)
    demo.add_argument("--time-lapse", type=lapse, default=20.0, help="times faster than real")
    demo.add_argument("--device", default="six_channel", help="what the emulated probe speaks")
    demo.add_argument("--disturbances", metavar="FILE", help="what is wrong with the machine")
    demo.add_argument("--view", action="store_true", help="show the scan in a browser")
    demo.add_argument("--seed", type=seed, default=1, help="of the twin's noise")
    demo.add_argument(
        "--experiment",
        choices=("chirp", "circles", "vibration", "mirror"),
        help="one of the paper's, Fig. 9, 10, 11 or 8, beside ours; needs no ROS",
    )
    return parser


def _experiment(args: argparse.Namespace) -> int:
    from omsm_ros.jobs.paper_experiments import run_experiment

    facts = run_experiment(args.experiment, args.out, args.seed)
    if args.json:
        print(strict_json.text_of(strict_json.unknown_as_null(facts)), flush=True)
        return DONE
    for row in facts["compared"]:
        print(f"{row['name']}: {row['ours']} (paper: {row['paper'] or '-'}) {row['remark']}")
    print(f"written: {args.out / 'report.html'}")
    return DONE


def _demo(args: argparse.Namespace) -> int:
    if args.experiment:
        return _experiment(args)
    # The demonstration runs real nodes, so it is one; ROS is imported only there.
    command = [sys.executable, "-m", "omsm_ros.nodes.start", "cell_demo", "--out", str(args.out)]
    command += ["--time-lapse", str(args.time_lapse), "--seed", str(args.seed)]
    command += ["--device", args.device]
    command += ["--disturbances", args.disturbances] if args.disturbances else []
    command += ["--view"] if args.view else []
    return subprocess.call([*command, *(["--json"] if args.json else [])])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names of files may be any bytes
    if not given:
        print(_WHAT_NEXT)
        return DONE
    try:
        own, passed_on = _split(given)
        args = parser_of(own[0]).parse_args(own)
        args.passed_on = passed_on
        return _run(args)
    except OmsmError as err:
        _say(str(err))
        return BAD_INPUT
    except KeyboardInterrupt:
        _say("interrupted; no unfinished file was left")
        return INTERRUPTED
    except BrokenPipeError:
        # Who read our output has enough of it; nothing more may be flushed to it at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except MemoryError as err:
        _say(f"memory is short: {err or 'none is left'}; give less at once")
        return BAD_INPUT
    except Exception as err:
        if os.environ.get(DEBUG):
            raise
        _say(defect(err))
        return DEFECT


def _split(given: list[str]) -> tuple[list[str], list[str]]:
    """Arguments before and after "--", where the command passes the latter on."""
    if given[0] not in PASS_ON or "--" not in given:
        return given, []
    place = given.index("--")
    return given[:place], given[place + 1 :]


def _run(args: argparse.Namespace) -> int:
    if args.command == DEMO:
        return _demo(args)
    facts = args.run.act(args)
    if args.json:
        print(strict_json.text_of(strict_json.unknown_as_null(facts)), flush=True)
    else:
        args.run.show(facts)
    if refusal := args.run.refusal(facts):
        _say(refusal)
        return BAD_INPUT
    return DONE


def _say(text: str) -> None:
    line = " ".join(text.split())
    if len(line) > _LONGEST_LINE:  # a path of thousands of characters; the remedy stands last
        line = f"{line[: _LONGEST_LINE // 2]} … {line[-_LONGEST_LINE // 2 :]}"
    print("omsm:", line, file=sys.stderr)
