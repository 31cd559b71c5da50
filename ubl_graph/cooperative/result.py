"""What smoothing a fleet gives: a result a vehicle, targets, and the ranges between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np

from ubl_graph.arrays import BoolArray, FloatArray
from ubl_graph.cooperative.fleet import Fleet
from ubl_graph.result import DOWN_WEIGHTED, Result, Shared, Status

#: From the best to the worst.
STATUSES: tuple[Status, ...] = ("converged", "not converged", "unobservable")


@dataclass(frozen=True, eq=False)
class TargetEstimate:
    """Where a target is.

    Attributes
    ----------
    name : str
        The target's.
    t : float
        Time of `position` where it moves, s; NaN for one at rest.
    position : array, shape (3,)
        East, north, up, m.
    covariance : array, shape (3, 3)
        m^2.
    velocity : array, shape (3,)
        m/s; zero for one at rest.
    motion_covariance : array, shape (6, 6)
        Of position and velocity together; zero where it is at rest.
    status, reason : str
        What came of it, and why it is not "converged".
    rival : array, shape (3,), or None
        Another position that fits as well, where one was found.
    """

    name: str
    t: float
    position: FloatArray
    covariance: FloatArray
    velocity: FloatArray
    motion_covariance: FloatArray
    status: Status = "converged"
    reason: str = ""
    rival: FloatArray | None = None

    @property
    def velocity_covariance(self) -> FloatArray:
        """Covariance of the velocity, (3, 3), m^2/s^2."""
        return self.motion_covariance[3:, 3:]

    def at(self, times: FloatArray | Sequence[float] | float) -> tuple[FloatArray, FloatArray]:
        """Positions (M, 3), m, and their covariances (M, 3, 3), m^2, at `times` (M,), s."""
        times = np.atleast_1d(np.asarray(times, dtype=np.float64))
        later = np.zeros(len(times)) if np.isnan(self.t) else times - self.t
        position = self.position + later[:, None] * self.velocity
        whole = self.motion_covariance
        cross = later[:, None, None] * (whole[:3, 3:] + whole[3:, :3])
        return position, self.covariance + cross + later[:, None, None] ** 2 * whole[3:, 3:]


@dataclass(frozen=True, eq=False)
class FleetResiduals:
    """Residuals of the ranges between vehicles and to targets, one row a range.

    Attributes
    ----------
    kind : array of str, shape (M,)
        "two_way", "one_way" or "slant" (a distance, given as the time at 1500 m/s).
    vehicle, peer : array of str, shape (M,)
        Who measured, and who or what was at the other end.
    t_transmit, t_receive : array, shape (M,)
        s, as given.
    travel_time, sigma, residual : array, shape (M,)
        Measured travel time, standard deviation of the residual (measurement and interpolation),
        and model minus measurement; s.
    weight : array, shape (M,)
        Robust weight, 1 for a range that counts in full.
    found : array of bool, shape (M,)
        Whether a direct ray exists at the estimate.
    """

    kind: FloatArray
    vehicle: FloatArray
    peer: FloatArray
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
        """Which ranges count for less than half."""
        return self.weight < DOWN_WEIGHTED

    @staticmethod
    def joined(parts: Sequence[FleetResiduals]) -> FleetResiduals:
        """All rows of several tables, in order."""
        names = [f.name for f in fields(FleetResiduals)]
        return FleetResiduals(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))


@dataclass(frozen=True, eq=False)
class FleetResult:
    """What `smooth_fleet` gives.

    Attributes
    ----------
    fleet : Fleet
        What was smoothed.
    vehicles : dict of str to Result
        Each vehicle's, as `smooth` gives it; its residuals are those of its ranges to beacons.
    targets : dict of str to TargetEstimate
        Each target's.
    residuals : FleetResiduals or None
        Of the ranges between vehicles and to targets; None where there are none.
    shared : dict of str to Shared
        `sound_speed`: logarithm of the factor on the travel times between vehicles, where it was
        estimated.
    beacons : dict of str to Shared
        Every beacon; covariance zero where beacons are constants.
    warnings : tuple of str
        What a user should know before trusting it.
    wall_times : dict of str to float
        Seconds by stage.
    """

    fleet: Fleet
    vehicles: dict[str, Result]
    targets: dict[str, TargetEstimate]
    residuals: FleetResiduals | None
    shared: dict[str, Shared]
    beacons: dict[str, Shared]
    warnings: tuple[str, ...] = ()
    wall_times: dict[str, float] = field(default_factory=dict[str, float])

    @property
    def status(self) -> Status:
        """The worst of the vehicles' and targets' statuses."""
        found: set[Status] = {r.status for r in self.vehicles.values()}
        found |= {t.status for t in self.targets.values()}
        return max(found, key=STATUSES.index)

    @property
    def reason(self) -> str:
        """Why the status is not "converged", by vehicle and target; empty where it is."""
        parts = [r.reason for r in self.vehicles.values() if r.reason]
        parts += [f"target {t.name}: {t.reason}" for t in self.targets.values() if t.reason]
        return "; ".join(parts)

    @property
    def problems(self) -> list[Result]:
        """One vehicle's result of each problem: vehicles joined by ranges are solved together."""
        by_number = {r.segments[0].problem: r for r in self.vehicles.values()}
        return [by_number[number] for number in sorted(by_number)]

    @property
    def cost(self) -> float:
        """Sum over the problems that were solved."""
        return sum(r.segments[0].cost for r in self.problems)

    @property
    def iterations(self) -> int:
        """Sum over the problems that were solved."""
        return sum(r.segments[0].iterations for r in self.problems)

    @property
    def solver(self) -> str:
        """What solved the problems."""
        return ", ".join(dict.fromkeys(r.segments[0].solver for r in self.problems))
