"""Which points stand for a whole scan where its systematic errors are judged?

Sensitivity fields are smooth over a scan: a few thousand points, evenly chosen in time, show what
millions would, in memory that does not grow.
"""

from __future__ import annotations

import numpy as np

from omsm_ros.core.correction.systematic import ScanPoints
from omsm_ros.core.machine.kinematics import WorkpiecePoints
from omsm_ros.core.samples.blocks import BoolArray, FloatArray
from omsm_ros.core.samples.even_selection import EvenSelection

# Sixteen points a turn of the paper's scan and more: enough for what repeats eight times a turn.
MOST_TRACED = 8192

_COLUMNS = ("time", "x", "y", "height", "z", "z_rate", "c", "distance")


class ScanTrace:
    """Points of a scan, evenly chosen while they pass; time and Z count from the first one.

    seen: points that passed
    hidden: which changes by the covariance are of what the step test could not show, (r,)
    """

    def __init__(self, most: int = MOST_TRACED) -> None:
        self._kept = EvenSelection(most)
        self._session: int | None = None
        self._late = self._last = 0.0
        self._first_z = 0.0
        self.hidden: BoolArray = np.zeros(0, np.bool_)
        self.seen = 0

    def add(
        self,
        session: int,
        time: FloatArray,
        where: WorkpiecePoints,
        c: FloatArray,
        motion: FloatArray,
        distance: FloatArray,
    ) -> ScanPoints:
        """Take in the next points, each array (n,), and return them as fields look at them.

        session, time: of the trigger's counter, by which the samples are counted [s]; what comes
            after a restart of the counter is taken to follow at once
        motion: H(z), its rate, and its change by each direction of the covariance, (2 + r, n)
        """
        if len(time):
            if session != self._session:
                self._session, self._late = session, self._last - float(time[0])
            self._last = float(time[-1]) + self._late
            if not self.seen:
                self._first_z = float(motion[0, 0])
        points = ScanPoints(
            time=time + self._late,
            x=where.x,
            y=where.y,
            height=where.height,
            z=motion[0] - self._first_z,
            z_rate=motion[1],
            c=c,
            distance=distance,
            dynamics=motion[2:],
            hidden=self.hidden,
        )
        self._keep(points)
        return points

    @property
    def every(self) -> int:
        """Of how many points one is kept."""
        return self._kept.every

    def _keep(self, points: ScanPoints) -> None:
        self.seen += len(points)
        chosen = self._kept.chosen(len(points))
        rows = [getattr(points, name)[chosen] for name in _COLUMNS]
        self._kept.add_chosen(np.stack([*rows, *points.dynamics[:, chosen]]).T, len(points))

    def points(self) -> ScanPoints:
        """Return those kept, in the order of time."""
        rows = self._kept.rows() if self.seen else np.empty((0, len(_COLUMNS)))
        columns = dict(zip(_COLUMNS, rows.T, strict=False))
        return ScanPoints(**columns, dynamics=rows.T[len(_COLUMNS) :], hidden=self.hidden)
