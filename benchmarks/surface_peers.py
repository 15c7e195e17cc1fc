"""Figures of one map by prysm, SurfaceTopography and surfalize, in an environment of their own.

Run by ``benchmarks.form`` with the Python of that environment: ``surface_peers.py MAP.npz``. Prints
one JSON object of Sa, Sq, Sz [m], Sdq [1] and mean square in a band [m²] for each peer. Both peers
take Sdq from the differences of neighbouring points; prysm is given the window of the density. For
points x, y of the unit disc with "terms" (n, m) it is the processor time [s] of prysm's fit, and
its coefficients.
"""

import json
import sys
import time
import warnings

import numpy as np

warnings.simplefilter("ignore")


def surfalize(z, dx, dy, band, window):
    from surfalize import Surface

    made = Surface(z * 1e6, dx * 1e6, dy * 1e6)
    return {n: getattr(made, n)() * 1e-6 for n in ("Sa", "Sq", "Sz")} | {"Sdq": made.Sdq()}


def topography(z, dx, dy, band, window):
    from SurfaceTopography import Topography

    made = Topography(z.T, (z.shape[1] * dx, z.shape[0] * dy))
    return {"Sq": float(made.rms_height_from_area()), "Sdq": float(made.rms_gradient())}


def prysm(z, dx, dy, band, window):
    from prysm.interferogram import psd

    if abs(dx / dy - 1) > 1e-6:
        return {}  # it has square pixels only
    fy, fx, density = _psd(psd, z, dx, window)
    f = np.hypot(fx[np.newaxis], fy[:, np.newaxis])
    inside = (f >= band[0]) & (f <= band[1])
    cell = abs(fx[1] - fx[0]) * abs(fy[1] - fy[0])
    return {"in_band": float(np.sum(density[inside]) * cell)}


def _psd(psd, z, dx, window):
    found = psd(z - np.average(z, weights=window), dx, window)
    fx, fy, density = (np.asarray(part) for part in found)
    if fx.ndim == 2:
        fx, fy = fx[0], fy[:, 0]
    return fy, fx, density


def zernike_fit(x, y, value, terms):
    from prysm import polynomials

    begin = time.process_time()
    r, angle = np.hypot(x, y), np.arctan2(y, x)
    modes = list(polynomials.zernike_nm_sequence([(int(n), int(m)) for n, m in terms], r, angle))
    found = polynomials.lstsq(modes, value)
    return {"time": time.process_time() - begin, "coefficients": list(map(float, found))}


def main(path):
    content = np.load(path)
    if "terms" in content:
        print(json.dumps(zernike_fit(*(content[name] for name in ("x", "y", "value", "terms")))))
        return
    given = (
        content["z"],
        float(content["dx"]),
        float(content["dy"]),
        content["band"],
        content["window"],
    )
    found = {}
    for peer in (surfalize, topography, prysm):
        try:
            found[peer.__name__] = {n: float(v) for n, v in peer(*given).items()}
        except Exception as err:  # a release of a peer may lack a name
            found[peer.__name__] = {"error": f"{type(err).__name__}: {err}"}
    print(json.dumps(found))


main(sys.argv[1])
