"""What smoothing gives: trajectories with covariances, slow states, residuals, and a status."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ubl_graph.arrays import BoolArray, FloatArray
from ubl_graph.errors import ConfigurationError, TimeError
from ubl_graph.mission import Mission
from ubl_graph.nodes import NOMINAL_SPEED
from ubl_graph.pings import DownWeightedPing
from ubl_graph.trajectory import States, Trajectory
from ubl_graph.tuning import Tuning
from ubl_graph.verdict import Consistency

Status = Literal["converged", "not converged", "unobservable"]

#: Where a standard deviation is above this share of the prior's, the data told less than was known.
OBSERVED = float(np.sqrt(0.5))
#: A ping whose robust weight is below this counts as down-weighted.
DOWN_WEIGHTED = 0.5


@dataclass(frozen=True, eq=False)
class SlowState:
    """A slowly varying quantity along a segment.

    Attributes
    ----------
    t : array, shape (N,)
        Node times, s.
    value, sigma : array, shape (N, size)
        Estimate and standard deviation, SI. `sound_speed` is the logarithm of the factor on
        the travel times: the true speed is the given one times exp(-value).
    prior : array, shape (size,), optional
        Standard deviations at the first node before any measurement.
    scale : float
        By which `sigma` was multiplied when the covariances were calibrated; priors never are.
    """

    t: FloatArray
    value: FloatArray
    sigma: FloatArray
    prior: FloatArray | None = None
    scale: float = 1.0

    @property
    def observed(self) -> bool:
        """Whether the data tell at least as much of every component as was known before."""
        return self.prior is None or bool(
            (np.median(self.sigma, axis=0) <= self.scale * OBSERVED * self.prior).all()
        )


@dataclass(frozen=True, eq=False)
class Shared:
    """A constant quantity: a beacon's position, a DVL's scale.

    Attributes
    ----------
    value : array, shape (size,)
        Estimate, SI.
    covariance : array, shape (size, size)
        Its covariance; zero where it was not estimated.
    prior : array, shape (size,), optional
        Standard deviations before any measurement.
    expected : array, shape (size, size), optional
        The covariance that the geometry of the start promised, before anything was solved.
    scale : float
        By whose square `covariance` was multiplied when the covariances were calibrated; `prior`
        and `expected` never are.
    """

    value: FloatArray
    covariance: FloatArray
    prior: FloatArray | None = None
    expected: FloatArray | None = None
    scale: float = 1.0

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations, shape (size,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def observed(self) -> bool:
        """Whether the data tell at least as much in every direction as was known before."""
        return self._is_observed(self.covariance / self.scale**2)

    @property
    def observable(self) -> bool:
        """The same of what the geometry of the start promised."""
        return self.expected is None or self._is_observed(self.expected)

    def _is_observed(self, covariance: FloatArray) -> bool:
        if self.prior is None:
            return True
        of_prior = covariance / (self.prior[:, None] * self.prior)
        return bool(np.linalg.eigvalsh(of_prior)[-1] <= OBSERVED**2)


@dataclass(frozen=True, eq=False)
class RangeResiduals:
    """Residuals of a segment's ranges, one row a ping in the order of the records.

    Attributes
    ----------
    kind : array of str, shape (M,)
        "two_way", "one_way" or "slant" (a distance, given as the time at 1500 m/s).
    beacon : array of str, shape (M,)
        Name of the beacon.
    t_transmit, t_receive : array, shape (M,)
        s, as given.
    travel_time, sigma, residual : array, shape (M,)
        Measured travel time, standard deviation of the residual (measurement and interpolation),
        and model minus measurement; s.
    weight : array, shape (M,)
        Robust weight, 1 for a ping that counts in full.
    found : array of bool, shape (M,)
        Whether a direct ray exists at the estimate.
    """

    kind: FloatArray
    beacon: FloatArray
    t_transmit: FloatArray
    t_receive: FloatArray
    travel_time: FloatArray
    sigma: FloatArray
    residual: FloatArray
    weight: FloatArray
    found: BoolArray

    def __len__(self) -> int:
        return len(self.residual)

    @property
    def down_weighted(self) -> BoolArray:
        """Which pings count for less than half."""
        return self.weight < DOWN_WEIGHTED

    @staticmethod
    def joined(parts: Sequence[RangeResiduals]) -> RangeResiduals:
        """All rows of several tables, in order."""
        names = RangeResiduals.__dataclass_fields__
        return RangeResiduals(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A track that the data allow.

    Attributes
    ----------
    trajectory : Trajectory
        Nodes with covariances, which hold if this is the true one.
    weight : float
        Posterior probability among the tracks that were found.
    cost : float
        Of its problem.
    status : str
        "converged" or "not converged": whether its own solve came to rest.
    """

    trajectory: Trajectory
    weight: float
    cost: float
    status: Status


@dataclass(frozen=True, eq=False)
class SegmentResult:
    """What smoothing gives for one segment.

    Attributes
    ----------
    name : str
        The segment's label.
    trajectory : Trajectory
        Nodes with covariances.
    slow : dict of str to SlowState
        `sound_speed`, `clock_offset` (s), `clock_drift`, `current` (m/s east, north),
        `heading_bias` (rad) where it walks.
    residuals : RangeResiduals or None
        None where the segment has no ranges.
    status, reason : str
        What came of it, and why it is not "converged".
    problem : int
        Number of the problem it was solved in: segments that share unknowns are solved together.
    solver : str
        What solved that problem: "gtsam", "banded" or "banded, confirmed by gtsam".
    cost : float
        Of that problem.
    iterations : int
        Of that problem.
    chi_square, degrees_of_freedom : float, int
        Weighted sum of squared whitened residuals of that problem; rows minus unknowns.
    rival : array, shape (N, 3), or None
        Positions at the nodes of another track that fits as well, where one was found.
    runner_up : float or None
        How much higher the cost of the next best track is that lies elsewhere: of those that were
        solved, else of those that the search for a start compared. None where there was no other.
    hypotheses : tuple of Hypothesis
        Tracks that the data allow: this one, then the others, heaviest first. Of a fleet's vehicle
        there are none: rivals are compared by their cost alone there.
    pruned : float
        Weight of the tracks that were found and are too unlikely to be kept.
    """

    name: str
    trajectory: Trajectory
    slow: dict[str, SlowState]
    residuals: RangeResiduals | None
    status: Status
    reason: str
    problem: int
    solver: str
    cost: float
    iterations: int
    chi_square: float
    degrees_of_freedom: int
    rival: FloatArray | None = None
    runner_up: float | None = None
    hypotheses: tuple[Hypothesis, ...] = ()
    pruned: float = 0.0


@dataclass(frozen=True, eq=False)
class Result:
    """What `smooth` gives.

    Attributes
    ----------
    mission : Mission
        What was smoothed.
    segments : tuple of SegmentResult
        In the mission's order.
    beacons : dict of str to Shared
        Every beacon; covariance zero where beacons are constants.
    shared : dict of str to Shared
        `dvl_scale`, `dvl_misalignment` (rad), `dvl_bias` (m/s), `heading_bias` (rad, what the
        heading reference reads too far clockwise; of the nodes where it walks), `gyro_bias` (rad/s
        read too much about forward, left, up; about up alone in the plane), `odometry_scale`,
        `odometry_turn_bias` (rad/s turned too far clockwise).
    warnings : tuple of str
        What a user should know before trusting it.
    wall_times : dict of str to float
        Seconds by stage.
    tuning : Tuning or None
        What the data chose where options were "auto"; `mission` holds the numbers.
    consistency : Consistency or None
        Whether the sigmas are true, by held-out pings; None where nobody asked.
    inflation : Consistency or None
        What held-out pings said before the noise was inflated, where that was asked; `mission`
        holds the inflated noise.
    """

    mission: Mission
    segments: tuple[SegmentResult, ...]
    beacons: dict[str, Shared]
    shared: dict[str, Shared]
    warnings: tuple[str, ...] = ()
    wall_times: dict[str, float] = field(default_factory=dict[str, float])
    tuning: Tuning | None = None
    consistency: Consistency | None = None
    inflation: Consistency | None = None

    @property
    def status(self) -> Status:
        """The worst of the segments' statuses."""
        order: list[Status] = ["converged", "not converged", "unobservable"]
        return max((s.status for s in self.segments), key=order.index)

    @property
    def reason(self) -> str:
        """Why the status is not "converged"; empty where it is."""
        parts = [(f"{s.name}: " if s.name else "") + s.reason for s in self.segments if s.reason]
        return "; ".join(parts)

    @property
    def hypotheses(self) -> dict[str, tuple[Hypothesis, ...]]:
        """Tracks that the data allow, by segment: the answer first, then the heaviest."""
        return {s.name: s.hypotheses for s in self.segments}

    @property
    def trajectory(self) -> MissionTrajectory:
        """All segments' trajectories as one thing to ask."""
        return MissionTrajectory(self.segments)

    @property
    def residuals(self) -> RangeResiduals | None:
        """Range residuals of all segments, or None where there are no ranges."""
        parts = [s.residuals for s in self.segments if s.residuals is not None]
        return RangeResiduals.joined(parts) if parts else None

    @property
    def down_weighted(self) -> tuple[DownWeightedPing, ...]:
        """Pings that count for less than half, the one most sigmas off first."""
        pings = [
            ping
            for segment in self.segments
            if segment.residuals is not None
            for ping in _down_weighted(segment.name, segment.residuals)
        ]
        return tuple(sorted(pings, key=lambda p: -abs(p.residual) / p.sigma))


def _down_weighted(segment: str, table: RangeResiduals) -> Iterator[DownWeightedPing]:
    """A segment's down-weighted pings, in the order of the records."""
    for i in np.flatnonzero(table.down_weighted):
        legs = 2.0 if table.kind[i] == "two_way" else 1.0
        yield DownWeightedPing(
            segment,
            str(table.kind[i]),
            str(table.beacon[i]),
            float(table.t_transmit[i]),
            float(table.t_receive[i]),
            float(table.residual[i]),
            float(table.residual[i]) * NOMINAL_SPEED / legs,
            float(table.sigma[i]),
            float(table.weight[i]),
        )


class MissionTrajectory:
    """Trajectories of all segments, asked by time.

    Parameters
    ----------
    segments : sequence of SegmentResult
        Whose trajectories.
    """

    def __init__(self, segments: Sequence[SegmentResult]) -> None:
        self._segments = tuple(segments)

    def __getitem__(self, name: str) -> Trajectory:
        """Trajectory of the segment of this name."""
        for segment in self._segments:
            if segment.name == name:
                return segment.trajectory
        known = ", ".join(f"'{s.name}'" for s in self._segments)
        raise ConfigurationError(f"there is no segment '{name}'", f"known: {known}")

    @property
    def t(self) -> FloatArray:
        """Node times of all segments, s, segment after segment."""
        return np.concatenate([s.trajectory.t for s in self._segments])

    @property
    def position(self) -> FloatArray:
        """Node positions of all segments, (N, 3), m."""
        return np.concatenate([s.trajectory.position for s in self._segments])

    @property
    def velocity(self) -> FloatArray:
        """Node velocities of all segments, (N, 3), m/s."""
        return np.concatenate([s.trajectory.velocity for s in self._segments])

    @property
    def covariance(self) -> FloatArray:
        """Position covariances of all nodes, (N, 3, 3), m^2."""
        return np.concatenate([s.trajectory.covariance for s in self._segments])

    def at(self, times: FloatArray | Sequence[float] | float) -> States:
        """Position and velocity with their covariances at `times` (M,), s.

        Raises
        ------
        TimeError
            Where a time lies in no segment, or in several (ask one of them by name instead).
        """
        times = np.atleast_1d(np.asarray(times, dtype=np.float64))
        if times.ndim != 1:
            raise TimeError(f"times have {times.ndim} dimensions; give one time or a list of them")
        tracks = [s.trajectory for s in self._segments]
        holds = np.stack([(times >= track.t[0]) & (times <= track.t[-1]) for track in tracks])
        count = holds.sum(axis=0)
        if (count != 1).any():
            i = int(np.argmax(count != 1))
            where = "no segment" if count[i] == 0 else "several segments; ask one by its name"
            spans = ", ".join(f"{track.t[0]} to {track.t[-1]} s" for track in tracks[:8])
            raise TimeError(f"t = {times[i]} s lies in {where} (spans: {spans})")
        out = States(
            times,
            np.empty((len(times), 3)),
            np.empty((len(times), 3)),
            np.empty((len(times), 3, 3)),
            np.empty((len(times), 3, 3)),
        )
        for track, rows in zip(tracks, holds, strict=True):
            if rows.any():
                states = track.at(times[rows])
                out.position[rows] = states.position
                out.velocity[rows] = states.velocity
                out.covariance[rows] = states.covariance
                out.velocity_covariance[rows] = states.velocity_covariance
        return out
