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
from ubl_graph.cooperative.model import MemberModel
from ubl_graph.cooperative.peers import PeerPings
from ubl_graph.cooperative.targets import Way
from ubl_graph.errors import UnobservableError
from ubl_graph.initial import Starts
from ubl_graph.measurements import SlantRange
from ubl_graph.mission import Start
from ubl_graph.nodes import NOMINAL_SPEED
from ubl_graph.pose_initial import find_tracks, reckoned_track

#: Ranges to others that a search looks at; more are thinned out evenly.
MOST_RANGES = 200
#: A range between clocks that may differ by more than this is no distance, s.
SAME_CLOCK = 1e-2


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
    try:
        return find_tracks(mission, replace(model, segment=segment))
    except UnobservableError:
        middle = mission.beacons[0].position if mission.beacons else np.zeros(3)
        anywhere = Start(float(model.t[0]), middle[0], middle[1], middle[2], FREE_POSITION)
        heading = None if mission.options.node == "point" else 0.0
        anywhere = replace(anywhere, heading=heading, heading_sigma=np.pi)
        return find_tracks(mission, replace(model, segment=replace(segment, start=anywhere)))
