"""A diamond-turning machine in forty lines of numpy, written apart from the adjustment.

The paper's mirror: paraboloid ``Z = R²/4f`` of f = 25.4 mm, 50.8 mm off its axis, heights along
the normal at its centre, solved from the parent's equation by Newton. Z follows the nominal
surface; the probe measures what is left. Every error of the machine is a keyword.
"""

from __future__ import annotations

import numpy as np

from omsm_ros.core.adjustment import ScanData

RADIUS_M, F_M, OFF_M = 12.7e-3, 25.4e-3, 50.8e-3


class Mirror:
    """Heights of the mirror along its normal [m]."""

    def height(self, x, y):
        slope = OFF_M / (2 * F_M)
        norm = np.hypot(1.0, slope)
        w = np.zeros(np.broadcast(x, y).shape)
        for _ in range(6):
            # Point of the parent's frame from tangent coordinates (u along x, w along the normal).
            across = OFF_M + (x - slope * w) / norm
            up = OFF_M**2 / (4 * F_M) + (slope * x + w) / norm
            miss = up - (across**2 + y**2) / (4 * F_M)
            w = w - miss / (1 / norm + across * slope / norm / (2 * F_M))
        return w


MIRROR = Mirror()


def form(x, y):
    """Form error of the part, 177 nm peak to valley [m]: low orders, and waves of 4 mm."""
    u, v = x / RADIUS_M, y / RADIUS_M
    r2 = u**2 + v**2
    low = 30e-9 * (u**2 - v**2) + 25e-9 * (3 * r2 - 2) * u + 30e-9 * (6 * r2**2 - 6 * r2 + 1)
    return low + 12e-9 * (u**3 - 3 * u * v**2) + 3e-9 * np.sin(2 * np.pi * x / 4e-3)


def rings(x, y):
    """Form of a turned part: astigmatism, trefoil, and rings of 8 nm and 1.6 mm [m]."""
    u, v = x / RADIUS_M, y / RADIUS_M
    low = 40e-9 * (u**2 - v**2) + 20e-9 * (u**3 - 3 * u * v**2)
    return low + 4e-9 * np.cos(2 * np.pi * np.hypot(x, y) / 1.6e-3)


def _fading(z, samples):
    """Return the motion less its mean over the last ``samples``, fading."""
    from scipy import signal

    step = 1 / samples
    return signal.lfilter([step], [1, step - 1], z, zi=[z[0] * (1 - step)])[0] - z


def _played(z, half):
    """Return what a rod does in a sleeve that is ``half`` wider on either side, and moves by z."""
    rod = np.empty(len(z))
    rod[0] = z[0]
    for k in range(1, len(z)):
        gap = rod[k - 1] - z[k]
        rod[k] = z[k] + np.sign(gap) * half if abs(gap) > half else rod[k - 1]
    return rod


def _height_rate(place, step=1e-4):
    """Return the rate of the mirror's height [m/s] at ``place``, a function of time [s]."""
    return (MIRROR.height(*place(step)) - MIRROR.height(*place(-step))) / (2 * step)


class Machine:
    """One part on one machine; ``scan`` may be called again for further scans.

    Sizes in SI units; ``spindle`` are (number per turn, cosine, sine) of axial motion.
    """

    def __init__(
        self, seed, noise=12e-9, walk=1.2e-9, ramp=0.15e-9, lag=0.0, latency=0.0,
        spindle=((2, 12e-9, 0.0), (3, 0.0, 9e-9), (4, 3.5e-9, -3.5e-9)), pitch=0.4e-3, rate=1000.0,
        part=form, **errors,
    ):  # fmt: skip
        self.random = np.random.default_rng(seed)
        self.noise, self.walk, self.ramp = noise, walk, ramp
        self.lag, self.latency, self.spindle = lag, latency, spindle
        self.pitch, self.rate, self.part, self.errors = pitch, rate, part, errors
        self.begin = 0.0

    def truth(self, x, y):
        """Height of the part over the nominal surface [m]."""
        return self.part(x, y)

    def scan(self, rpm=30.0, outward=False, clocking=0.0, start=RADIUS_M, end=0.0, clamping=0,
             lag=None, moved=(0.0, 0.0), turned=0.0, **more):  # fmt: skip
        """Return a spiral from ``start`` to ``end``, or back with ``outward``.

        moved, turned: of the part since it was last looked at [m], [rad], unknown to the scan
        """
        wrong = {**self.errors, **more}
        lag = self.lag if lag is None else lag
        duration = abs(start - end) / self.pitch * 60 / abs(rpm)
        t = np.arange(round(duration * self.rate)) / self.rate
        r = start + (end - start) * t / duration
        r = r[::-1] if outward else r
        c = np.sign(rpm) * 2 * np.pi * abs(rpm) / 60 * t
        omega = 2 * np.pi * rpm / 60
        r_rate = (end - start) / duration * (-1 if outward else 1)

        def place(c, r, dx=0.0, dy=0.0):
            """Part coordinates under the probe at slide (r + dx, dy) and spindle angle c."""
            z = (r + dx + 1j * dy) * np.exp(-1j * (c + clocking))
            return z.real, z.imag

        there = place(c, r)
        z = MIRROR.height(*there)
        bow = wrong.get("bow_of_z", 0.0) * (np.cos(np.pi * (z / 0.6e-3)) - 1)
        lateral = [np.interp(z, *wrong[n]) if n in wrong else 0.0 for n in ("x_of_z", "y_of_z")]
        seen = place(
            c - self.latency * omega + wrong.get("c_lost", 0.0) * (t > 0.5 * duration)
            + wrong.get("c_once", 0.0) * np.cos(c),
            r - self.latency * r_rate + wrong.get("screw", 0.0) * np.sin(np.pi * r / 1e-3 + 1.0),
            wrong.get("centre_x", 0.0) + bow + lateral[0], wrong.get("centre_y", 0.0) + lateral[1],
        )  # fmt: skip
        at = (seen[0] + 1j * seen[1]) * np.exp(-1j * turned) - complex(*moved)
        seen = (at.real, at.imag)
        z_rate = _height_rate(lambda dt: place(c + omega * dt, r + r_rate * dt))
        true = MIRROR.height(*seen) + self.part(*seen)
        held = np.exp(-(self.begin + t) / 150.0) * (seen[0] ** 2 - seen[1] ** 2) / RADIUS_M**2
        true = true + wrong.get("clamp", 0.0) * held
        stand_off = wrong.get("stand_off", 0.0)
        z = z - stand_off * np.sin(2 * np.pi * t / 7.0)
        z_rate = z_rate - stand_off * (2 * np.pi / 7.0) * np.cos(2 * np.pi * t / 7.0)
        height = true + lag * z_rate + self._of_machine(c, r, t, z, z_rate, duration, wrong)
        height = height + self.noise * self.random.standard_normal(len(t))
        removed = wrong.get("removed_lag", 340e-6) * z_rate
        height = height + wrong.get("wrong_sign", 0.0) * removed
        # What makes the height together with H(z) = z − removed.
        distance = height - (z - removed)
        # In the frame of the chuck the part's place is turned by the clocking.
        chuck = (there[0] + 1j * there[1]) * np.exp(1j * clocking)
        scan = ScanData(
            time=self.begin + t, x=chuck.real, y=chuck.imag, height=height, distance=distance,
            motion=z, removed=removed, c=c, clocking=clocking, clamping=clamping,
        )  # fmt: skip
        self.begin += duration + 20.0
        return scan

    def _of_machine(self, c, r, t, z, z_rate, duration, wrong):
        walk = np.cumsum(self.random.standard_normal(len(t))) * self.walk / np.sqrt(self.rate)
        made = walk + self.ramp * t
        for n, cosine, sine in (*self.spindle, *wrong.get("more_spindle", ())):
            made = made + cosine * np.cos(n * c) + sine * np.sin(n * c)
        made = made + wrong.get("asymmetry", 0.0) * np.abs(z_rate)
        span = (z - np.mean(z)) / np.max(np.abs(z - np.mean(z)))
        absolute = (self.begin + t) / 400.0
        lag = (
            wrong.get("lag_by_x", 0.0) * r / RADIUS_M
            + wrong.get("lag_by_z", 0.0) * span
            + wrong.get("lag_by_time", 0.0) * absolute
        )
        made = made + lag * z_rate
        made = made + wrong.get("warming", 0.0) * (1 - np.exp(-(self.begin + t) / 150.0))
        made = made + wrong.get("creep", 0.0) * _fading(z, 2.0 * self.rate)
        made = made + wrong.get("slow_creep", 0.0) * _fading(z, 8.0 * self.rate)
        made = made + wrong.get("stretch", 0.0) * z
        made = made + wrong.get("backlash", 0.0) * np.sign(z_rate)
        if "play" in wrong:
            made = made + z - _played(z, wrong["play"])
        made = made + wrong.get("settling", 0.0) * np.exp(-t / 15.0)
        made = made + wrong.get("height_step", 0.0) * (t > 0.4 * duration)
        made = made + wrong.get("hum", 0.0) * np.sin(2 * np.pi * 50.0 * t + 1.0)
        made = made + wrong.get("floor", 0.0) * np.sin(2 * np.pi * 2.13 * t + 1.0)
        for name, along in (("straightness", r), ("bend_of_z", z)):
            if name in wrong:
                made = made + np.interp(along, *wrong[name])
        tilt = wrong.get("growth", 0.0)
        return made + tilt * r / RADIUS_M + wrong.get("bow", 0.0) * (r / RADIUS_M) ** 2
