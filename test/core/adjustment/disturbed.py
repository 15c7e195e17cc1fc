"""What the adjustment says of machines with one wrong declaration each.

``python test/core/adjustment/disturbed.py SEEDS SCANS [KIND …]`` prints, for each kind, the
families named and how far the figures are off in stated standard uncertainties.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from coverage import PRIORS, drawn, normalised
from plain_world import MIRROR

from omsm_ros.core.adjustment import adjust

KINDS = {
    "clean": {},
    "centre_y": {"centre_y": 10e-6},
    "centre_x": {"centre_x": 3e-6},
    "asymmetry": {"asymmetry": 20e-6},
    "backlash": {"backlash": 30e-9},
    "play": {"play": 40e-9},
    "clamp": {"clamp": 150e-9},
    "spindle_3": {"more_spindle": ((3, 60e-9, 0.0),)},
    "spindle_6": {"more_spindle": ((6, 20e-9, 0.0),)},
    "spindle_2.5": {"more_spindle": ((2.5, 20e-9, 0.0),)},
    "settling": {"settling": 150e-9},
    "height_step": {"height_step": 90e-9},
    "c_lost": {"c_lost": 5e-4},
    "hum": {"hum": 25e-9},
    "floor": {"floor": 20e-9},
    "growth": {"growth": 300e-9},
    "wrong_sign": {"wrong_sign": 1.0},
    "bow": {"bow": 100e-9},
    "latency": {"latency": 2e-4},
    "lag_by_x": {"lag_by_x": 30e-6},
    "lag_by_z": {"lag_by_z": 30e-6},
    "lag_by_time": {"lag_by_time": 30e-6},
    "warming": {"warming": 300e-9},
    "creep": {"creep": 3e-4},
    "stretch": {"stretch": 1e-4},
    "bow_of_z": {"bow_of_z": 1e-6},
    "screw": {"screw": 1e-6},
    "noise": {"noise": 40e-9},
    "walk": {"walk": 5e-9},
}


def main(seeds, scans, kinds):
    for kind in kinds or KINDS:
        for seed in range(seeds):
            machine, made = drawn(seed, scans, **KINDS[kind])
            found = adjust(made, PRIORS, nominal=MIRROR, accuracy=25e-9)
            pv, rms, _, terms, error = normalised(machine, found)
            names = [(r.name, *r.alike) for r in found.refutations]
            off = max(abs(pv), abs(rms), float(np.max(np.abs(terms))))
            print(f"{kind:12} {seed} {found.verdict.code:14} off {off:6.1f} u, form "
                  f"{1e9 * error:6.1f} nm, stated {1e9 * found.form.mean_uncertainty:5.1f}  "
                  f"{names}{[r.code for r in found.verdict.reasons if not r.names]}"
                  f"{' wrong sign' if found.wrong_sign else ''}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3:])
