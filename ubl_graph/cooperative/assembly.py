"""From a fleet's flat vector to results: each vehicle's, targets, residuals between vehicles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.assembly import (
    UNOBSERVED_SHARE,
    UNOBSERVED_SIGMA,
    assemble_segment,
    beacons_of,
    chi_square_of,
    direction,
    shared_of,
)
from ubl_graph.cooperative.fleet import Fleet, Target
from ubl_graph.cooperative.marginals import FleetMarginals
from ubl_graph.cooperative.model import FleetProblem, MemberModel
from ubl_graph.cooperative.result import FleetResiduals, TargetEstimate
from ubl_graph.factors.ranges import RangeBlock
from ubl_graph.nodes import NOMINAL_SPEED
from ubl_graph.odometry_fill import filled_in
from ubl_graph.pose_trajectory import PoseTrajectory
from ubl_graph.result import Result, SegmentResult, Shared, Status
from ubl_graph.solve.rounds import Solution
from ubl_graph.work import AMBIGUOUS_COST, COVERED_SIGMAS, rival_of

#: What to say where nothing at all says where vehicles are.
ADRIFT = (
    "nothing ties it to the map: neither it nor any vehicle that ranges join it to has a start, a "
    "fix or a beacon"
)


def assemble_member(
    fleet: Fleet,
    problem: FleetProblem,
    solution: Solution,
    marginals: FleetMarginals,
    rivals: Sequence[Solution],
    number: int,
    group: int,
    solver: str,
    *,
    anchored: bool,
) -> Result:
    """What smoothing gives for one vehicle.

    Parameters
    ----------
    fleet : Fleet
        Of which the vehicle is one.
    problem, solution, marginals
        Solved, with covariances.
    rivals : sequence of Solution
        What else was found.
    number : int
        The vehicle's.
    group : int
        Number of the problem among those of the fleet.
    solver : str
        What solved it.
    anchored : bool
        Whether anything ties the vehicles of the problem to the map.
    """
    member, own = problem.members[number], problem.own[number]
    place, blocks = problem.layout.place[number], problem.own_blocks(number)

    def local(of: Solution) -> Solution:
        return replace(of, x=of.x[place], frozen=of.frozen[blocks])

    mine, covariances = local(solution), marginals.vehicle(number)
    if mine.trouble and marginals.settled(number):
        # Somebody else is not where they will stay.
        mine = replace(mine, trouble="")
    chain = member.layout.chains[0]
    rival, track, runner_up = rival_of(own, mine, covariances, [local(r) for r in rivals], chain)
    segment = assemble_segment(
        own,
        mine,
        covariances,
        chain,
        member.model,
        rival,
        track,
        group,
        solver,
        runner_up,
        member.mission.options,
        _limit(problem, member.name),
    )
    if not anchored:
        segment = replace(segment, status="unobservable", reason=ADRIFT)
    chi_square, dof = chi_square_of(problem, solution)
    segment = replace(segment, chi_square=chi_square, degrees_of_freedom=dof)
    shared = shared_of(own, mine, covariances)
    states = {name: s for name, s in shared.items() if not name.startswith("beacon ")}
    segment = _filled_in(member, segment, states)
    mission = fleet.mission_of(member.name)
    return Result(mission, (segment,), beacons_of(mission, shared), states)


def _filled_in(
    member: MemberModel, segment: SegmentResult, states: dict[str, Shared]
) -> SegmentResult:
    """A vehicle's result with a node at each record of odometry that was compounded."""
    records, track = member.member.segment.odometry, segment.trajectory
    if not isinstance(track, PoseTrajectory) or not track.still or records is None:
        return segment
    errors = {name: float(s.value[0]) for name, s in states.items()}
    options = member.member.options
    whole = filled_in(track, records, options, errors)
    rival = segment.rival
    if rival is not None:
        rival = _resampled(whole.t, track.t, rival)
    # Between nodes slow states are linear; so is the most that their sigmas can be.
    slow = {
        name: replace(
            s,
            t=whole.t,
            value=_resampled(whole.t, track.t, s.value),
            sigma=_resampled(whole.t, track.t, s.sigma),
        )
        for name, s in segment.slow.items()
    }
    return replace(segment, trajectory=whole, rival=rival, slow=slow)


def _resampled(t: FloatArray, nodes: FloatArray, values: FloatArray) -> FloatArray:
    """Values at nodes (N, size) at other times (M,), (M, size), linearly."""
    return np.stack([np.interp(t, nodes, column) for column in values.T], axis=1)


def _limit(problem: FleetProblem, name: str) -> float | None:
    """Standard deviation (m) beyond which a vehicle or target that is ranged is not observed.

    None where no vehicle ranged it: then its ranges to beacons say it.
    """
    distances = [
        p.measured[(p.vehicle == name) | (p.peer == name)] * NOMINAL_SPEED / p.here.shape[1]
        for p in problem.pings
        if p.kind != "one_way_range"
    ]
    found = np.concatenate([np.empty(0), *distances])
    return UNOBSERVED_SHARE * float(np.median(found)) if len(found) else None


def assemble_target(
    problem: FleetProblem,
    target: Target,
    solution: Solution,
    marginals: FleetMarginals,
    rivals: Sequence[Solution],
    *,
    anchored: bool,
) -> TargetEstimate:
    """Where a target is, and how sure that is."""
    layout = problem.layout
    names = [f"target {target.name}"]
    place = layout.common_columns(names[0])
    velocity = np.zeros(3)
    if target.moves:
        names.append(f"velocity {target.name}")
        velocity = solution.x[layout.common_columns(names[1])]
    covariance = np.zeros((6, 6))
    known = 3 * len(names)
    covariance[:known, :known] = marginals.common(names)
    position = solution.x[place]
    if solution.trouble and marginals.common_settled(names[0]):
        solution = replace(solution, trouble="")
    status, reason = _target_status(
        covariance[:3, :3],
        _limit(problem, target.name) or UNOBSERVED_SIGMA,
        solution,
        anchored=anchored,
    )
    other: FloatArray | None = None
    if status == "converged":
        other, rival_reason = _target_rival(position, covariance[:3, :3], solution, rivals, place)
        if other is not None:
            status, reason = "unobservable", rival_reason
    return TargetEstimate(
        target.name,
        problem.epochs.get(target.name, np.nan),
        position,
        covariance[:3, :3],
        velocity,
        covariance,
        status,
        reason,
        other,
    )


def _target_status(
    covariance: FloatArray,
    limit: float,
    solution: Solution,
    *,
    anchored: bool,
) -> tuple[Status, str]:
    if not anchored:
        return "unobservable", ADRIFT
    values, vectors = np.linalg.eigh(covariance)
    sigma = float(np.sqrt(max(values[-1], 0.0)))
    if sigma > limit:
        along = direction(vectors[:, -1])
        return "unobservable", (
            f"the ranges do not determine it {along} (standard deviation {sigma:.0f} m)"
        )
    if not solution.converged:
        return "not converged", solution.trouble
    return "converged", ""


def _target_rival(
    position: FloatArray,
    covariance: FloatArray,
    best: Solution,
    others: Sequence[Solution],
    place: IntArray,
) -> tuple[FloatArray | None, str]:
    """Another place that fits as well and that the covariance does not cover."""
    covered = max(1.0, COVERED_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(covariance)[-1])))
    for other in others:
        gap = other.x[place] - position
        apart, extra = float(np.linalg.norm(gap)), max(other.cost - best.cost, 0.0)
        if apart > covered and extra < AMBIGUOUS_COST:
            return other.x[place], (
                f"ambiguous: another place, {apart:.0f} m away ({direction(gap / apart)}), fits as "
                f"well (its cost is {extra:.2g} higher); a range from elsewhere would tell"
            )
    return None, ""


def unseen_target(fleet: Fleet, name: str) -> TargetEstimate:
    """What is known of a target that no vehicle ranged: what was said of it."""
    target = next(t for t in fleet.targets if t.name == name)
    position = np.zeros(3) if target.position is None else np.asarray(target.position)
    motion = np.diag(np.concatenate([target.sigma, target.velocity_sigma]) ** 2)
    at = np.nan if not target.moves or target.t is None else target.t
    return TargetEstimate(
        name,
        at,
        position,
        motion[:3, :3],
        np.zeros(3),
        motion,
        "unobservable",
        "no vehicle ranged it",
    )


def assemble_residuals(problem: FleetProblem, solution: Solution) -> FleetResiduals | None:
    """Residuals of the ranges between vehicles and to targets."""
    parts: list[FleetResiduals] = []
    frozen = solution.frozen[problem.ranges]
    for pings, block, sigma in zip(
        problem.pings, problem.blocks[problem.ranges], frozen, strict=True
    ):
        assert isinstance(block, RangeBlock)
        assert sigma is not None
        whitened = block.evaluate(solution.x, sigma, jacobian=False)[0][:, 0]
        parts.append(
            FleetResiduals(
                np.full(len(pings), pings.kind.removesuffix("_range")),
                pings.vehicle,
                pings.peer,
                pings.t_transmit,
                pings.t_receive,
                pings.measured,
                sigma,
                whitened * sigma,
                problem.loss.weights(whitened),
                block.found(solution.x),
            )
        )
    return FleetResiduals.joined(parts) if parts else None
