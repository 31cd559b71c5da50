"""A start for every vehicle of a fleet.

Vehicles that know where they are come first. A range to a vehicle whose way is known is a range to
a beacon that stood there at that instant; so whoever ranged those is searched next as any vehicle
alone is, and so on to the last that ranges can reach.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.beacon import Beacon
from ubl_graph.builder import FREE_POSITION
from ubl_graph.cooperative.fleet import Fleet
from ubl_graph.cooperative.model import MemberModel, reference_time
from ubl_graph.cooperative.peers import PeerPings
from ubl_graph.cooperative.targets import SAME_CLOCK, TargetStart, Way, places_on
from ubl_graph.errors import UnobservableError
from ubl_graph.initial import Starts
from ubl_graph.measurements import SlantRange
from ubl_graph.mission import Start
from ubl_graph.nodes import NOMINAL_SPEED
from ubl_graph.pose_initial import find_tracks, reckoned_track

#: Ranges to others that a search looks at; more are thinned out evenly.
MOST_RANGES = 200
#: One-way ranges are this far off where tracks are only begun, at the least, s: 15 m.
ROUGH = 1e-2
#: No clock is known better to begin with, s and s/s.
LEAST_CLOCK = 1e-12
#: Passes in which those that are off by more lose their say.
CLOCK_PASSES = 10


def find_fleet_starts(
    fleet: Fleet, members: Sequence[MemberModel], pings: Sequence[PeerPings]
) -> dict[str, Starts]:
    """Search the start of every vehicle.

    Parameters
    ----------
    fleet : Fleet
        Whose vehicles.
    members : sequence of MemberModel
        All of them.
    pings : sequence of PeerPings
        Ranges between them.

    Returns
    -------
    dict of str to Starts
        By vehicle.
    """
    found: dict[str, Starts] = {}
    ways: dict[str, Way] = {}
    left = {m.name: m for m in members}
    while left:
        ranges = {name: _known_ranges(fleet, m, pings, ways) for name, m in left.items()}
        name = max(left, key=lambda n: _certainty(left[n], len(ranges[n])))
        member = left.pop(name)
        found[name] = _searched(member, ranges[name])
        ways[name] = (member.model.t, found[name].tracks[0].position)
    return found


def with_clocks(
    fleet: Fleet,
    members: Sequence[MemberModel],
    pings: Sequence[PeerPings],
    starts: Mapping[str, Starts],
    places: Mapping[str, Sequence[TargetStart]],
) -> dict[str, Starts]:
    """The same starts, with the clocks that one-way ranges ask for.

    A robust loss takes all of these for outliers where the search begins with clocks that are off
    by more than a few of their standard deviations, and learns nothing from them.

    Parameters
    ----------
    fleet, members, pings
        As for `find_fleet_starts`.
    starts : mapping of str to Starts
        Of the vehicles.
    places : mapping of str to sequence of TargetStart
        Where targets may be, the best first.
    """
    ways = {m.name: (m.model.t, starts[m.name].tracks[0].position) for m in members}
    ends = np.array([min(t[0] for t, _ in ways.values()), max(t[-1] for t, _ in ways.values())])
    for target in fleet.targets:
        first = places[target.name][0]
        since = ends - reference_time(target, pings) if target.moves else np.zeros(2)
        ways[target.name] = (ends, first.position + since[:, None] * first.velocity)
    for beacon in fleet.beacons:
        ways[beacon.name] = (ends, np.tile(beacon.position, (2, 1)))
    middle = float(ends.mean())
    offset, drift = _clocks(fleet, members, ways, middle)
    return {
        m.name: replace(
            starts[m.name],
            tracks=tuple(
                replace(track, clock=offset[i] + drift[i] * (m.model.t - middle))
                for track in starts[m.name].tracks
            ),
        )
        for i, m in enumerate(members)
    }


def _clocks(
    fleet: Fleet, members: Sequence[MemberModel], ways: Mapping[str, Way], middle: float
) -> tuple[FloatArray, FloatArray]:
    """Offset (s) at the time `middle` and drift of each vehicle's clock, (V,) each.

    The one-way ranges' least sum of absolute values, by least squares over and over.
    """
    count = len(members)
    number = {m.name: i for i, m in enumerate(members)}
    speed = float(np.mean(fleet.sound_speed.speed))
    matrix, value = [np.empty((0, count, 2))], [np.empty(0)]
    for i, member in enumerate(members):
        rows = member.member.segment.one_way_range
        if rows is None or not len(rows):
            continue
        here = places_on(ways, np.full(len(rows), member.name), rows.t_receive)
        there = places_on(ways, rows.beacon, rows.t_transmit)
        value.append(rows.travel_time - np.linalg.norm(here - there, axis=1) / speed)
        own = np.zeros((len(rows), count + 1, 2))
        own[:, i] += np.stack([np.ones(len(rows)), rows.t_receive - middle], axis=1)
        # Beacons and targets keep the fleet's time: their column is dropped.
        sender = [number.get(str(name), count) for name in rows.beacon]
        sent = np.stack([np.ones(len(rows)), rows.t_transmit - middle], axis=1)
        own[np.arange(len(rows)), sender] -= sent
        matrix.append(own[:, :count])
    a, b = np.concatenate(matrix).reshape(-1, 2 * count), np.concatenate(value)
    sigmas = [
        (m.mission.options.clock_offset_sigma, m.mission.options.clock_drift_sigma) for m in members
    ]
    known = np.diag(np.maximum(np.ravel(sigmas), LEAST_CLOCK) ** -2.0)
    weight = np.full(len(b), ROUGH**-2)
    found = np.zeros(2 * count)
    for _ in range(CLOCK_PASSES):
        squared = a.T @ (weight[:, None] * a) + known
        found = np.asarray(np.linalg.solve(squared, a.T @ (weight * b)), dtype=np.float64)
        weight = 1.0 / (ROUGH * np.maximum(np.abs(b - a @ found), ROUGH))
    offset, drift = found.reshape(count, 2).T
    return offset, drift


def reckons(member: MemberModel) -> bool:
    """Whether a vehicle finds its way from what it knows itself: place, heading and speed."""
    segment, model = member.model.segment, member.model
    if segment.position is not None and len(segment.position) > 1:
        return True
    start = segment.start
    if start is None:
        return False
    moves = model.bottom is not None or model.water is not None or segment.odometry is not None
    return moves and (start.heading is not None or model.heads)


def _certainty(member: MemberModel, ranges: int) -> tuple[bool, bool, int]:
    """What decides who is searched next."""
    segment = member.model.segment
    anchored = segment.start is not None or segment.position is not None
    own = sum(len(getattr(segment, kind) or ()) for kind in _KINDS)
    return reckons(member), anchored, own + ranges


_KINDS = ("two_way_range", "one_way_range", "slant_range")


def _known_ranges(
    fleet: Fleet, member: MemberModel, pings: Sequence[PeerPings], ways: Mapping[str, Way]
) -> list[tuple[float, FloatArray, float, float]]:
    """Time (s), the other's place, distance and its sigma (m) of ranges to those that are known."""
    if reckons(member):
        return []
    out: list[tuple[float, FloatArray, float, float]] = []
    speed = float(np.mean(fleet.sound_speed.speed))
    clocks = {v.name: v.options.clock_offset_sigma for v in fleet.vehicles}
    for p in pings:
        metres = (NOMINAL_SPEED if p.kind == "slant_range" else speed) / p.here.shape[1]
        for who, other, at, away in (
            (p.vehicle, p.peer, p.here, p.there),
            (p.peer, p.vehicle, p.there, p.here),
        ):
            for i in np.flatnonzero((who == member.name) & np.isin(other, list(ways))):
                sigma = float(p.sigma[i])
                if p.kind == "one_way_range":
                    differ = float(np.hypot(clocks[member.name], clocks[str(other[i])]))
                    if differ > SAME_CLOCK:
                        continue
                    sigma = float(np.hypot(sigma, differ))
                t, position = ways[str(other[i])]
                then = float(away[i].mean())
                place = np.array([np.interp(then, t, c) for c in position.T])
                out.append(
                    (float(at[i].mean()), place, metres * float(p.measured[i]), metres * sigma)
                )
    return out


def _searched(member: MemberModel, ranges: list[tuple[float, FloatArray, float, float]]) -> Starts:
    """Search one vehicle's start among beacons and the known places of others."""
    model, mission = member.model, member.mission
    reckoned = reckoned_track(mission, model)
    if reckoned is not None:
        return Starts((reckoned,), None)
    segment = model.segment
    if ranges:
        some = np.unique(np.linspace(0, len(ranges) - 1, MOST_RANGES).astype(int))
        t, place, distance, sigma = zip(*(ranges[i] for i in some), strict=True)
        # Vehicles that pass each other closely may measure nothing.
        distances = np.maximum(distance, 0.1)
        names = [f"another, {i}" for i in range(len(t))]
        beacons = tuple(Beacon(n, p) for n, p in zip(names, place, strict=True))
        own = segment.slant_range
        sigmas = np.clip(sigma, 1e-6, 1e4)
        if own is not None:
            t, names = np.concatenate([own.t, t]), [*own.beacon, *names]
            distances = np.concatenate([own.distance, distances])
            sigmas = np.concatenate([own.sigma, sigmas])
        segment = replace(segment, slant_range=SlantRange(t, names, distances, sigmas))
        mission = replace(mission, beacons=(*mission.beacons, *beacons), segments=(segment,))
    kinds = {"two_way_range", "one_way_range", "slant_range", "position"}
    if segment.start is None and not kinds & segment.records().keys():
        return _anywhere(member)
    try:
        return find_tracks(mission, replace(model, segment=segment))
    except UnobservableError:
        return _anywhere(member)


def _anywhere(member: MemberModel) -> Starts:
    """A start where nothing says where a vehicle is.

    It lies where the priors have their middles: all places and headings are as good, and from any
    other the solver would creep there.
    """
    model, mission = member.model, member.mission
    middle = np.zeros(3)
    if mission.beacons:
        middle = np.mean([b.position for b in mission.beacons], axis=0)
    start = Start(float(model.t[0]), middle[0], middle[1], middle[2], FREE_POSITION)
    if mission.options.node != "point":
        # As if known: then the way is reckoned, and nothing is searched.
        start = replace(start, heading=0.5 * np.pi, heading_sigma=1e-3)
    model = replace(model, segment=replace(model.segment, start=start))
    reckoned = reckoned_track(mission, model)
    return find_tracks(mission, model) if reckoned is None else Starts((reckoned,), None)
