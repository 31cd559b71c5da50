"""How far from an independent track, and whether the covariances say so.

Without such a track `held_out` and `consistency` judge by the pings themselves.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ubl_graph.arrays import BoolArray, FloatArray
from ubl_graph.mission import Reference
from ubl_graph.result import Result
from ubl_graph.trajectory import Trajectory

#: Seconds from a segment's ends from where on a time counts as interior.
INTERIOR = 40.0
#: Squared Mahalanobis length of the 95 % ellipse: chi-square with two degrees of freedom.
ELLIPSE = -2.0 * math.log(0.05)


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors against a reference at its times.

    Attributes
    ----------
    t : array, shape (M,)
        s.
    error : array, shape (M, 3)
        Estimate minus reference, east, north, up, m.
    nees : array, shape (M,)
        Squared Mahalanobis length of the horizontal error: 2 on average where the covariance is
        true.
    interior : array of bool, shape (M,)
        Which times are more than 40 s from the segment's ends.
    """

    t: FloatArray
    error: FloatArray
    nees: FloatArray
    interior: np.ndarray

    @property
    def covered(self) -> BoolArray:
        """Which references lie inside the 95 % ellipse of the horizontal position, shape (M,)."""
        return self.nees < ELLIPSE

    @property
    def horizontal(self) -> FloatArray:
        """Length of the horizontal error, m, shape (M,)."""
        return np.hypot(self.error[:, 0], self.error[:, 1])

    def summary(self) -> dict[str, float | int | None]:
        """Horizontal RMSE (m) and mean NEES over all and over the interior, and the coverage."""
        inner = self.interior
        return {
            "count": len(self.t),
            "interior_count": int(inner.sum()),
            "horizontal_rmse_m": _rms(self.horizontal),
            "interior_horizontal_rmse_m": _rms(self.horizontal[inner]),
            "mean_nees_2dof": _mean(self.nees),
            "interior_mean_nees_2dof": _mean(self.nees[inner]),
            "coverage_95": _mean(self.covered),
        }

    @staticmethod
    def joined(parts: Iterable[Errors]) -> Errors:
        """All times of several, in order."""
        parts = list(parts)
        return Errors(
            *(np.concatenate([getattr(p, n) for p in parts]) for n in Errors.__dataclass_fields__)
        )


def errors_of(trajectory: Trajectory, reference: Reference) -> Errors:
    """Compare a trajectory with a reference at the reference's times within its span."""
    inside = (reference.t >= trajectory.t[0]) & (reference.t <= trajectory.t[-1])
    t = reference.t[inside]
    states = trajectory.at(t)
    error = states.position - reference.position[inside]
    horizontal = error[:, :2]
    solved = np.linalg.solve(states.covariance[:, :2, :2], horizontal[..., None])[..., 0]
    interior = (t > trajectory.t[0] + INTERIOR) & (t < trajectory.t[-1] - INTERIOR)
    return Errors(t, error, np.einsum("mi,mi->m", horizontal, solved), interior)


def evaluate(result: Result) -> dict[str, Errors]:
    """Errors of every segment that has a reference, by segment name; empty without any."""
    return {
        solved.name: errors_of(solved.trajectory, segment.reference)
        for segment, solved in zip(result.mission.segments, result.segments, strict=True)
        if segment.reference is not None and len(segment.reference.t)
    }


def _mean(values: FloatArray | BoolArray) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _rms(values: FloatArray) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if len(values) else None
