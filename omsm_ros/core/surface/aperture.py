"""Aperture: the area of a part that counts, in its x and y."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Literal, get_args

import numpy as np
import scipy  # whose parts are loaded when they are used

from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.core.surface.height_grid import Gradient, gradient_of
from omsm_ros.errors import SurfaceError
from omsm_ros.quantities import LENGTH

Outline = Literal["disc", "annulus", "ellipse", "rectangle", "polygon"]
# Points on the rim are inside although float32 rounds them.
_RIM = 1 + 1e-6
# Points of a drawn rim. Nodes of Gauss along the radius, exact for order 8; across a polygon.
_DRAWN, _NODES, _ACROSS = 181, 16, 256
# Cells that show gaps; the widest gap that is covered, in tracks, and at least in cells.
_CELLS_ACROSS, _GAP_IN_TRACKS, _LEAST_CELLS = 512, 3.5, 3.0
# Share of the points that an outline holds within a track of its rim. An ellipse holds 79 % of a
# rectangle, and 97 % of a disc without a sector.
_HOLDS_ALL = 0.998
# Share by which another outline than the aperture must be covered better.
_CLEARLY = 0.02
# Directions in which the rim of a scan may lie a track within that of the aperture.
_AROUND = np.exp(0.25j * np.pi * np.arange(8))
# The smallest disc about the part's origin counts if its middle is off by less than this share:
# the end of a spiral of twelve turns moves it by a quarter of a track.
_CENTRED = 0.02


@dataclass(frozen=True, slots=True)
class Aperture:
    """An area within the disc of ``radius`` about (``x``, ``y``) [m], over which its terms extend.

    outline: of the area, the disc itself unless stated
    sizes: inner radius of an annulus, half lengths along x and y of an ellipse or rectangle, or
        x, y, x, y … of the corners of a polygon [m]
    """

    radius: float
    x: float = 0.0
    y: float = 0.0
    outline: Outline = "disc"
    sizes: tuple[float, ...] = ()

    @classmethod
    def parse(cls, text: str) -> Aperture:
        """Return the aperture of a text such as '12e-3' or 'ellipse:12e-3,17e-3,0,1e-3' [m].

        Radius of a disc, radius and inner radius of an annulus, half lengths of an ellipse or
        rectangle, each with x and y of its middle if that is not the origin; corners of a polygon.
        Raises SurfaceError for another text.
        """
        outline, _, numbers = text.rpartition(":")
        try:
            sizes = [float(part) for part in numbers.split(",")]
        except ValueError as err:
            raise SurfaceError("surface.aperture", text=text) from err
        return cls.of(outline.strip() or "disc", *sizes)

    @classmethod
    def of(cls, outline: str, *sizes: float) -> Aperture:
        """Return the aperture of an outline and its sizes [m], in the order of :meth:`parse`."""
        text = f"{outline}:" + ",".join(f"{size:g}" for size in sizes)
        for size in sizes:
            LENGTH.checked(size, SurfaceError, "aperture")
        if outline == "polygon" and len(sizes) >= 6 and len(sizes) % 2 == 0:
            middle, radius = smallest_disc(np.array(sizes[::2]), np.array(sizes[1::2]))
            return cls(radius, *middle, "polygon", sizes)
        own = 1 if outline == "disc" else 2
        known = outline in get_args(Outline)[:-1] and len(sizes) in (own, own + 2)
        if not known or min(sizes[:own]) <= 0 or (outline == "annulus" and sizes[1] >= sizes[0]):
            raise SurfaceError("surface.aperture", text=text)
        middle = (0.0, 0.0) if len(sizes) == own else (sizes[-2], sizes[-1])
        if own == 1:
            return cls(sizes[0], *middle)
        if outline == "annulus":
            return cls(sizes[0], *middle, "annulus", (sizes[1],))
        long = max(sizes[:2]) if outline == "ellipse" else float(np.hypot(sizes[0], sizes[1]))
        return cls(long, *middle, outline, (sizes[0], sizes[1]))  # type: ignore[arg-type]

    @property
    def disc(self) -> Aperture:
        """The disc that holds the area."""
        return Aperture(self.radius, self.x, self.y)

    def holds(self, x: FloatArray, y: FloatArray) -> BoolArray:
        """Return which points lie within the aperture, of their shape."""
        u, v = np.asarray(x) - self.x, np.asarray(y) - self.y
        if self.outline == "polygon":
            return _within(u, v, _RIM * (self._corners() - [[self.x], [self.y]]))
        share = self.share_of_rim(x, y)
        inside = share <= _RIM
        if self.outline == "annulus":
            inside &= share >= self.sizes[0] / self.radius / _RIM
        return np.asarray(inside)

    def share_of_rim(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the size of the outline of this shape through each point: 1 at the outer rim.

        For a polygon it is one less the distance from its nearest side over the largest of them.
        """
        u, v = np.asarray(x) - self.x, np.asarray(y) - self.y
        if self.outline == "polygon":
            away = _to_sides(u, v, self._corners() - [[self.x], [self.y]])
            return 1 - away / np.max(away, initial=np.finfo(np.float64).tiny)
        if self.outline not in ("ellipse", "rectangle"):
            return np.asarray(np.sqrt(u * u + v * v) / self.radius)  # four times as fast as hypot
        a, b = np.abs(u) / self.sizes[0], np.abs(v) / self.sizes[1]
        return np.asarray(np.maximum(a, b) if self.outline == "rectangle" else np.hypot(a, b))

    def scaled(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return x and y on the unit disc."""
        return (x - self.x) / self.radius, (y - self.y) / self.radius

    def rim(self) -> FloatArray:
        """Return the closed outline (2, n) [m]; that of an annulus returns along its hole."""
        if self.outline == "polygon":
            corners = self._corners()
            return np.append(corners, corners[:, :1], axis=1)
        middle, angle = np.array([[self.x], [self.y]]), np.linspace(0, 2 * np.pi, _DRAWN)
        turn = np.stack([np.cos(angle), np.sin(angle)])
        if self.outline == "rectangle":
            turn = np.array([[1, -1, -1, 1, 1], [1, 1, -1, -1, 1]], np.float64)
        if self.outline in ("ellipse", "rectangle"):
            return np.asarray(middle + np.array(self.sizes)[:, np.newaxis] * turn)
        hole = self.sizes[0] * turn[:, ::-1] if self.outline == "annulus" else np.empty((2, 0))
        return np.asarray(middle + np.concatenate([self.radius * turn, hole], axis=1))

    def nodes(self) -> FloatArray:
        """Return x, y [m] and areas [m²] that make integrals (3, n), of a polygon to 1e-3."""
        if self.outline == "polygon":
            # Turned, because sides are often along x or y.
            at, cell = (2 * np.arange(_ACROSS) + 1) / _ACROSS - 1, (2 * self.radius / _ACROSS) ** 2
            place = self.radius * np.exp(0.5j) * np.add.outer(at, 1j * at).ravel()
            nodes = np.stack([self.x + place.real, self.y + place.imag, np.full(len(place), cell)])
            return nodes[:, self.holds(*nodes[:2])]
        at, share = np.polynomial.legendre.leggauss(_NODES)
        a, b = self.sizes if self.outline in ("ellipse", "rectangle") else (self.radius,) * 2
        if self.outline == "rectangle":
            place, area = np.add.outer(at, 1j * at).ravel(), a * b * np.outer(share, share).ravel()
        else:
            hole = (self.sizes[0] / self.radius) ** 2 if self.outline == "annulus" else 0.0
            turn = np.exp(2j * np.pi * np.arange(3 * _NODES) / (3 * _NODES))
            place = np.outer(np.sqrt(hole + (1 - hole) * (at + 1) / 2), turn).ravel()
            area = np.repeat(share, len(turn)) * (1 - hole) * np.pi * a * b / 2 / len(turn)
        return np.stack([self.x + a * place.real, self.y + b * place.imag, area])

    def _corners(self) -> FloatArray:
        return np.array(self.sizes).reshape(-1, 2).T


def _within(x: FloatArray, y: FloatArray, corners: FloatArray) -> BoolArray:
    """Return which points lie within the polygon of ``corners`` (2, k): an odd number of edges."""
    inside = np.zeros(np.shape(x), bool)
    for (ax, ay), (bx, by) in zip(corners.T, np.roll(corners, -1, axis=1).T, strict=True):
        crossed = (ay > y) != (by > y)
        inside ^= crossed & (x < ax + (bx - ax) * (y - ay) / ((by - ay) or 1.0))
    return inside


def _to_sides(x: FloatArray, y: FloatArray, corners: FloatArray) -> FloatArray:
    """Return the distance of points from the nearest side of the polygon of ``corners`` (2, k)."""
    place, found = x + 1j * y, np.full(np.shape(x), np.inf)
    begins = corners[0] + 1j * corners[1]
    for begin, side in zip(begins, np.roll(begins, -1) - begins, strict=True):
        along = np.clip(np.real((place - begin) / (side or 1.0)), 0.0, 1.0)
        found = np.minimum(found, np.abs(place - begin - along * side))
    return found


def smallest_disc(x: FloatArray, y: FloatArray) -> tuple[tuple[float, float], float]:
    """Return middle and radius [m] of the smallest disc that holds the points x, y (n,) [m].

    The farthest point joins the two or three that the disc rests on, until none lies outside.
    """
    places = np.asarray(x) + 1j * np.asarray(y)
    resting, middle, radius = [places[0]], complex(places[0]), 0.0
    while True:
        away = np.abs(places - middle)
        far = int(np.argmax(away))
        if away[far] <= radius * (1 + 1e-12) or len(resting) > 3:
            break
        points = [*resting, places[far]]
        rests = [r for k in (2, 3) for r in combinations(points, k)]
        discs = [(c, float(np.max(np.abs(np.array(points) - c))), r) for r in rests
                 if (c := _through(*r)) is not None]  # fmt: skip
        middle, larger, through = min(discs, key=lambda disc: disc[1])
        if larger <= radius:  # rounding
            break
        radius, resting = larger, list(through)
    return (float(middle.real), float(middle.imag)), float(away[far])


def _through(a: complex, b: complex, c: complex | None = None) -> complex | None:
    """Return the middle of the smallest circle through two or three points, None on a line."""
    if c is None:
        return (a + b) / 2
    b, c = b - a, c - a
    cross = 2 * (b.real * c.imag - b.imag * c.real)
    if abs(cross) <= 1e-12 * abs(b) * abs(c):
        return None
    return a + 1j * (abs(c) ** 2 * b - abs(b) ** 2 * c) / cross


def disc_of(x: FloatArray, y: FloatArray) -> Aperture:
    """Return the disc that holds points x, y (n,) [m], about the origin if that is their middle."""
    middle, radius = smallest_disc(x, y)
    if np.hypot(*middle) < _CENTRED * radius:
        middle, radius = (0.0, 0.0), float(np.hypot(x, y).max())
    return Aperture(radius or 1.0, *middle)


def best_covered(
    x: FloatArray, y: FloatArray, track: float, aperture: Aperture, free: bool
) -> tuple[float, Aperture]:
    """Return the share of an aperture that points x, y (n,) [m] leave uncovered, and the aperture.

    track: distance of neighbouring tracks [m]
    free: the smallest disc around the points stands for an ``aperture`` that lies elsewhere, or
        the rectangle or ellipse around them, if it has less

    Wider gaps than holes of random points count; the rim may lie a track within the aperture's.
    """
    box = [(float(np.ptp(v)) / 2, float(v.max() + v.min()) / 2) for v in (x, y)]
    sizes = [half for half, _ in box] + [middle for _, middle in box]
    track = max(track, 2 * float(np.sqrt(sizes[0] * sizes[1] / len(x))))
    if min(sizes[:2]) < track:
        return 0.0, aperture  # a profile
    middle, radius = smallest_disc(x, y)
    # The end of a spiral moves the middle by a quarter of a track.
    if free and np.hypot(middle[0] - aperture.x, middle[1] - aperture.y) > track / 3:
        aperture = Aperture(radius, *middle)
    pitch = max(2 * aperture.radius / _CELLS_ACROSS, track / 2)
    reach = max(_GAP_IN_TRACKS * track, _LEAST_CELLS * pitch) / 2 / pitch
    half = aperture.radius + (np.ceil(reach) + 1) * pitch
    ends = [np.arange(m - half, m + half + pitch, pitch) for m in (aperture.x, aperture.y)]
    empty = np.histogram2d(x, y, ends)[0] == 0
    # Morphological closing (Serra 1982) with a disc: dilation followed by erosion.
    near = scipy.ndimage.distance_transform_edt(empty) <= reach
    open_ = scipy.ndimage.distance_transform_edt(near) <= reach
    shapes = [aperture]
    if free:
        around_points = [Aperture.of(outline, *sizes) for outline in ("rectangle", "ellipse")]
        most = 1 + track / min(sizes[:2])
        shapes += [s for s in around_points if np.mean(s.share_of_rim(x, y) < most) > _HOLDS_ALL]
    u, v = np.meshgrid(*[(e[1:] + e[:-1]) / 2 for e in ends], indexing="ij")
    around, shares = (track + pitch) * _AROUND, []
    for shape in shapes:
        inside = np.all([shape.holds(u + a.real, v + a.imag) for a in around], axis=0)
        shares.append(float(np.mean(open_[inside])) if inside.any() else 1.0)
    # The box of a spiral is smaller by half a track, so that an ellipse seems to be covered better.
    best = int(np.argmin(shares)) if min(shares) < shares[0] - _CLEARLY else 0
    return shares[best], shapes[best]


def within_aperture(surface: Surface, aperture: Aperture | None) -> tuple[Surface, Aperture | None]:
    """Return surface and aperture, which is that of a :class:`BoundedSurface` unless stated."""
    if not isinstance(surface, BoundedSurface):
        return surface, aperture
    return surface.surface, aperture or surface.aperture


@dataclass(frozen=True, slots=True)
class BoundedSurface:
    """A nominal ``surface`` of which an ``aperture`` counts, in the frame of the surface."""

    surface: Surface
    aperture: Aperture

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m], beyond the aperture too."""
        return self.surface.height(x, y)

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]."""
        return gradient_of(self.surface, x, y)
