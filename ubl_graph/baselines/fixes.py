"""What a window method gives: one position a window, or none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ubl_graph.arrays import BoolArray, FloatArray, IntArray
from ubl_graph.mission import Reference


@dataclass(frozen=True, eq=False)
class Fixes:
    """Positions from windows of pings, one row a window, in order of time.

    Attributes
    ----------
    t : array, shape (M,)
        Times that the positions belong to, s.
    position : array, shape (M, 3)
        East, north, up, m; nan where the window has no solution.
    solved : array of bool, shape (M,)
        Which windows have one.
    iterations : array of int, shape (M,)
        Of the least squares; 0 where it is linear.
    """

    t: FloatArray
    position: FloatArray
    solved: BoolArray
    iterations: IntArray

    def __len__(self) -> int:
        return len(self.t)

    def errors(self, reference: Reference) -> FloatArray:
        """Horizontal distance (M,), m, from a reference interpolated linearly to the fixes' times.

        nan where there is no solution, or no reference.
        """
        east, north = (
            np.interp(self.t, reference.t, reference.position[:, axis], np.nan, np.nan)
            for axis in (0, 1)
        )
        return np.hypot(self.position[:, 0] - east, self.position[:, 1] - north)
