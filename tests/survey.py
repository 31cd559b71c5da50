"""Simulated beacon surveys: a ship over an array, in water that varies in time and place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.beacon import Beacon
from ubl_graph.measurements import PositionFix, TwoWayRange
from ubl_graph.mission import Mission, Segment
from ubl_graph.options import Options

#: m/s, s, m: what is nominal, a beacon's turnaround, and what fixes err by (east, north, up).
SPEED, TURNAROUND = 1500.0, 1.0
FIX_SIGMA = np.array([0.02, 0.02, 0.05])


@dataclass(frozen=True)
class Water:
    """Standard deviations of what is not as the mission says; 0 leaves it out.

    scale (1) and its walk (1/sqrt(s)), gradients (1/m) and their walk (1/(m sqrt(s))).
    """

    scale: float = 5e-3
    walk: float = 2e-6
    gradient: float = 1e-7
    gradient_walk: float = 2e-10


def array(count: int, depth: float, rng: np.random.Generator) -> np.ndarray:
    """Beacons on a circle of 0.4 times the depth, at depths that differ by some per cent."""
    bearing = 2.0 * np.pi * np.arange(count) / count + 0.3
    reach = 0.4 * depth * (count > 1)
    east, north = 40.0 + reach * np.sin(bearing), reach * np.cos(bearing) - 25.0
    return np.column_stack([east, north, -depth * (1.0 + 0.02 * rng.random(count))])


def circle(depth: float, t: np.ndarray) -> np.ndarray:
    """A ship on a circle as wide as the water is deep, at 2.5 m/s."""
    angle = 2.5 * t / depth
    return depth * np.stack([np.sin(angle), np.cos(angle)], axis=1) + [30.0, -20.0]


def survey_track(depth: float, t: np.ndarray) -> np.ndarray:
    """A circle, then two lines across it."""
    around = 2.0 * np.pi * depth / 2.5
    line = 2.0 * depth / 2.5
    first, second = t - around, t - around - line - 300.0
    place = circle(depth, t)
    for begin, course in ((first, np.array([0.6, 0.8])), (second, np.array([0.8, -0.6]))):
        on = begin >= -150.0
        place[on] = (2.5 * begin[on] - depth)[:, None] * course + [30.0, -20.0]
    return place


def straight_track(depth: float, t: np.ndarray) -> np.ndarray:
    """One line."""
    return np.stack([2.0 * t - 1.3 * depth, 0.1 * depth + 0.0 * t], axis=1)


def survey(
    seed: int,
    *,
    depth: float = 1000.0,
    beacons: int = 4,
    pings: int = 400,
    noise: float = 1.0,
    water: Water | None = None,
    track=survey_track,
    duration: float | None = None,
    start_off: float = 0.0,
    moved: dict[str, np.ndarray] | None = None,
    sigma: float = 0.0,
    outliers: float = 0.0,
    fixes_every: float | None = None,
    options: Options | None = None,
) -> tuple[Mission, np.ndarray]:
    """A survey and the true positions (B, 3).

    Beacons are given `start_off` metres from where they are, or with errors drawn from `sigma`
    where that is given, and `moved` on top. Fixes come at the very times of the pings, or every
    `fixes_every` seconds.
    """
    rng = np.random.default_rng(seed)
    water = Water() if water is None else water
    true = array(beacons, depth, rng)
    if duration is None:
        duration = (2.0 * np.pi + 4.0) * depth / 2.5 + 300.0
    sent = np.linspace(5.0, duration - 10.0 - depth / 300.0, pings)
    which = rng.integers(0, beacons, pings)
    slow = _Slow(rng, duration, water, noise)
    centre = true[:, :2].mean(axis=0)

    def ship(t: np.ndarray) -> np.ndarray:
        heave = 0.6 * np.sin(2.0 * np.pi * t / 9.0) - 3.0
        return np.column_stack([track(depth, t), heave])

    def one_way(t: np.ndarray) -> np.ndarray:
        place, there = ship(t), true[which]
        away = np.linalg.norm(there - place, axis=1) / SPEED
        return away * np.exp(slow.log_scale(t, place[:, :2] - centre, there[:, :2] - centre))

    out = one_way(sent)
    back = out
    for _ in range(6):
        back = one_way(sent + out + TURNAROUND + back)
    heard = sent + out + TURNAROUND + back
    measured = out + back + noise * 1e-4 * rng.standard_normal(pings)
    wrong = rng.random(pings) < outliers
    measured = measured + wrong * rng.uniform(-0.05, 0.4, pings)
    heard = np.maximum(heard, sent + measured)
    names = [f"M{i + 1}" for i in range(beacons)]
    ranges = TwoWayRange(np.array(names)[which], sent, heard, measured, 1e-4)
    times = np.unique(np.concatenate([sent, heard]))
    if fixes_every is not None:
        times = np.arange(0.0, duration, fixes_every)
    fixed = (
        ship(times)
        + slow.track_error(times)
        + noise * FIX_SIGMA * np.sqrt(0.5) * rng.standard_normal((len(times), 3))
    )
    fixes = PositionFix(times, *fixed.T, covariance=np.diag(FIX_SIGMA**2))
    away = rng.standard_normal((beacons, 3))
    away *= start_off / np.linalg.norm(away, axis=1)[:, None]
    given = true + away + sigma * rng.standard_normal((beacons, 3))
    for name, shift in (moved or {}).items():
        given[names.index(name)] += shift
    mission = Mission(
        (Segment("S1/L1", two_way_range=ranges, position=fixes),),
        tuple(Beacon(n, p, sigma) for n, p in zip(names, given, strict=True)),
        SoundSpeedProfile.constant(SPEED),
        options=Options() if options is None else options,
        name="survey",
    )
    return mission, true


class _Slow:
    """Walks of scale and gradients, and the track's lasting error, drawn every 5 s."""

    def __init__(
        self, rng: np.random.Generator, duration: float, water: Water, noise: float
    ) -> None:
        self._t = np.arange(0.0, duration + 60.0, 5.0)
        n = len(self._t)

        def walk(first: float, rate: float) -> np.ndarray:
            steps = rate * np.sqrt(5.0) * rng.standard_normal(n)
            return first * rng.standard_normal() + np.cumsum(steps)

        self._scale = walk(water.scale, water.walk)
        self._gradients = [walk(water.gradient, water.gradient_walk) for _ in range(4)]
        kept = np.exp(-5.0 / 600.0)
        lasting = np.sqrt(0.5) * FIX_SIGMA
        error = np.empty((n, 3))
        error[0] = lasting * rng.standard_normal(3)
        for k in range(1, n):
            fresh = np.sqrt(1.0 - kept**2) * lasting * rng.standard_normal(3)
            error[k] = kept * error[k - 1] + fresh
        self._error = noise * error

    def log_scale(self, t: np.ndarray, here: np.ndarray, there: np.ndarray) -> np.ndarray:
        parts = [np.interp(t, self._t, g) for g in self._gradients]
        offsets = (here[:, 0], here[:, 1], there[:, 0], there[:, 1])
        return np.interp(t, self._t, self._scale) + sum(
            g * o for g, o in zip(parts, offsets, strict=True)
        )

    def track_error(self, t: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(t, self._t, e) for e in self._error.T], axis=1)
