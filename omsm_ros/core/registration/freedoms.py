"""Which freedoms of its pose does a surface determine?

A freedom is taken up if it changes the deviation in a way that those before it do not. A sphere
that is turned about its axis stays what it is; moved sideways it does what a tilt does.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from omsm_ros.core.registration.placement import FREEDOMS
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.readable import quantity
from omsm_ros.units import DEGREE_RAD, MILLIMETRE_M, NANOMETRE_M

AUTO = "auto"
HELD = "freedoms held"
"""Name of the source of error that a freedom is which was held."""
RIGID = FREEDOMS[:6]
MOVES = ("x", "y", "clocking")
"""Freedoms that a chuck settles; piston, tip and tilt no part comes without."""
# Odds that a part was moved, at which it is said to be: strong evidence. Less may be its form.
_PLAINLY = 20.0
_LEAST_FORM_M = NANOMETRE_M


def widest(freedom: str) -> float:
    """Return how far a freedom may be off on a part that was put on its chuck by hand [m], [rad].

    One that a nanometre of form would move further than this is not determined by the surface.
    """
    if freedom == "power":
        return 1.0
    return MILLIMETRE_M if freedom in ("x", "y", "piston") else DEGREE_RAD


class Freedoms(NamedTuple):
    """What is fitted, in the order of its columns, and why something else is not.

    refused: the surface does not determine it;  held: at its nominal value, see :func:`weakest`
    """

    fitted: tuple[str, ...]
    refused: dict[str, str]
    held: dict[str, str]

    def without(self, name: str, reason: str) -> Freedoms:
        """Return the freedoms with one of them held."""
        left = tuple(n for n in self.fitted if n != name)
        return Freedoms(left, self.refused, {**self.held, name: reason})


def parsed_freedoms(text: str) -> tuple[str, ...]:
    """Return the freedoms of 'auto' or of a list such as 'piston,tip,tilt'.

    Raises ConfigurationError for a name that is no freedom, or stands twice.
    """
    names = [name.strip() for name in text.split(",") if name.strip()]
    known = [AUTO, *FREEDOMS]
    for name in names:
        if name not in known or names.count(name) > 1:
            why = "is unknown" if name not in known else "stands twice"
            raise ConfigurationError(f"freedom {name!r} {why}, expected a list of {known}")
    if not names:
        raise ConfigurationError(f"no freedom is named, expected a list of {known}")
    return tuple(names)


def determined(asked: Sequence[str], gram: FloatArray, points: int) -> Freedoms:
    """Return which of the freedoms ``asked`` for are determined.

    asked: of :data:`FREEDOMS`, or "auto", alone or beside "power": the rigid ones that are
    gram: sums of products (7, 7) of the columns of all freedoms over ``points``

    Raises DataError for a freedom that was named and is not determined.
    """
    automatic = AUTO in asked
    wanted = [n for n in FREEDOMS if n in asked or (automatic and n in RIGID)]
    fitted: list[str] = []
    refused: dict[str, str] = {}
    for name in wanted:
        reason = _undetermined(name, fitted, gram / points)
        if not reason:
            fitted.append(name)
        elif automatic and name not in asked:
            refused[name] = reason
        else:
            raise DataError(f"{name} cannot be fitted: {reason}; leave it out of the fit")
    return Freedoms(tuple(fitted), refused, {})


def weakest(
    names: Sequence[str], values: FloatArray, covariance: FloatArray, gram: FloatArray
) -> tuple[str, str] | None:
    """Return which move had better be held at its nominal value, and why; None if none had.

    One that takes away hardly more form than its uncertainty leaves open says nothing of the part:
    the odds that it moved, against one that sits as it should, are the density of its place at
    zero before the fit over that after it (J. Dickey, Ann. Math. Stat. 42, 204).

    values: of ``names`` (p,) as they were found;  covariance: of these (p, p)
    gram: mean products of what they do to the deviation (p, p)
    """
    spread = np.sqrt(np.diag(covariance))
    scale = np.sqrt(np.diag(gram))
    inverse = np.linalg.pinv(gram / np.outer(scale, scale), rcond=1e-14, hermitian=True)
    # The part of its column that no other freedom has.
    own = scale / np.sqrt(np.maximum(np.diag(inverse), 1.0))
    found = [
        ((values[k] / spread[k]) ** 2 / 2 - np.log(widest(name) / spread[k]), k)
        for k, name in enumerate(names)
        if name in MOVES and own[k] * spread[k] > _LEAST_FORM_M
    ]
    if not found or min(found)[0] > np.log(_PLAINLY):
        return None
    k = min(found)[1]
    unit = "rad" if names[k] == "clocking" else "m"
    return names[k], (
        f"form looks like it here: the points determine it to {quantity(spread[k], unit, 2)} only, "
        f"which is {quantity(own[k] * spread[k], 'm', 2)} rms of form, and do not show that the "
        f"part was moved ({quantity(values[k], unit, 2)} was found); what that opens widens every "
        "figure"
    )


def _undetermined(name: str, before: Sequence[str], gram: FloatArray) -> str:
    """Return why a freedom is not determined beside those ``before`` it, empty if it is."""
    places, own = [FREEDOMS.index(n) for n in before], FREEDOMS.index(name)
    alone = float(np.sqrt(gram[own, own]))
    if alone * widest(name) < _LEAST_FORM_M:
        return "the surface stays as it is when it is moved so"
    scale = np.sqrt(np.diag(gram))[places]
    shared = gram[places, own] / scale / alone
    normal = gram[np.ix_(places, places)] / np.outer(scale, scale)
    share = np.linalg.lstsq(normal, shared, rcond=1e-14)[0] if places else shared
    left = alone * np.sqrt(max(1 - float(shared @ share), 0.0))
    # Beneath this share of the column the difference is rounding.
    if left > 1e-6 * alone and left * widest(name) >= _LEAST_FORM_M:
        return ""
    same = [n for n, s in zip(before, share, strict=True) if abs(s) > 0.05]
    return f"on this surface it does what {' and '.join(same)} do" if len(same) > 1 else (
        f"on this surface it does what {''.join(same)} does"
    )  # fmt: skip
