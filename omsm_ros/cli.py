"""``omsm``: the offline commands.

Exit status 0: done; 2: bad input, with one line on stderr that says what to do. With
``--json`` standard output holds one JSON object and nothing else.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from omsm_ros import __version__, offline
from omsm_ros.core.calibration import Calibration
from omsm_ros.core.identify import identify
from omsm_ros.errors import OmsmError
from omsm_ros.files import load_calibration, load_surface, save_calibration
from omsm_ros.measurement import measure
from omsm_ros.units import MICROSECOND_S

BAD_INPUT = 2
INTERRUPTED = 130


@contextmanager
def progress_bar(title: str, quiet: bool) -> Iterator[offline.Progress]:
    """A bar on stderr that counts messages; silent for programs and in pipes."""
    hidden = quiet or not sys.stderr.isatty()
    with tqdm(desc=title, unit=" messages", leave=False, disable=hidden) as bar:

        def advance(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield advance


def _identify(args: argparse.Namespace) -> dict[str, Any]:
    with progress_bar("reading", args.json) as progress:
        motion = offline.motion_of_bag(args.bag, duration=args.duration, progress=progress)
    calibration = identify(motion, order=args.order, input=args.input, settings=args.settings)
    save_calibration(args.out, calibration)
    return _calibration_facts(calibration, args.out)


def _calibration_facts(calibration: Calibration, path: Path) -> dict[str, Any]:
    certificate = calibration.certificate
    return {
        "calibration": str(path),
        "id": calibration.id,
        "verdict": certificate.get("verdict"),
        "reasons": certificate.get("reasons", []),
        "warnings": certificate.get("warnings", []),
        "order": len(calibration.dynamics.denominator) - 1,
        "low_frequency_delay": calibration.dynamics.low_frequency_delay,
        "static_gain": calibration.static_gain,
        "valid_up_to": calibration.valid_up_to,
    }


def _correct(args: argparse.Namespace) -> dict[str, Any]:
    calibration = load_calibration(args.calibration)
    nominal = load_surface(args.nominal) if args.nominal else None
    with progress_bar("correcting", args.json) as progress:
        return measure(args.bag, calibration, args.out, nominal=nominal, progress=progress)


def _inspect(args: argparse.Namespace) -> dict[str, Any]:
    with progress_bar("reading", args.json) as progress:
        found = offline.inspect_bag(args.bag, progress)
    return {"bag": str(args.bag), "topics": offline.as_json(found)}


def _demo(args: argparse.Namespace) -> int:
    # The demonstration runs real nodes, so it is one; ROS is imported only there.
    command = [sys.executable, "-m", "omsm_ros.nodes.cell_demo_node", "--out", str(args.out)]
    command += ["--time-lapse", str(args.time_lapse), "--seed", str(args.seed)]
    return subprocess.call([*command, *(["--json"] if args.json else [])])


# ------------------------------------------------------------------------------- printing


def _print_identify(facts: dict[str, Any]) -> None:
    delay = facts["low_frequency_delay"] / MICROSECOND_S
    print(f"verdict              {facts['verdict']}")
    print(f"order                {facts['order']}")
    print(f"low-frequency delay  {delay:.2f} µs")
    print(f"static gain          {facts['static_gain']:.6f}")
    print(f"valid up to          {facts['valid_up_to']:.1f} Hz")
    for kind in ("reasons", "warnings"):
        for text in facts[kind]:
            print(f"{kind[:-1]:<20} {text}")
    print(f"written to           {facts['calibration']}")


def _print_correct(summary: dict[str, Any]) -> None:
    for stream, account in summary["samples"].items():
        reasons = "".join(f", {count} {name}" for name, count in account["counted"].items())
        print(
            f"{stream:<9} {account['received']} received, {account['corrected']} corrected{reasons}"
        )
    print(f"written   {', '.join(summary['files'].values())}")


def _print_inspect(facts: dict[str, Any]) -> None:
    row = "{topic:<22} {messages:>9} {samples:>11} {rate:>9} {gaps:>6} {restarts:>8} {invalid:>8}"
    names = ("topic", "messages", "samples", "gaps", "restarts", "invalid")
    print(row.format(rate="rate Hz", **{name: name for name in names}))
    for topic in facts["topics"]:
        period = topic["sample_period"]
        print(row.format(rate=f"{1 / period:g}" if period else "-", **topic))


# ------------------------------------------------------------------------------ arguments


def _json_object(text: str) -> dict[str, object]:
    value = json.loads(text)
    if not isinstance(value, dict):
        raise argparse.ArgumentTypeError(f"{text!r} is not a JSON object")
    return value


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="omsm", description=__doc__.splitlines()[0])
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(required=True, metavar="command")

    def command(name: str, action: Any, show: Any, text: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text)
        sub.add_argument("--json", action="store_true", help="print one JSON object")
        sub.set_defaults(action=action, show=show)
        return sub

    sub = command("identify", _identify, _print_identify, "identify G_m from a recorded step test")
    sub.add_argument("bag", type=Path)
    sub.add_argument("--out", type=Path, required=True, metavar="CAL.json")
    sub.add_argument("--order", type=int, default=0, help="number of poles; 0 = choose")
    sub.add_argument("--input", choices=("encoder", "reference"), default="encoder")
    sub.add_argument("--duration", type=float, default=0.0, help="seconds to use; 0 = all")
    sub.add_argument("--settings", type=_json_object, default={}, metavar="JSON")

    sub = command("correct", _correct, _print_correct, "correct a recorded scan")
    sub.add_argument("bag", type=Path)
    sub.add_argument("--calibration", type=Path, required=True, metavar="CAL.json")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR")
    sub.add_argument("--nominal", type=Path, metavar="SURFACE.yaml")

    sub = command("inspect", _inspect, _print_inspect, "show what a bag holds")
    sub.add_argument("bag", type=Path)

    sub = command("demo", _demo, None, "calibrate and measure on the digital twin (needs ROS)")
    sub.add_argument("--out", type=Path, default=Path("out/demo"), metavar="DIR")
    sub.add_argument("--time-lapse", type=float, default=20.0, help="times faster than real")
    sub.add_argument("--seed", type=int, default=1, help="of the twin's noise")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    args = _parser().parse_args(arguments)
    try:
        result = args.action(args)
        if isinstance(result, int):
            return result
        if args.json:
            print(json.dumps(result))
        else:
            args.show(result)
    except OmsmError as err:
        print(f"omsm: {err}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("omsm: interrupted; no unfinished file was left", file=sys.stderr)
        return INTERRUPTED
    return 0


if __name__ == "__main__":
    sys.exit(main())
