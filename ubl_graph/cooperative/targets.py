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
    """Distances to a target, m, from where and after which time, s."""

    place: FloatArray
    distance: FloatArray
    sigma: FloatArray
    later: FloatArray

    def residuals(self, position: FloatArray, velocity: FloatArray) -> FloatArray:
        """Whitened, (..., M), for positions (..., 3) and a velocity (3,)."""
        there = position[..., None, :] + self.later[:, None] * velocity
        apart = np.linalg.norm(there - self.place, axis=-1)
        return (apart - self.distance) / self.sigma


def _seen(
    fleet: Fleet, target: Target, pings: Sequence[PeerPings], ways: Mapping[str, Way]
) -> _Seen:
    epoch = reference_time(target, pings) if target.moves else 0.0
    speed = float(np.mean(fleet.sound_speed.speed))
    clocks = {v.name: v.options.clock_offset_sigma for v in fleet.vehicles}
    columns: list[tuple[FloatArray, ...]] = [(np.empty((0, 3)), *[np.empty(0)] * 3)]
    for p in pings:
        rows = np.flatnonzero(p.peer == target.name)
        metres = (NOMINAL_SPEED if p.kind == "slant_range" else speed) / p.here.shape[1]
        at = p.here[rows].mean(axis=1)
        place = np.empty((len(rows), 3))
        for name in np.unique(p.vehicle[rows]):
            own = p.vehicle[rows] == name
            t, position = ways[str(name)]
            place[own] = np.stack([np.interp(at[own], t, c) for c in position.T], axis=1)
        sigma = p.sigma[rows]
        if p.kind == "one_way_range":
            # A range between clocks that may differ says as little as they do.
            sigma = np.hypot(sigma, [clocks[str(name)] for name in p.vehicle[rows]])
        columns.append((place, metres * p.measured[rows], metres * sigma, at - epoch))
    return _Seen(*(np.concatenate(parts) for parts in zip(*columns, strict=True)))


def _begins(target: Target, seen: _Seen) -> FloatArray:
    """Places to begin at, (S, 3): on circles around the first, middle and last vehicle."""
    known = None
    if target.position is not None and target.sigma[2] < UNKNOWN_PLACE:
        known = float(target.position[2])
    order = np.argsort(seen.later)
    angles = np.linspace(0.0, 2.0 * np.pi, BEARINGS, endpoint=False)
    out: list[FloatArray] = []
    for i in np.unique(order[[0, len(order) // 2, -1]]):
        place, distance = seen.place[i], seen.distance[i]
        ups = [known] if known is not None else [place[2], place[2] - 0.5 * distance]
        for up in ups:
            radius = np.sqrt(max(distance**2 - (place[2] - up) ** 2, 1.0))
            circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(BEARINGS)], axis=1)
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
    loss = "cauchy" if robust else "linear"
    found = least_squares(residuals, x, x_scale=scale, loss=loss, max_nfev=60)
    state = whole(found.x)
    return TargetStart(state[:3], state[3:], float(found.cost))
