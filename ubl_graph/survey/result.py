"""What a survey gives: beacons with their joint covariance, the water, residuals, and a verdict."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.beacon import Beacon
from ubl_graph.mission import Mission
from ubl_graph.result import RangeResiduals, SlowState, Status
from ubl_graph.survey.model import Noise, SurveyOptions

#: Whether the track was known from fixes, or found together with the beacons.
Method = Literal["known track", "joint"]


@dataclass(frozen=True, eq=False)
class BeaconCheck:
    """A beacon's given position against what all else says of it: the beacon is left out.

    Attributes
    ----------
    name : str
        The beacon.
    offset : array, shape (3,)
        Where the data put it, minus where it was given, m; nan where nothing was given.
    covariance : array, shape (3, 3)
        Of the offset: of what the data say, and of what was given; m^2.
    statistic : float
        Squared normalised distance, or twice the fall of the cost when the beacon is set free:
        chi-square with `degrees_of_freedom` where nothing is wrong.
    degrees_of_freedom : int
        Components that were given.
    """

    name: str
    offset: FloatArray
    covariance: FloatArray
    statistic: float
    degrees_of_freedom: int

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of the offset, m, shape (3,)."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True, eq=False)
class LeaveOneOut:
    """The leave-one-out check of all beacons.

    Attributes
    ----------
    checks : tuple of BeaconCheck
        Of the beacons whose position was given with a standard deviation, or held.
    thresholds : dict of str to float
        What each beacon's statistic may reach: one false alarm in a hundred surveys, however many
        beacons.
    named : tuple of str
        Beacons that disagree, the worst first.
    undecided : tuple of str
        Beacons of which one disagrees, and the data do not tell which.
    reason : str
        Why nothing could be checked; empty where something was.
    """

    checks: tuple[BeaconCheck, ...] = ()
    thresholds: dict[str, float] = field(default_factory=dict[str, float])
    named: tuple[str, ...] = ()
    undecided: tuple[str, ...] = ()
    reason: str = ""


@dataclass(frozen=True, eq=False)
class SurveyResult:
    """What `calibrate` gives.

    Attributes
    ----------
    mission : Mission
        What was surveyed.
    options : SurveyOptions
        How.
    method : str
        "known track", or "joint": the track was found together with the beacons.
    names : tuple of str
        Beacons that were estimated, in order; all others stand as given.
    position : array, shape (B, 3)
        East, north, up, m.
    covariance : array, shape (3 B, 3 B)
        Of all positions together, beacon after beacon, m^2.
    slow : dict of str to SlowState
        At the knots: `sound_speed` (log factor on the travel times), `vehicle_gradient` and
        `beacon_gradient` (of it, east and north, 1/m), `track_error` (m), clock states. Empty where
        the method is "joint".
    range_bias : dict of str to (float, float)
        Estimate and standard deviation by beacon, m, where it was estimated.
    residuals : RangeResiduals
        One row a range.
    segments : array of str, shape (M,)
        The segment of each row.
    track : array, shape (N, 3)
        Places of the vehicle, m.
    noise : Noise
        The ranges' and the sound speed's, in force.
    check : LeaveOneOut
        Which given positions disagree.
    status, reason : str
        As in `ubl_graph.result.Result`.
    warnings : tuple of str
        What a user should know before trusting it.
    wall_times : dict of str to float
        Seconds by stage.
    """

    mission: Mission
    options: SurveyOptions
    method: Method
    names: tuple[str, ...]
    position: FloatArray
    covariance: FloatArray
    slow: dict[str, SlowState]
    range_bias: dict[str, tuple[float, float]]
    residuals: RangeResiduals
    segments: FloatArray
    track: FloatArray
    noise: Noise
    check: LeaveOneOut
    status: Status
    reason: str
    warnings: tuple[str, ...] = ()
    wall_times: dict[str, float] = field(default_factory=dict[str, float])

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of the positions, m, shape (B, 3)."""
        return np.sqrt(np.diag(self.covariance)).reshape(-1, 3)

    @property
    def beacons(self) -> tuple[Beacon, ...]:
        """The mission's beacons: those that were estimated with what was found, others as given."""
        found = dict(zip(self.names, zip(self.position, self.sigma, strict=True), strict=True))
        return tuple(
            Beacon(b.name, *found.get(b.name, (b.position, b.sigma)), turnaround=b.turnaround)
            for b in self.mission.beacons
        )

    @property
    def verdict(self) -> str:
        """What came of it, in words."""
        parts: list[str] = []
        if self.status != "converged":
            parts.append(f"{self.status}: {self.reason}")
        elif self.names:
            worst = 100.0 * self.sigma.max(axis=0)
            many = "beacon" if len(self.names) == 1 else "beacons"
            parts.append(
                f"{len(self.names)} {many} surveyed, standard deviations up to "
                f"{worst[0]:.1f}, {worst[1]:.1f}, {worst[2]:.1f} cm (east, north, up)"
            )
        parts.append(self._checked())
        return "; ".join(parts)

    def _checked(self) -> str:
        check = self.check
        if check.reason:
            return check.reason
        if check.undecided:
            return (
                f"the given positions disagree with the data, but whether it is "
                f"{' or '.join(check.undecided)} cannot be told"
            )
        if not check.named:
            return "no given position disagrees with the data"
        by_name = {c.name: c for c in check.checks}
        each = [_off(by_name[name]) for name in check.named]
        return "given positions that disagree with the data: " + ", ".join(each)


def _off(check: BeaconCheck) -> str:
    terms = [
        f"{value:+.3g} +- {sigma:.2g} m {axis}"
        for value, sigma, axis in zip(
            check.offset, check.sigma, ("east", "north", "up"), strict=True
        )
        if sigma > 0.0
    ]
    return f"{check.name} seems off by {', '.join(terms)}"
