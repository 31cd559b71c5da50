"""smooth_fleet(fleet) -> FleetResult: all vehicles and targets in one graph.

Vehicles that no range joins, directly or through others, are solved apart: those that the data
leave open do not harm the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from ubl_graph.arrays import FloatArray
from ubl_graph.cooperative.assembly import (
    assemble_member,
    assemble_residuals,
    assemble_target,
    unseen_target,
)
from ubl_graph.cooperative.fleet import UNKNOWN_PLACE, Fleet, ranges_of
from ubl_graph.cooperative.marginals import FleetMarginals
from ubl_graph.cooperative.model import FleetProblem, MemberModel, build_fleet, model_member
from ubl_graph.cooperative.peers import PeerPings, peer_pings
from ubl_graph.cooperative.result import FleetResiduals, FleetResult, TargetEstimate
from ubl_graph.cooperative.starts import find_fleet_starts, reckons, with_clocks
from ubl_graph.cooperative.targets import TargetStart, target_starts
from ubl_graph.initial import Starts
from ubl_graph.layout import Layout
from ubl_graph.pose_states import known_up
from ubl_graph.result import DOWN_WEIGHTED, Result, Shared
from ubl_graph.smoother import SAME_COST, SUSPICIOUS_CHI_SQUARE, SUSPICIOUS_SHARE
from ubl_graph.solve.choice import choose
from ubl_graph.solve.rounds import Solution
from ubl_graph.track import Track, start_vector
from ubl_graph.work import Progress, Work, confirmed

#: What lies within this of up 0 is in the plane of vehicles of which nothing else is said, m.
LEVEL = 1.0
#: So many further tracks of a vehicle, and places of a target, are solved in full.
MOST_RIVALS = 2
#: Unknowns that belong to no node which the banded solver takes for a fleet.
MOST_SHARED = 256


def smooth_fleet(fleet: Fleet, progress: Progress | None = None) -> FleetResult:
    """Smooth a fleet: the most probable tracks of all vehicles together, and where targets are.

    Parameters
    ----------
    fleet : Fleet
        From `load_fleet`, or made in Python.
    progress : callable, optional
        Called now and then with a text and the share done.

    Returns
    -------
    FleetResult
        With status "unobservable", and the reason by vehicle, where the data leave a track open;
        the others are as good as without it.

    Raises
    ------
    DataError
        Where the records do not make sense together.
    SolverError
        Where a solver fails on data that are sound.
    """
    work = Work(fleet.options.max_iterations, progress)
    groups, unseen = _groups(fleet, peer_pings(fleet))
    parts: list[_Part] = []
    for number, group in enumerate(groups):
        work.begin(number / len(groups), 1.0 / len(groups))
        parts.append(_smooth_group(work, group, number))
    results = {name: r for part in parts for name, r in part.vehicles.items()}
    found = {name: t for part in parts for name, t in part.targets.items()}
    found |= {name: unseen_target(fleet, name) for name in unseen}
    residuals = [p.residuals for p in parts if p.residuals is not None]
    shared: dict[str, Shared] = {}
    several = sum(bool(part.shared) for part in parts) > 1
    for part in parts:
        whose = f" of {', '.join(part.vehicles)}" if several else ""
        shared |= {name + whose: state for name, state in part.shared.items()}
    beacons = {
        name: min((r.beacons[name] for r in results.values()), key=_uncertainty)
        for name in fleet.beacon_names
    }
    return FleetResult(
        fleet,
        {v.name: results[v.name] for v in fleet.vehicles},
        {t.name: found[t.name] for t in fleet.targets},
        FleetResiduals.joined(residuals) if residuals else None,
        shared,
        beacons,
        tuple(work.warnings),
        work.wall_times,
    )


def _uncertainty(state: Shared) -> float:
    """Sum of the variances: vehicles that are solved apart each have an answer of their own."""
    return float(np.trace(state.covariance))


@dataclass(frozen=True, eq=False)
class _Part:
    """What came of vehicles that are joined by ranges."""

    vehicles: dict[str, Result]
    targets: dict[str, TargetEstimate]
    residuals: FleetResiduals | None
    shared: dict[str, Shared]


def _groups(fleet: Fleet, pings: Sequence[PeerPings]) -> tuple[list[Fleet], list[str]]:
    """Vehicles and targets that ranges join, each group a fleet; targets that nobody ranged."""
    names = fleet.names
    number = {name: i for i, name in enumerate(names)}
    pairs = [
        (number[str(a)], number[str(b)])
        for p in pings
        for a, b in zip(p.vehicle, p.peer, strict=True)
    ]
    if fleet.options.estimate_beacons:
        # Vehicles that range the same unknown beacon have it in common.
        pairs += [
            (number[member.name], number[str(name)])
            for member in fleet.vehicles
            for rows in ranges_of(member.segment).values()
            for name in np.unique(rows.beacon)
        ]
    ends = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    size = len(names)
    links = sparse.coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(size, size))
    _, label = csgraph.connected_components(links, directed=False)
    groups: list[Fleet] = []
    held: set[str] = set()
    for group in dict.fromkeys(label[number[v.name]] for v in fleet.vehicles):
        vehicles = tuple(v for v in fleet.vehicles if label[number[v.name]] == group)
        targets = tuple(t for t in fleet.targets if label[number[t.name]] == group)
        groups.append(replace(fleet, vehicles=vehicles, targets=targets))
        held |= {t.name for t in targets}
    return groups, [name for name in fleet.target_names if name not in held]


def _smooth_group(work: Work, fleet: Fleet, number: int) -> _Part:
    """Solve vehicles that are joined by ranges in one problem."""
    with work.stage("model"):
        pings = peer_pings(fleet)
        members = [model_member(fleet, member, pings) for member in fleet.vehicles]
    with work.stage("start"):
        starts = find_fleet_starts(fleet, members, pings)
        ways = {m.name: (m.model.t, starts[m.name].tracks[0].position) for m in members}
        places = {t.name: target_starts(fleet, t, pings, ways) for t in fleet.targets}
        starts = with_clocks(fleet, members, pings, starts, places)
    with work.stage("solve"):
        firsts = {name: found[0].position for name, found in places.items()}
        problem = build_fleet(fleet, members, pings, firsts)
        best, rivals, solver = _solved(work, fleet, problem, starts, places)
    with work.stage("covariance"):
        marginals = FleetMarginals(problem, best)
        anchored = _anchored(fleet)
        vehicles = {
            member.name: assemble_member(
                fleet, problem, best, marginals, rivals, i, number, solver, anchored=anchored
            )
            for i, member in enumerate(members)
        }
        targets = {
            t.name: assemble_target(problem, t, best, marginals, rivals, anchored=anchored)
            for t in fleet.targets
        }
        shared: dict[str, Shared] = {}
        if problem.layout.has("sound_speed"):
            value = best.x[problem.layout.common_columns("sound_speed")]
            covariance = marginals.common(["sound_speed"])
            shared["sound_speed"] = Shared(value * Layout.unit("sound_speed"), covariance)
        residuals = assemble_residuals(problem, best)
    for name, result in vehicles.items():
        _judge(work, name, result, residuals)
        _judge_depth(work, fleet, name)
    return _Part(vehicles, targets, residuals, shared)


def _solved(
    work: Work,
    fleet: Fleet,
    problem: FleetProblem,
    starts: Mapping[str, Starts],
    places: Mapping[str, Sequence[TargetStart]],
) -> tuple[Solution, list[Solution], str]:
    """The best solution, the others that were found, and who solved it."""
    choice = choose(problem, fleet.options.solver, MOST_SHARED)
    engine = choice.scout
    begin = problem.layout.joined(
        [_member_vector(m, starts[m.name].tracks[0]) for m in problem.members]
    )
    for name, found in places.items():
        _place_target(problem, name, found[0], begin)
    solutions = work.solve_robustly(engine, begin)
    others: list[FloatArray] = []
    for member, place in zip(problem.members, problem.layout.place, strict=True):
        if reckons(member):
            continue
        for track in starts[member.name].tracks[1 : 1 + MOST_RIVALS]:
            x = solutions[0].x.copy()
            x[place] = _member_vector(member, track)
            others.append(x)
    for name, found in places.items():
        for answer in found[1 : 1 + MOST_RIVALS]:
            x = solutions[0].x.copy()
            _place_target(problem, name, answer, x)
            others.append(x)
    solutions += [work.solve(engine, x) for x in others]
    least = min(s.cost for s in solutions)
    best = next(s for s in solutions if s.cost <= least + SAME_COST)
    rivals = sorted((s for s in solutions if s is not best), key=lambda s: s.cost)
    best, solver, note = confirmed(work, choice, best)
    for text in filter(None, (choice.note, note)):
        work.warn("", text)
    return best, rivals, solver


def _member_vector(member: MemberModel, track: Track) -> FloatArray:
    """A vehicle's own flat vector that a solver starts at."""
    return start_vector(member.mission, member.layout, [track])


def _place_target(problem: FleetProblem, name: str, start: TargetStart, x: FloatArray) -> None:
    """Write where a target may be into the fleet's flat vector, in place."""
    layout = problem.layout
    x[layout.common_columns(f"target {name}")] = start.position
    if layout.has(f"velocity {name}"):
        x[layout.common_columns(f"velocity {name}")] = start.velocity


def _anchored(fleet: Fleet) -> bool:
    """Whether anything ties the vehicles that ranges join to the map."""
    if any((target.sigma < UNKNOWN_PLACE)[:2].all() for target in fleet.targets):
        return True
    beacons = np.array(fleet.beacon_names, dtype=np.str_)
    return any(
        member.segment.start is not None
        or (member.segment.position is not None and len(member.segment.position))
        or any(np.isin(p.beacon, beacons).any() for p in ranges_of(member.segment).values())
        for member in fleet.vehicles
    )


def _judge(work: Work, name: str, result: Result, residuals: FleetResiduals | None) -> None:
    """Warn of what does not stop a solver but should stop a user."""
    segment = result.segments[0]
    weights = [np.empty(0)]
    if segment.residuals is not None:
        weights.append(segment.residuals.weight)
    if residuals is not None:
        weights.append(residuals.weight[(residuals.vehicle == name) | (residuals.peer == name)])
    found = np.concatenate(weights)
    share = float((found < DOWN_WEIGHTED).mean()) if len(found) else 0.0
    if share > SUSPICIOUS_SHARE:
        work.warn(
            name,
            f"{100 * share:.0f} % of its ranges are down-weighted; check clocks, sigmas and the "
            "start before trusting this track",
        )
    ratio = segment.chi_square / max(segment.degrees_of_freedom, 1)
    if ratio > SUSPICIOUS_CHI_SQUARE:
        work.warn(
            name,
            f"chi-square per degree of freedom is {ratio:.1f} for the vehicles that are solved "
            "with it: the data contradict each other or their sigmas are too small",
        )


def _judge_depth(work: Work, fleet: Fleet, name: str) -> None:
    """Warn where a planar vehicle is held at up 0 among what lies elsewhere."""
    member = fleet.member(name)
    if member.options.node != "pose2" or known_up(member.segment):
        return
    ups = [float(b.position[2]) for b in fleet.beacons]
    ups += [float(t.position[2]) for t in fleet.targets if t.position is not None]
    deep = any(known_up(v.segment) or v.options.node != "pose2" for v in fleet.vehicles)
    if deep or any(abs(up) > LEVEL for up in ups):
        work.warn(
            name,
            "it moves in a plane and nothing says how deep that is: it is held at up 0 m; give the "
            "start an up, or depths",
        )
