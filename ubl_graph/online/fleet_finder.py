"""Places of vehicles without a start, and of targets, from the ranges that wait for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ubl_graph import lie
from ubl_graph.acoustics import straight
from ubl_graph.arrays import FloatArray
from ubl_graph.builder import FREE_POSITION
from ubl_graph.cooperative.fleet import Fleet, Target
from ubl_graph.factors.loss import RobustLoss
from ubl_graph.mission import Start
from ubl_graph.nodes import NOMINAL_SPEED
from ubl_graph.online.buffer import Entry
from ubl_graph.online.fleet_line import Line, moved, turns_and_ways
from ubl_graph.online.fleet_place import Place, Residuals, placed
from ubl_graph.online.health import LOST_LEAST

#: A wrong range among those that a place is sought by must not spoil it.
shaped = RobustLoss("cauchy").shaped
#: Directions and headings that a search begins at.
DIRECTIONS, HEADINGS = 24, 12
#: Records that a search looks at, the newest.
MOST_RECORDS = 60
#: A heading is known if its standard deviation is less, rad; a place if its is less than this
#: share of the ranges' length (or than what a vehicle is lost beyond).
KNOWN_HEADING, KNOWN_SHARE = 0.5, 0.1
#: What no place can be known better by than this, m and m/s: it keeps the equations regular.
LEAST_SIGMA = 1e-3


class Seen(NamedTuple):
    """A range from what is to be placed to what has a place."""

    t: float
    place: FloatArray  # (3,), m
    variance: float  # of the place along any direction, m^2
    distance: float  # m
    sigma: float  # m


class Reading(NamedTuple):
    """A fix or heading of what is to be placed: value and standard deviation."""

    t: float
    value: FloatArray  # (2,), m, or (1,), rad clockwise from north
    sigma: float


@dataclass(frozen=True, eq=False)
class Found:
    """What a search came to.

    Attributes
    ----------
    place : Place or None
        None where nothing is determined.
    status : str
        "ok", "initialising" or "ambiguous".
    reason : str
        Why it is not ok.
    t : float
        Of the place, s.
    """

    place: Place | None
    status: str
    reason: str
    t: float


def legs_of(entry: Entry) -> tuple[float, float, tuple[float, ...], tuple[float, ...]]:
    """Travel time and sigma (s) of a range, and times (s) of its legs here and there."""
    v = entry.values
    if entry.kind == "slant_range":
        return v[2] / NOMINAL_SPEED, v[3] / NOMINAL_SPEED, (v[1],), (v[1],)
    if entry.kind == "one_way_range":
        return v[2] - v[1], v[3], (v[2],), (v[1],)
    half = 0.5 * v[3]
    return v[3], v[4], (v[1], v[2]), (v[1] + half, v[2] - half)


def distance_of(fleet: Fleet, entry: Entry, clock: tuple[float, float]) -> tuple[float, float]:
    """Distance and sigma, m, of a range; `clock` is what the clocks add, mean and sigma, s."""
    measured, sigma, here, _ = legs_of(entry)
    speed = NOMINAL_SPEED
    if entry.kind != "slant_range":
        metre = straight(fleet.sound_speed, np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]]))
        speed = 1.0 / float(metre.time[0])
    sigma = float(np.hypot(sigma, clock[1]))
    return (measured - clock[0]) * speed / len(here), sigma * speed / len(here)


def find_vehicle(
    line: Line,
    start: Start | None,
    seen: Sequence[Seen],
    fixes: Sequence[Reading],
    heads: Sequence[Reading],
) -> Found:
    """Place and heading of a vehicle at the first time of which something is known."""
    fixes = [*fixes, *_start_fix(start)]
    heads = [*heads, *_start_heading(start)]
    seen = sorted(seen, key=lambda s: s.t)[-MOST_RECORDS:]
    fixes = sorted(fixes, key=lambda f: f.t)[-MOST_RECORDS:]
    heads = sorted(heads, key=lambda h: h.t)[-MOST_RECORDS:]
    every = [*seen, *fixes, *heads]
    t0 = min((one.t for one in every), default=np.nan)
    if len(seen) + 2 * len(fixes) + len(heads) < 3:
        return Found(None, "initialising", "waiting for ranges or positions", t0)
    path = _Path(line, sorted({one.t for one in every}))
    residuals = _rigid(line, path, seen, fixes, heads)
    starts = _starts(line, path, seen, fixes, heads)
    found = placed(residuals, starts, angle=2)
    return _judged(found, seen, t0, heading=True)


def _start_fix(start: Start | None) -> list[Reading]:
    if start is None:
        return []
    return [Reading(start.t, np.array([start.east, start.north]), start.sigma)]


def _start_heading(start: Start | None) -> list[Reading]:
    if start is None or start.heading is None:
        return []
    return [Reading(start.t, np.array([start.heading]), start.heading_sigma)]


class _Path:
    """A vehicle's way and turn since the first of some times, by its odometry."""

    def __init__(self, line: Line, times: Sequence[float]) -> None:
        self.times = np.array(times)
        x = np.zeros(3 if line.planar else 6)
        poses, spread = [x], [0.0]
        if len(times) > 1:
            step = line.between(times)
            turns, ways = turns_and_ways(step)
            for way, turn, covariance in zip(ways, turns, step.covariance, strict=True):
                x = moved(x, way, turn)
                poses.append(x)
                spread.append(spread[-1] + float(np.trace(covariance[:2, :2])))
        self.poses, self.spread = np.array(poses), np.array(spread)
        self.yaw = self.poses[:, 2]
        if not line.planar:
            rotation = lie.rotation(self.poses[:, 3:])
            self.yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])

    def at(self, times: Sequence[float]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """East and north in the first pose's axes (M, 2), yaw and variance, (M,)."""
        rows = np.searchsorted(self.times, times)
        return self.poses[rows, :2], self.yaw[rows], self.spread[rows]


def _ups(line: Line, times: Sequence[float]) -> FloatArray:
    return line.up_at(np.array(times, dtype=np.float64))


def _rigid(
    line: Line,
    path: _Path,
    seen: Sequence[Seen],
    fixes: Sequence[Reading],
    heads: Sequence[Reading],
) -> Residuals:
    """Residuals by east, north and yaw of the path's first pose."""
    t_seen, t_fix, t_head = ([one.t for one in some] for some in (seen, fixes, heads))
    way, _, spread = path.at(t_seen)
    way_fix, _, spread_fix = path.at(t_fix)
    _, turned, _ = path.at(t_head)
    places = np.array([s.place for s in seen]).reshape(-1, 3)
    climb = _ups(line, t_seen) + line.member.vehicle.transducer.body[2] - places[:, 2]
    distance = np.array([s.distance for s in seen])
    sigma = np.sqrt([s.sigma**2 + s.variance for s in seen] + spread)
    fixed = np.array([f.value for f in fixes]).reshape(-1, 2)
    fix_sigma = np.sqrt([f.sigma**2 for f in fixes] + spread_fix)
    read = np.array([h.value[0] for h in heads])
    head_sigma = np.array([h.sigma for h in heads])

    def residuals(q: FloatArray) -> FloatArray:
        cos, sin = np.cos(q[:, 2:]), np.sin(q[:, 2:])

        def at(part: FloatArray) -> tuple[FloatArray, FloatArray]:
            east = q[:, :1] + cos * part[:, 0] - sin * part[:, 1]
            return east, q[:, 1:2] + sin * part[:, 0] + cos * part[:, 1]

        east, north = at(way)
        length = np.sqrt((east - places[:, 0]) ** 2 + (north - places[:, 1]) ** 2 + climb**2)
        east_fix, north_fix = at(way_fix)
        off = 0.5 * np.pi - q[:, 2:] - turned - read
        return np.concatenate(
            [
                shaped((length - distance) / sigma),
                (east_fix - fixed[:, 0]) / fix_sigma,
                (north_fix - fixed[:, 1]) / fix_sigma,
                (np.remainder(off + np.pi, 2.0 * np.pi) - np.pi) / head_sigma,
            ],
            axis=1,
        )

    return residuals


def _starts(
    line: Line,
    path: _Path,
    seen: Sequence[Seen],
    fixes: Sequence[Reading],
    heads: Sequence[Reading],
) -> FloatArray:
    """Where a search begins: (S, 3)."""
    yaws = 2.0 * np.pi * np.arange(HEADINGS) / HEADINGS
    if heads:
        _, turned, _ = path.at([heads[0].t])
        yaws = np.array([0.5 * np.pi - heads[0].value[0] - turned[0]])
    if fixes:
        way, _, _ = path.at([fixes[0].t])
        places = fixes[0].value[None]
    else:
        way, _, _ = path.at([seen[0].t])
        up = _ups(line, [seen[0].t])[0]
        places = _ring(seen[0], up)
    yaw, place = np.repeat(yaws, len(places)), np.tile(places, (len(yaws), 1))
    cos, sin = np.cos(yaw), np.sin(yaw)
    east = place[:, 0] - (cos * way[0, 0] - sin * way[0, 1])
    north = place[:, 1] - (sin * way[0, 0] + cos * way[0, 1])
    return np.stack([east, north, yaw], axis=1)


def _ring(seen: Seen, up: float) -> FloatArray:
    """Points at a range from a place, (DIRECTIONS, 2)."""
    radius = np.sqrt(max(seen.distance**2 - (up - seen.place[2]) ** 2, 1.0))
    angle = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    return seen.place[:2] + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def find_target(target: Target, seen: Sequence[Seen], epoch: float) -> Found:
    """Place, and velocity where it moves, of a target at a time `epoch` (s)."""
    seen = list(seen)[-MOST_RECORDS:]
    size = 6 if target.moves else 3
    if len(seen) < 3:
        return Found(None, "initialising", "waiting for ranges", epoch)
    residuals = target_residuals(target, seen, epoch)
    mean, sigma, phi = known_of(target, epoch)
    up_sigma = float(np.linalg.norm(phi[2] * sigma))
    up = mean[2] if up_sigma < 0.5 * FREE_POSITION else np.nan
    nearest = min(seen, key=lambda s: s.distance)
    ups = (
        [up]
        if np.isfinite(up)
        else [nearest.place[2] + k * nearest.distance for k in (-0.7, 0, 0.7)]
    )
    starts: list[FloatArray] = []
    for first in (seen[0], nearest, seen[-1]):
        for level in ups:
            ring = _ring(first, level)
            whole = np.zeros((len(ring), size))
            whole[:, :2], whole[:, 2] = ring, level
            starts.append(whole)
    if target.position is not None:
        starts.append(mean[None])
    found = placed(residuals, np.concatenate(starts))
    return _judged(found, seen, epoch, heading=False)


def known_of(target: Target, epoch: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What is known of a target beforehand.

    Returns
    -------
    mean, sigma : array, shape (3,) or (6,)
        Independent, at the time that the target states (at `epoch` (s) where it states none).
    phi : array, shape (3, 3) or (6, 6)
        What carries them to the epoch: its position has gone on with its velocity since, and is
        correlated with it.
    """
    size = 6 if target.moves else 3
    mean, sigma = np.zeros(size), np.full(size, FREE_POSITION)
    sigma[:3] = np.maximum(target.sigma, LEAST_SIGMA)
    if target.position is not None:
        mean[:3] = target.position
    if target.moves:
        sigma[3:] = np.maximum(target.velocity_sigma, LEAST_SIGMA)
    phi = np.eye(size)
    if target.moves and target.t is not None:
        phi[:3, 3:] = (epoch - target.t) * np.eye(3)
    # The mean's velocity is none: it stays where it is.
    return mean, sigma, phi


def target_residuals(target: Target, seen: Sequence[Seen], epoch: float) -> Residuals:
    """Residuals of ranges, and of what is known beforehand behind them."""
    places = np.array([s.place for s in seen])
    later = np.array([s.t for s in seen]) - epoch
    distance = np.array([s.distance for s in seen])
    sigma = np.sqrt([s.sigma**2 + s.variance for s in seen])
    mean, spread, phi = known_of(target, epoch)
    white = np.linalg.inv(phi) / spread[:, None]

    def residuals(q: FloatArray) -> FloatArray:
        off = q[:, None, :3] - places
        if q.shape[1] == 6:
            off = off + later[:, None] * q[:, None, 3:]
        length = np.sqrt(np.einsum("sni,sni->sn", off, off))
        known = (q - mean) @ white.T
        return np.concatenate([shaped((length - distance) / sigma), known], axis=1)

    return residuals


def _judged(found: Place | None, seen: Sequence[Seen], t: float, *, heading: bool) -> Found:
    """Whether a place is known well enough."""
    if found is None:
        return Found(None, "initialising", "the ranges do not determine a place yet", t)
    sigma = float(np.sqrt(np.linalg.eigvalsh(found.covariance[:2, :2])[-1]))
    length = float(np.median([s.distance for s in seen])) if seen else 0.0
    if found.rival is not None:
        return Found(found, "ambiguous", "another place fits as well", t)
    if sigma > max(LOST_LEAST, KNOWN_SHARE * length):
        return Found(None, "initialising", f"known to {sigma:.0f} m only", t)
    if heading and found.covariance[2, 2] > KNOWN_HEADING**2:
        return Found(None, "initialising", "the heading is not known yet", t)
    return Found(found, "ok", "", t)
