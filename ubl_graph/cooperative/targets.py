"""Where a target may be, from the ranges to it and where the vehicles were."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from ubl_graph.arrays import FloatArray
from ubl_graph.cooperative.fleet import UNKNOWN_PLACE, Fleet, Target
from ubl_graph.cooperative.model import HELD, reference_time
from ubl_graph.cooperative.peers import PeerPings
from ubl_graph.nodes import NOMINAL_SPEED

#: Bearings around a vehicle from which the search begins.
BEARINGS = 48
#: So many of them are followed to the bottom.
FOLLOWED = 6
#: A range between clocks that may differ by more than this is no distance, s.
SAME_CLOCK = 1e-2
#: Where no distance says how far a target is, it is sought at these shares of the vehicles' extent,
SHARES = (0.3, 1.0, 3.0)
#: and at this distance at the least, m.
NEAREST = 100.0
#: Answers nearer than this, m, or than so many standard deviations of a range, are one.
SAME_PLACE, SAME_SIGMAS = 1.0, 3.0

#: A vehicle's way: times (N,), s, and positions (N, 3), m.
Way = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class TargetStart:
    """An answer of the search.

    Attributes
    ----------
    position, velocity : array, shape (3,)
        East, north, up, m; m/s.
    cost : float
        Of the ranges, with the vehicles where they were thought to be.
    """

    position: FloatArray
    velocity: FloatArray
    cost: float


def target_starts(
    fleet: Fleet, target: Target, pings: Sequence[PeerPings], ways: Mapping[str, Way]
) -> list[TargetStart]:
    """Places of a target that fit the ranges to it, the best first.

    Parameters
    ----------
    fleet, target
        Whose.
    pings : sequence of PeerPings
        All ranges between vehicles and to targets.
    ways : mapping of str to Way
        Where the vehicles are thought to have been.

    Returns
    -------
    list of TargetStart
        At least one; that where the target is thought to be, or the vehicles' middle, where there
        is no range to it.
    """
    seen = _seen(fleet, target, pings, ways)
    if not len(seen.distance):
        middle = np.mean([p.mean(axis=0) for _, p in ways.values()], axis=0)
        position = middle if target.position is None else np.asarray(target.position)
        return [TargetStart(position, np.zeros(3), 0.0)]
    begins = _begins(target, seen)
    cost = (seen.residuals(begins, np.zeros(3)) ** 2).sum(axis=1)
    answers: list[TargetStart] = []
    followed = np.argsort(cost, kind="stable")
    for begin in _apart(begins[followed], FOLLOWED):
        answer = _descended(target, seen, begin, robust=fleet.options.loss != "none")
        same = max(SAME_PLACE, SAME_SIGMAS * float(np.median(seen.sigma)))
        if all(np.linalg.norm(answer.position - a.position) > same for a in answers):
            answers.append(answer)
    return sorted(answers, key=lambda a: a.cost)


@dataclass(frozen=True, eq=False)
class _Seen:
    """Distances to a target, m, from where and after which time, s.

    `clock` numbers the vehicles whose clock is not known, which all their distances have in common;
    -1 where it is.
    """

    place: FloatArray
    distance: FloatArray
    sigma: FloatArray
    later: FloatArray
    clock: FloatArray

    def residuals(self, position: FloatArray, velocity: FloatArray) -> FloatArray:
        """Whitened, (..., M), for positions (..., 3) and a velocity (3,)."""
        there = position[..., None, :] + self.later[:, None] * velocity
        off = np.linalg.norm(there - self.place, axis=-1) - self.distance
        for number in np.unique(self.clock[self.clock >= 0]):
            own = self.clock == number
            off[..., own] -= off[..., own].mean(axis=-1, keepdims=True)
        return off / self.sigma


def _seen(
    fleet: Fleet, target: Target, pings: Sequence[PeerPings], ways: Mapping[str, Way]
) -> _Seen:
    epoch = reference_time(target, pings) if target.moves else 0.0
    speed = float(np.mean(fleet.sound_speed.speed))
    unknown = {
        v.name: i if v.options.clock_offset_sigma > SAME_CLOCK else -1
        for i, v in enumerate(fleet.vehicles)
    }
    columns: list[tuple[FloatArray, ...]] = [(np.empty((0, 3)), *[np.empty(0)] * 4)]
    for p in pings:
        rows = np.flatnonzero(p.peer == target.name)
        metres = (NOMINAL_SPEED if p.kind == "slant_range" else speed) / p.here.shape[1]
        at = p.here[rows].mean(axis=1)
        place = places_on(ways, p.vehicle[rows], at)
        clock = np.full(len(rows), -1.0)
        if p.kind == "one_way_range":
            clock[:] = [unknown[str(name)] for name in p.vehicle[rows]]
        distance, sigma = metres * p.measured[rows], metres * p.sigma[rows]
        columns.append((place, distance, sigma, at - epoch, clock))
    return _Seen(*(np.concatenate(parts) for parts in zip(*columns, strict=True)))


def places_on(ways: Mapping[str, Way], names: FloatArray, times: FloatArray) -> FloatArray:
    """Where each of some vehicles (M,) was at a time (M,), s: (M, 3), m."""
    place = np.empty((len(times), 3))
    for name in np.unique(names):
        own = names == name
        t, position = ways[str(name)]
        place[own] = np.stack([np.interp(times[own], t, c) for c in position.T], axis=1)
    return place


def _begins(target: Target, seen: _Seen) -> FloatArray:
    """Places to begin at, (S, 3): on circles around the first, middle and last vehicle."""
    known = None
    if target.position is not None and target.sigma[2] < UNKNOWN_PLACE:
        known = float(target.position[2])
    order = np.argsort(seen.later)
    timed = order[seen.clock[order] < 0]
    if len(timed):
        rows = np.unique(timed[[0, len(timed) // 2, -1]])
        around = [(int(i), float(seen.distance[i])) for i in rows]
    else:
        extent = max(NEAREST, float(np.linalg.norm(np.ptp(seen.place, axis=0))))
        around = [(int(order[len(order) // 2]), share * extent) for share in SHARES]
    angles = np.linspace(0.0, 2.0 * np.pi, BEARINGS, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(BEARINGS)], axis=1)
    out: list[FloatArray] = []
    for i, distance in around:
        place = seen.place[i]
        ups = [known] if known is not None else [place[2], place[2] - 0.5 * distance]
        for up in ups:
            radius = np.sqrt(max(distance**2 - (place[2] - up) ** 2, 1.0))
            out.append(np.array([place[0], place[1], up]) + radius * circle)
    if target.position is not None:
        out.append(np.asarray(target.position)[None])
    return np.concatenate(out)


def _apart(begins: FloatArray, most: int) -> list[FloatArray]:
    """The first of some places, leaving out those beside one that was taken."""
    scale = 0.1 * float(np.ptp(begins[:, :2], axis=0).max())
    out: list[FloatArray] = []
    for begin in begins:
        if all(np.linalg.norm(begin - other) > scale for other in out):
            out.append(begin)
        if len(out) == most:
            break
    return out


def _descended(target: Target, seen: _Seen, begin: FloatArray, *, robust: bool) -> TargetStart:
    """The answer that a place leads to."""
    free = np.flatnonzero(np.concatenate([target.sigma > HELD, target.velocity_sigma > HELD]))
    middle = np.zeros(6)
    middle[:3] = begin if target.position is None else target.position
    sigma = np.concatenate([target.sigma, np.maximum(target.velocity_sigma, HELD)])

    def whole(x: FloatArray) -> FloatArray:
        state = np.where(np.arange(6) < 3, middle, 0.0)
        state[free] = x
        return state

    def residuals(x: FloatArray) -> FloatArray:
        state = whole(x)
        prior = (state - middle)[free] / sigma[free]
        return np.concatenate([seen.residuals(state[:3], state[3:]), prior])

    x = np.concatenate([begin, np.zeros(3)])[free]
    scale = np.where(free < 3, 100.0, 1.0)
    # Without a loss first: far from the answer all ranges look like outliers.
    found = least_squares(residuals, x, x_scale=scale, max_nfev=60)
    if robust:
        found = least_squares(residuals, found.x, x_scale=scale, loss="cauchy", max_nfev=60)
    state = whole(found.x)
    return TargetStart(state[:3], state[3:], float(found.cost))
