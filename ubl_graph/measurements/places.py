"""Where the vehicle is: depth from pressure, and positions from elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.records import Records, Source

#: Positions farther from the origin than this are not local, m.
MAX_DISTANCE = 1e7

# One standard deviation of each kind where neither a column nor an option gives it.
DEPTH_SIGMA = 0.1  #: m; a pressure sensor of 0.01 % of 1 000 m
POSITION_SIGMA = 2.0  #: m; GNSS without corrections


@dataclass(frozen=True, eq=False)
class Depth(Records):
    """Depth below the origin's level, from pressure.

    Parameters
    ----------
    t : float or array, shape (M,)
        Seconds.
    depth : float or array, shape (M,)
        Metres, positive down; up = -depth.
    sigma : float or array, shape (M,), default 0.1
        Standard deviation, m.
    source : Source, optional
        File and rows the records came from.
    """

    t: Any
    depth: Any
    sigma: Any = DEPTH_SIGMA
    source: Source | None = None

    LIMITS: ClassVar = {
        "depth": (-1000.0, 12000.0, "m"),
        "sigma": (1e-6, 1000.0, "m"),
    }


@dataclass(frozen=True, eq=False)
class PositionFix(Records):
    """A position from elsewhere: GNSS at the surface, a USBL fix, a survey mark.

    Parameters
    ----------
    t : float or array, shape (M,)
        Seconds.
    east, north : float or array, shape (M,)
        Metres.
    up : float or array, shape (M,), optional
        Metres; left out for a horizontal fix.
    sigma : float or array, shape (M,), default 2.0
        Standard deviation of each component, m. Ignored where `covariance` is given.
    covariance : array, shape (2, 2), (3, 3), (M, 2, 2) or (M, 3, 3), optional
        Covariance over east, north (and up), m^2.
    source : Source, optional
        File and rows the records came from.

    Raises
    ------
    DataError
        Where a value is not finite, or a covariance is not symmetric and positive definite or
        not of the size that the components ask for.
    """

    t: Any
    east: Any
    north: Any
    up: Any = None
    sigma: Any = POSITION_SIGMA
    covariance: Any = None
    source: Source | None = None

    LIMITS: ClassVar = {
        "east": (-MAX_DISTANCE, MAX_DISTANCE, "m"),
        "north": (-MAX_DISTANCE, MAX_DISTANCE, "m"),
        "up": (-MAX_DISTANCE, MAX_DISTANCE, "m"),
        "sigma": (1e-6, 1e6, "m"),
    }

    def _check(self) -> None:
        if self.covariance is not None:
            d = self.dimension
            self._check_covariance(
                {d: f"a fix of {d} components"}, "give variances in m^2 on the diagonal"
            )

    @property
    def dimension(self) -> Literal[2, 3]:
        """2 for horizontal fixes, 3 where `up` is given."""
        return 2 if self.up is None else 3

    @property
    def position(self) -> FloatArray:
        """East, north (and up), m, shape (M, 2) or (M, 3)."""
        parts = [self.east, self.north] + ([] if self.up is None else [self.up])
        return np.stack(parts, axis=1)

    @property
    def covariances(self) -> FloatArray:
        """Covariance of each fix, m^2, shape (M, 2, 2) or (M, 3, 3)."""
        if self.covariance is not None:
            return self.covariance
        return np.eye(self.dimension) * self.sigma[:, None, None] ** 2
