"""What a case of the Zhao study asks of the graph, and errors of what comes back."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Literal

import numpy as np

from ubl_graph.arrays import ArrayLike, FloatArray
from ubl_graph.baselines import FormationEstimate, own_rmse
from ubl_graph.cooperative import Fleet, FleetResult, Member, smooth_fleet
from ubl_graph.errors import SolverError
from ubl_graph.odometry_chain import compounded
from ubl_graph.online.fleet_estimator import FleetEstimator
from ubl_graph.online.fleet_replay import bare
from ubl_graph.records import Records
from ubl_graph.sim import ZHAO_OPTIONS, ZhaoRuns, ZhaoSettings, zhao_fleet
from ubl_graph.sim.zhao import TARGET_TIME
from ubl_graph.sim.zhao_fleet import NAMES, TARGET

#: One engine is enough: the other confirms the same answer.
OPTIONS = replace(ZHAO_OPTIONS, solver="banded")


def smoothed(
    runs: ZhaoRuns,
    run: int,
    *,
    pairs: ArrayLike | Literal["all"],
    target: ArrayLike | None = None,
    times: ArrayLike = TARGET_TIME,
    coarse: bool = False,
) -> FleetResult:
    """The graph's answer to one run; coarse, tracks have nodes at ranging times alone.

    The graph has no others anyway: they are the same, but the way between is not filled in.

    Raises
    ------
    SolverError
        Where it is not sure of it: no row may rest on less.
    """
    fleet = zhao_fleet(runs, run, pairs=pairs, target=target, times=times, options=OPTIONS)
    if coarse:
        fleet = compounded_fleet(fleet, runs.data.t[runs.data.ranging_steps])
    result = smooth_fleet(fleet)
    if result.status != "converged":
        raise SolverError(f"run {run} is {result.status}: {result.reason}")
    return result


def compounded_fleet(fleet: Fleet, times: FloatArray) -> Fleet:
    """The fleet with its odometry given from one of these times to the next."""
    members: list[Member] = []
    for member in fleet.vehicles:
        odometry = member.segment.odometry
        assert odometry is not None
        joined = compounded(odometry, times, member.options)
        members.append(replace(member, segment=replace(member.segment, odometry=joined)))
    return replace(fleet, vehicles=tuple(members))


def target_times(settings: ZhaoSettings) -> FloatArray:
    """All ranging times to `TARGET_TIME`, or to the end where that is sooner, s."""
    last = min(TARGET_TIME, settings.duration)
    return np.arange(settings.period, last + 0.5 * settings.period, settings.period)


def found_at(result: FleetResult) -> FloatArray:
    """Where the target is thought to be: east, north, m."""
    return result.targets[TARGET].position[:2]


def own_squares(result: FleetResult, runs: ZhaoRuns) -> FloatArray:
    """Squared horizontal errors of all vehicles after each step, (K + 1, A), m^2."""
    out = np.empty(runs.truth.shape[:2])
    for a, name in enumerate(NAMES):
        states = result.vehicles[name].trajectory.at(runs.data.t)
        out[:, a] = np.square(states.position[:, :2] - runs.truth[:, a, :2]).sum(axis=1)
    return out


def missed(estimate: FormationEstimate, runs: ZhaoRuns) -> FloatArray:
    """Horizontal errors of all runs, (R, K + 1, A), m."""
    off = estimate.state[..., :2] - runs.truth[..., :2]
    return np.hypot(off[..., 0], off[..., 1])


def summed(estimate: FormationEstimate, runs: ZhaoRuns) -> FloatArray:
    """Squared horizontal errors summed over runs, (K + 1, A), m^2."""
    return len(runs) * own_rmse(estimate, runs.truth) ** 2


def nees(off: FloatArray, covariance: FloatArray) -> FloatArray:
    """Squared Mahalanobis lengths (...,) of errors (..., 2)."""
    return np.einsum("...i,...i->...", off, np.linalg.solve(covariance, off[..., None])[..., 0])


def under_way(fleet: Fleet, times: FloatArray, lag: float) -> tuple[FloatArray, FloatArray]:
    """What the online estimator says of a fleet's vehicles, records coming as they are made.

    Parameters
    ----------
    fleet : Fleet
        With all its records.
    times : array, shape (E + 1,)
        The beginning, and the ranging times, s; each period's records come together.
    lag : float
        s.

    Returns
    -------
    array, shape (E, A, 2)
        East, north at the ranging times, m.
    array, shape (D, A, 2)
        The same a lag before those that are at least a lag from the beginning.

    Raises
    ------
    SolverError
        Where a record is refused: the filter has them all.
    """
    estimator = FleetEstimator(bare(fleet), lag)
    current: list[FloatArray] = []
    delayed: list[FloatArray] = []
    for before, now in pairwise(times.tolist()):
        for name, records in period_of(fleet, before, now):
            outcome = estimator.add(name, records)
            if not outcome.accepted:
                raise SolverError(f"at {now} s '{name}' is refused a record: {outcome.reason}")
        refused = estimator.update()
        if refused:
            raise SolverError(f"at {now} s: {refused[0]}")
        asked = [(current, now)]
        if now - lag >= times[0]:
            asked.append((delayed, now - lag))
        for out, t in asked:
            names = fleet.vehicle_names
            out.append(np.stack([estimator.smoothed(n, t).position[:2] for n in names]))
    return np.array(current), np.array(delayed)


def period_of(fleet: Fleet, before: float, now: float) -> Iterator[tuple[str, Records]]:
    """Each vehicle's records that are made after one time and up to another; odometry first."""
    rest: list[tuple[str, Records]] = []
    for member in fleet.vehicles:
        segment = member.segment
        odometry, fixes, ranges = segment.odometry, segment.position, segment.slant_range
        assert odometry is not None
        yield member.name, odometry[(odometry.t_to > before) & (odometry.t_to <= now)]
        for records in (fixes, ranges):
            if records is not None:
                chosen = records[(records.t > before) & (records.t <= now)]
                if len(chosen):
                    rest.append((member.name, chosen))
    yield from rest
