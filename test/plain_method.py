"""The paper's method in plain numpy: bilinear filter and recursion, of a calibration's file."""

import numpy as np


def bilinear(ascending, period):
    """Return numerator and denominator in q = z⁻¹, of one length, for s = 2/T (1 − q)/(1 + q)."""
    order = max(map(len, ascending)) - 1
    minus, plus = np.array([1.0, -1.0]) * 2 / period, np.array([1.0, 1.0])
    made = []
    for coefficients in ascending:
        total = np.zeros(order + 1)
        for power, value in enumerate(coefficients):
            term = np.array([value])
            for k in range(order):
                term = np.convolve(term, minus if k < power else plus)
            total += term
        made.append(total)
    b, a = made
    return b / a[0], a / a[0]


def recursion(b, a, x, inside=None):
    """Return x_o[k] of Eq. 13; ``inside`` is added in the recursion, as printed."""
    y = np.full(len(x), x[0] * np.sum(b) / np.sum(a))
    added = np.zeros(len(x)) if inside is None else inside
    if inside is not None:
        y += inside[0] / np.sum(a)
    for k in range(len(b), len(x)):
        y[k] = b @ x[k - np.arange(len(b))] - a[1:] @ y[k - np.arange(1, len(a))] + added[k]
    return y


def plain_height(stored, period, z, distance):
    """Return heights (n,) [m] of encoder and probe by Eq. 10, for the file of a calibration."""
    assert not stored["delay"]
    b, a = bilinear((stored["numerator"], stored["denominator"]), period)
    return recursion(b, a, z) + distance / stored["static_gain"]
