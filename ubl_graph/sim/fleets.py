"""Simulated fleets: vehicles on winding tracks in planes of their own that range each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.arrays import FloatArray
from ubl_graph.cooperative.fleet import Fleet, Member, Target
from ubl_graph.errors import ConfigurationError
from ubl_graph.measurements import (
    Odometry,
    OneWayRange,
    PositionFix,
    SlantRange,
    TwoWayRange,
)
from ubl_graph.options import Options
from ubl_graph.segment import Segment, Start
from ubl_graph.sim.tracks import Truth

SPEED_OF_SOUND = 1500.0  #: m/s
#: One standard deviation of a second's odometry: along and across, m, and about up, rad.
ODOMETRY_SIGMA = (0.1, 0.03, float(np.deg2rad(0.02)))
#: Of a start's position, m, and heading, rad; of fixes, m, and ranges, m.
START_SIGMA, HEADING_SIGMA, FIX_SIGMA, RANGE_SIGMA = 5.0, 0.02, 2.0, 2.0
#: Of clocks' offsets, s, and drifts, s/s, where ranges are one-way.
OFFSET_SIGMA, DRIFT_SIGMA = 0.1, 1e-6

RangeKind = Literal["slant_range", "two_way_range", "one_way_range"]


def random_fleet(
    seed: int,
    vehicles: int = 10,
    duration: float = 3600.0,
    every: float = 5.0,
    *,
    kind: RangeKind = "slant_range",
    fixed: int = 2,
    fix_every: float = 60.0,
    targets: int = 0,
    noise: float = 1.0,
) -> tuple[Fleet, dict[str, Truth]]:
    """A fleet of which random pairs range each other.

    Every vehicle knows its start and has odometry at 1 Hz; some have position fixes. Ranges come at
    any time, between the odometry's seconds. Targets at rest, of known depth, are ranged as often
    as vehicles are.

    Parameters
    ----------
    seed : int
        Of all that is random.
    vehicles : int
        How many, at least two where there are no targets.
    duration, every : float
        Length of the mission, and time from range to range, s.
    kind : str
        Which ranges; clocks differ where they are one-way.
    fixed : int
        How many vehicles have fixes, and
    fix_every : float
        how often, s.
    targets : int
        How many.
    noise : float
        Multiplies all noise; the records' sigmas stay.

    Returns
    -------
    Fleet
    dict of str to Truth
        By vehicle and target.
    """
    if vehicles + targets < 2 or vehicles < 1:
        raise ConfigurationError("a fleet of one has nobody to range", "take two or more")
    rng = np.random.default_rng(seed)
    names = [f"V{i}" for i in range(vehicles)]
    truths = {name: _winding(rng, duration) for name in names}
    spread = 2000.0
    marks = [f"T{i}" for i in range(targets)]
    for mark in marks:
        place = np.array([*rng.uniform(-spread, spread, 2), -60.0])
        truths[mark] = _resting(place, duration)
    clocks = dict.fromkeys(names, (0.0, 0.0))
    if kind == "one_way_range":
        clocks = {
            name: (OFFSET_SIGMA * rng.standard_normal(), DRIFT_SIGMA * rng.standard_normal())
            for name in names
        }
    ranges = _ranges(rng, truths, names, marks, duration, every, kind, clocks, noise)
    options = Options(
        node="pose2",
        estimate_sound_speed=False,
        odometry_scale_sigma=0.0,
        odometry_turn_bias_sigma_deg=0.0,
        clock_offset_sigma=OFFSET_SIGMA,
        clock_drift_sigma=DRIFT_SIGMA,
    )
    members: list[Member] = []
    for i, name in enumerate(names):
        truth = truths[name]
        segment = Segment(
            name,
            start=_start(rng, truth, noise),
            odometry=_odometry(rng, truth, duration, noise),
            position=_fixes(rng, truth, duration, fix_every, noise) if i < fixed else None,
        )
        if name in ranges:
            segment = replace(segment, **{kind: ranges[name]})
        members.append(Member(name, segment, options=options))
    unknown = tuple(
        Target(mark, [0.0, 0.0, truths[mark].position(0.0)[0, 2]], sigma=(1e4, 1e4, 0.0))
        for mark in marks
    )
    fleet = Fleet(
        tuple(members),
        targets=unknown,
        sound_speed=SoundSpeedProfile.constant(SPEED_OF_SOUND),
        options=options,
        name=f"fleet of {vehicles}",
    )
    return fleet, truths


def _winding(rng: np.random.Generator, duration: float) -> Truth:
    """A track of constant speed whose turning rate changes from second to second."""
    t = np.arange(np.ceil(duration) + 2.0)
    speed = rng.uniform(1.0, 2.0)
    period, swing = rng.uniform(200.0, 600.0), rng.uniform(0.002, 0.008)
    rate = swing * np.sin(2.0 * np.pi * (t / period + rng.uniform()))
    yaw = rng.uniform(-np.pi, np.pi) + np.concatenate([[0.0], np.cumsum(rate[:-1])])
    chord = _chord(speed, rate, yaw, np.ones(len(t)))
    place = rng.uniform(-1000.0, 1000.0, 2) + np.concatenate(
        [np.zeros((1, 2)), np.cumsum(chord[:-1], axis=0)]
    )
    up = -rng.uniform(10.0, 50.0)

    def motion(times: FloatArray) -> tuple[FloatArray, FloatArray]:
        k = np.clip(times.astype(np.int64), 0, len(t) - 1)
        s = times - t[k]
        level = place[k] + _chord(speed, rate[k], yaw[k], s)
        angle = yaw[k] + rate[k] * s
        velocity = speed * np.stack([np.cos(angle), np.sin(angle), np.zeros(len(s))], axis=1)
        return np.column_stack([level, np.full(len(s), up)]), velocity

    def heading(times: FloatArray) -> FloatArray:
        k = np.clip(times.astype(np.int64), 0, len(t) - 1)
        return 0.5 * np.pi - (yaw[k] + rate[k] * (times - t[k]))

    return Truth((0.0, float(t[-1])), motion, heading)


def _chord(speed: float, rate: FloatArray, yaw: FloatArray, s: FloatArray) -> FloatArray:
    """Way over times s (M,) at a constant turning rate, east and north, (M, 2), m."""
    half = 0.5 * rate * s
    length = speed * s * np.sinc(half / np.pi)
    return length[:, None] * np.stack([np.cos(yaw + half), np.sin(yaw + half)], axis=1)


def _resting(place: FloatArray, duration: float) -> Truth:
    def motion(times: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.tile(place, (len(times), 1)), np.zeros((len(times), 3))

    return Truth((0.0, np.ceil(duration) + 1.0), motion, 0.0)


def _start(rng: np.random.Generator, truth: Truth, noise: float) -> Start:
    place = truth.position(0.0)[0]
    off = noise * START_SIGMA * rng.standard_normal(2)
    heading = float(truth.heading(0.0)[0] + noise * HEADING_SIGMA * rng.standard_normal())
    east, north = place[:2] + off
    around = float(np.remainder(heading, 2.0 * np.pi))
    return Start(0.0, east, north, place[2], START_SIGMA, around, HEADING_SIGMA)


def _odometry(rng: np.random.Generator, truth: Truth, duration: float, noise: float) -> Odometry:
    t = np.arange(np.ceil(duration) + 1.0)
    yaw = 0.5 * np.pi - truth.heading(t)
    way = np.diff(truth.position(t)[:, :2], axis=0)
    cos, sin = np.cos(yaw[:-1]), np.sin(yaw[:-1])
    forward, left = cos * way[:, 0] + sin * way[:, 1], cos * way[:, 1] - sin * way[:, 0]
    turn = np.diff(yaw)
    sigma = np.array(ODOMETRY_SIGMA)
    # The noise is one of the pose that a step leads to, in its axes.
    off = noise * sigma * rng.standard_normal((len(turn), 3))
    end_cos, end_sin = np.cos(turn), np.sin(turn)
    forward = forward + end_cos * off[:, 0] - end_sin * off[:, 1]
    left = left + end_sin * off[:, 0] + end_cos * off[:, 1]
    covariance = np.diag(sigma**2)
    return Odometry(
        t[:-1], t[1:], forward, -left, about_down=-(turn + off[:, 2]), covariance=covariance
    )


def _fixes(
    rng: np.random.Generator, truth: Truth, duration: float, every: float, noise: float
) -> PositionFix:
    t = np.arange(0.5 * every, duration, every)
    level = truth.position(t)[:, :2] + noise * FIX_SIGMA * rng.standard_normal((len(t), 2))
    return PositionFix(t, level[:, 0], level[:, 1], sigma=FIX_SIGMA)


def _ranges(
    rng: np.random.Generator,
    truths: Mapping[str, Truth],
    names: Sequence[str],
    marks: Sequence[str],
    duration: float,
    every: float,
    kind: RangeKind,
    clocks: Mapping[str, tuple[float, float]],
    noise: float,
) -> dict[str, SlantRange | TwoWayRange | OneWayRange]:
    """Ranges by who measures them."""
    rows: dict[str, list[tuple[str, float]]] = {name: [] for name in names}
    # The last ones must have come back before the mission ends.
    for t in np.arange(every, duration - 15.0, every):
        one = names[int(rng.integers(len(names)))]
        others = [name for name in (*names, *marks) if name != one]
        rows[one].append((others[int(rng.integers(len(others)))], t + rng.uniform(0.0, 1.0)))
    out: dict[str, SlantRange | TwoWayRange | OneWayRange] = {}
    for name, some in rows.items():
        if not some:
            continue
        made = [_range(truths[name], truths[peer], t, kind) for peer, t in some]
        peers = np.array([peer for peer, _ in some])
        t = np.array([t for _, t in some])
        off = noise * RANGE_SIGMA * rng.standard_normal(len(some))
        if kind == "slant_range":
            out[name] = SlantRange(t, peers, np.array([m[0] for m in made]) + off, RANGE_SIGMA)
        elif kind == "two_way_range":
            span = np.array([m[1] for m in made])
            whole = span + 2.0 * off / SPEED_OF_SOUND
            sigma = 2.0 * RANGE_SIGMA / SPEED_OF_SOUND
            out[name] = TwoWayRange(peers, t, t + np.maximum(span, whole), whole, sigma)
        else:
            heard = t + [m[2] for m in made] + off / SPEED_OF_SOUND
            sent = t + [sum(_clock(clocks, p, a)) for p, a in zip(peers, t, strict=True)]
            heard = heard + [sum(_clock(clocks, name, a)) for a in heard]
            out[name] = OneWayRange(peers, sent, heard, RANGE_SIGMA / SPEED_OF_SOUND)
    return out


def _clock(clocks: Mapping[str, tuple[float, float]], name: str, t: float) -> tuple[float, float]:
    """What a clock reads too much at a time, s: its offset's share and its drift's."""
    offset, drift = clocks.get(name, (0.0, 0.0))
    return offset, drift * t


def _range(here: Truth, there: Truth, t: float, kind: RangeKind) -> tuple[float, float, float]:
    """Distance at a time (m), time out and back, and time from there to here (s)."""

    def way(one: Truth, other: Truth, sent: float) -> float:
        tau = 0.0
        for _ in range(4):
            off = other.position(sent + tau)[0] - one.position(sent)[0]
            tau = float(np.linalg.norm(off)) / SPEED_OF_SOUND
        return tau

    if kind == "slant_range":
        return float(np.linalg.norm(here.position(t)[0] - there.position(t)[0])), 0.0, 0.0
    if kind == "one_way_range":
        return 0.0, 0.0, way(there, here, t)
    out = way(here, there, t)
    return 0.0, out + way(there, here, t + out), 0.0
