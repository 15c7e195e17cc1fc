"""All benchmarks, one table, ``out/bench.json``: ``python -m benchmarks [--full] [part …]``.

Without ``--full`` there are fewer runs of each study, so wider bars; each line says how many.

Ends with exit status 1 if a bar is not cleared.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
import time
from pathlib import Path

from benchmarks.row import Row

PARTS = (
    *(
        "identification",
        "disturbed",
        "free_path",
        "correction",
        "honesty",
        "speed",
        "offline",
        "live",
        "devices",
        "real_data",
        "selfcal",
        "spectra",
        "form",
        "budget",
    ),
    "twin",
    "campaign",
    "viewer",
)


def show(row: Row) -> None:
    """Print one line of the table."""
    mark = {True: "ok", False: "FAILS", None: "-"}[row["holds"]]
    peer = row["peer"]
    against = f"{peer:.4g}" if isinstance(peer, float) else peer or ""
    print(
        f"{mark:<6}{row['name']:<72}{row['runs'] or '':>5}{row['value']:>12.4g} {row['unit']:<6}"
        f"{row['bar']:<16}{against}",
        flush=True,
    )


def _processor_time() -> float:
    """Seconds that this process and those it waited for have taken."""
    took = os.times()
    return took.user + took.system + took.children_user + took.children_system


def main() -> int:
    """Run the parts asked for, all by default."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("parts", nargs="*", default=PARTS, metavar="part", help=", ".join(PARTS))
    parser.add_argument("--full", action="store_true", help="all runs: three quarters of an hour")
    parser.add_argument("--out", type=Path, default=Path("out/bench.json"))
    args = parser.parse_args()
    unknown = sorted(set(args.parts) - set(PARTS))
    if unknown:
        parser.error(f"no part {unknown}, expected {', '.join(PARTS)}")
    found: list[Row] = []
    print(f"{'':6}{'figure':72}{'runs':>5}{'value':>12} {'':6}{'bar':16}peer")
    for part in args.parts:
        begin, used = time.monotonic(), _processor_time()
        for row in importlib.import_module(f"benchmarks.{part}").rows(args.full):
            found.append(row)
            show(row)
        wall, cpu = time.monotonic() - begin, _processor_time() - used
        print(f"      {part}: {wall:.0f} s, {cpu:.0f} s of processor time", flush=True)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    # JSON has no NaN: what could not be had is null.
    plain = [{k: None if v != v else v for k, v in row.items()} for row in found]
    args.out.write_text(json.dumps(plain, indent=1) + "\n")
    failed = [row["name"] for row in found if row["holds"] is False]
    print(f"{len(found)} figures in {args.out}, {len(failed)} bars not cleared")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
