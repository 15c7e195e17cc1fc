"""All benchmarks, one table, ``out/bench.json``: ``python -m benchmarks [--full] [part …]``.

Without ``--full`` each study has fewer runs and wider limits; each line states the number of runs.
Parts that evaluate results run in parallel; parts that measure times follow, one after the other.

The exit status is 1 if a limit is exceeded. On a signal, all processes started are ended.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from benchmarks.ending import nothing_left
from benchmarks.parts import PARTS, measured
from benchmarks.row import Row


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
    with nothing_left():
        for part, rows, wall, processor in measured(args.parts, args.full):
            for row in rows:
                show(row)
            found += rows
            print(f"      {part}: {wall:.0f} s, {processor:.0f} s of processor time", flush=True)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    # JSON has no NaN: missing values are null.
    plain = [{k: None if v != v else v for k, v in row.items()} for row in found]
    args.out.write_text(json.dumps(plain, indent=1) + "\n")
    failed = [row["name"] for row in found if row["holds"] is False]
    print(f"{len(found)} figures in {args.out}, {len(failed)} bars not cleared")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
