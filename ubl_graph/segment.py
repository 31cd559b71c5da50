"""A segment: what was measured on one line or dive, its start, and a track to compare with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ubl_graph.arrays import FloatArray, frozen
from ubl_graph.errors import ConfigurationError
from ubl_graph.measurements import (
    AngularRate,
    Attitude,
    Depth,
    Heading,
    Odometry,
    OneWayRange,
    PositionFix,
    SlantRange,
    TwoWayRange,
    Velocity,
)
from ubl_graph.records import Records

#: The record kinds of a segment: attribute, class, and the columns that make a duplicate.
RECORD_KINDS: dict[str, tuple[type[Records], tuple[str, ...]]] = {
    "two_way_range": (TwoWayRange, ("beacon", "t_transmit", "t_receive")),
    "one_way_range": (OneWayRange, ("beacon", "t_transmit", "t_receive")),
    "slant_range": (SlantRange, ("beacon", "t")),
    "velocity": (Velocity, ("t", "reference")),
    "attitude": (Attitude, ("t",)),
    "heading": (Heading, ("t",)),
    "angular_rate": (AngularRate, ("t",)),
    "odometry": (Odometry, ("t_from", "t_to")),
    "depth": (Depth, ("t",)),
    "position": (PositionFix, ("t",)),
}


@dataclass(frozen=True)
class Start:
    """Where the vehicle was at one time, as far as is known: a prior.

    Attributes
    ----------
    t : float
        Seconds.
    east, north : float
        Metres.
    up : float, optional
        Metres; left out where only the horizontal position is known.
    sigma : float
        Standard deviation of each component, m.
    heading : float, optional
        Radians, clockwise from true north; for vehicles whose nodes are poses.
    heading_sigma : float
        Standard deviation of the heading, rad.

    Raises
    ------
    ConfigurationError
        Where a number is not finite, a sigma is not positive, or the heading is outside two turns
        either way.
    """

    t: float
    east: float
    north: float
    up: float | None = None
    sigma: float = 10.0
    heading: float | None = None
    heading_sigma: float = 0.1

    def __post_init__(self) -> None:
        for name in ("t", "east", "north", "up", "sigma", "heading", "heading_sigma"):
            value = getattr(self, name)
            if value is not None and not np.isfinite(value):
                raise ConfigurationError(f"{value} is not finite", field=f"start.{name}")
        if self.sigma <= 0.0:
            raise ConfigurationError(
                f"a sigma of {self.sigma} m", "give metres, more than zero", field="start.sigma"
            )
        if not 0.0 < self.heading_sigma <= np.pi:
            raise ConfigurationError(
                f"a sigma of {self.heading_sigma} rad",
                "give more than zero and at most half a turn; without any notion of the heading "
                "leave it out",
                field="start.heading_sigma",
            )
        if self.heading is not None and abs(self.heading) > 4.0 * np.pi:
            raise ConfigurationError(
                f"{self.heading} rad is no heading",
                "give radians, clockwise from north",
                field="start.heading",
            )


@dataclass(frozen=True, eq=False)
class Reference:
    """An independent track to compare with; no estimator ever sees it.

    Attributes
    ----------
    t : array, shape (M,)
        Seconds, not decreasing.
    position : array, shape (M, 3)
        East, north, up, m.
    """

    t: FloatArray
    position: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "t", frozen(self.t))
        object.__setattr__(self, "position", frozen(self.position))


@dataclass(frozen=True, eq=False)
class Segment:
    """A stretch of a mission with a trajectory of its own: one line, one dive.

    Attributes
    ----------
    name : str
        Label of the segment in outputs; empty where a mission has only one.
    two_way_range, one_way_range, slant_range : records, optional
        Ranges to beacons.
    velocity, attitude, depth, position : records, optional
        What else was measured.
    heading, angular_rate, odometry : records, optional
        The same, for vehicles whose nodes are poses.
    start : Start, optional
        Prior on the position at one time.
    reference : Reference, optional
        Independent track at the pings' transmit times, for comparison alone.
    """

    name: str = ""
    two_way_range: TwoWayRange | None = None
    one_way_range: OneWayRange | None = None
    velocity: Velocity | None = None
    attitude: Attitude | None = None
    depth: Depth | None = None
    position: PositionFix | None = None
    start: Start | None = None
    reference: Reference | None = None
    slant_range: SlantRange | None = None
    heading: Heading | None = None
    angular_rate: AngularRate | None = None
    odometry: Odometry | None = None

    def records(self) -> dict[str, Records]:
        """Record sets that are present and not empty, by kind."""
        present = {kind: getattr(self, kind) for kind in RECORD_KINDS}
        return {kind: r for kind, r in present.items() if r is not None and len(r) > 0}
