"""Time and memory of four scans of 254 000 points: ``python test/core/adjustment/full_size.py``."""

from __future__ import annotations

import resource
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from coverage import PRIORS, drawn, normalised
from plain_world import MIRROR

from omsm_ros.core.adjustment import adjust


def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main(scans):
    machine, made = drawn(1, scans, pitch=0.1e-3)
    points = sum(map(len, made))
    before, cpu, wall = peak(), time.process_time(), time.perf_counter()
    found = adjust(made, PRIORS, nominal=MIRROR, accuracy=25e-9)
    print(f"{scans} scans, {points} points: {time.process_time() - cpu:.1f} s of one core, "
          f"{time.perf_counter() - wall:.1f} s by the clock, {peak():.0f} MiB at most, "
          f"{before:.0f} MiB before")  # fmt: skip
    *_, error = normalised(machine, found)
    lag = found.source("lag_change")
    print(f"form error {1e9 * error:.1f} nm rms, stated {1e9 * found.form.mean_uncertainty:.1f}; "
          f"U(PV) {2e9 * found.form.pv.uncertainty:.1f} nm; lag {1e6 * lag.found[0]:.2f} ± "
          f"{1e6 * lag.uncertainty[0]:.2f} µs, true {1e6 * machine.lag:.2f}; "
          f"{found.verdict.code}")  # fmt: skip


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 4)
