"""Cao 2017: one beacon, virtual beacons by dead reckoning, and a window of ranges to them.

Every ping's beacon is shifted by the way from there to the window's end, so that a window of ranges
is solved for one position, that of its last ping; `range_windows` has the solvers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from ubl_graph.arrays import ArrayLike, BoolArray, FloatArray
from ubl_graph.attitude import AttitudeTrack
from ubl_graph.baselines.fixes import Fixes
from ubl_graph.baselines.range_windows import (
    UNKNOWNS,
    Windows,
    WindowSolutions,
    gauss_newton,
    levenberg_marquardt,
    linear_difference,
)
from ubl_graph.errors import ConfigurationError, DataError, TimeError, UnobservableError
from ubl_graph.factors.odometry import Preintegration
from ubl_graph.mission import Mission, Reference, Segment, Start

Method = Literal["lm", "gauss_newton", "linear"]

#: Iterations where none are given: the paper's LM as its figures ask for it, Gauss-Newton to its
#: end.
ITERATIONS = {"lm": 3, "gauss_newton": 100, "linear": 1}
#: The same for the step that ends it, m.
TOLERANCES = {"lm": None, "gauss_newton": 1e-4, "linear": None}
#: Seeds may begin or end so much inside the fixes' times: stamps carry noise, s.
SLACK = 0.01


def cao2017(
    mission: Mission,
    starts: Mapping[str, Start] | None = None,
    *,
    method: Method = "lm",
    window: int = 10,
    max_iterations: int | None = None,
    tolerance: float | None = None,
    seeds: Mapping[str, Reference] | None = None,
) -> dict[str, Fixes]:
    """Position a vehicle by a window of ranges to virtual beacons, ping after ping.

    Parameters
    ----------
    mission : Mission
        Ranges (one-way ones by synchronised clocks; half of two-way ones, at the middle between
        transmit and receive time), velocities over the bottom, attitude and depth. A profile
        counts by its harmonic mean between vehicle and beacon.
    starts : mapping of str to Start, optional
        Where segments start, by segment name; goes before the mission's own start priors. The
        start, dead reckoned, is where the first window's solver begins; the others begin at the
        fix before them, dead reckoned.
    method : {"lm", "gauss_newton", "linear"}
        The paper's Levenberg-Marquardt (Table 1), Gauss-Newton (7), or the linear difference
        solution (5), which needs no start.
    window : int
        Pings in a window.
    max_iterations : int, optional
        Trials or steps; left out, 3 for "lm" and 100 for "gauss_newton".
    tolerance : float, optional
        Length of the step that ends it, m; left out, none for "lm" and 1e-4 for "gauss_newton".
    seeds : mapping of str to Reference, optional
        Tracks, by segment name, that every window's solver begins on, whatever the fix before. The
        truth, for one.

    Returns
    -------
    dict of str to Fixes
        By segment name, one fix a ping from the `window`-th on, at the ping's time. The height is
        that of the depth sensor. A window that spans a gap of the velocities has no solution.

    Raises
    ------
    DataError
        Where a segment has too few pings, no velocities over the bottom, or no depth.
    ConfigurationError
        Where an option makes no sense.
    UnobservableError
        Where a segment has neither start nor seeds, or where the linear solution meets nothing but
        straight tracks.
    TimeError
        Where seeds do not cover a segment's fixes.

    Examples
    --------
    >>> from ubl_graph.sim import cao_pass
    >>> mission, truth = cao_pass(north=1500.0, noise=0.0)
    >>> fixes = cao2017(mission)[""]
    >>> len(fixes), fixes.errors(mission.segments[0].reference)[-1].round(1).item()
    (592, 32.1)
    """
    if method not in ITERATIONS:
        raise ConfigurationError(f"'{method}' is not one of {', '.join(ITERATIONS)}")
    least = UNKNOWNS + (method == "linear")
    if type(window) is not int or window < least:
        raise ConfigurationError(
            f"windows of {window!r} pings for {UNKNOWNS} unknowns", f"give {least} or more"
        )
    most = ITERATIONS[method] if max_iterations is None else max_iterations
    least_step = TOLERANCES[method] if tolerance is None else tolerance
    chains = [_Chain.of(mission, segment, window) for segment in mission.segments]
    solver = _solver(method, most, least_step)
    if method == "linear":
        found = [solver(c.windows, np.empty(0)) for c in chains]
    elif seeds is not None:
        found = [solver(c.windows, _seeded(c, seeds)) for c in chains]
    else:
        starts = {} if starts is None else starts
        first = [
            chain.reckoned(starts.get(segment.name, segment.start))
            for chain, segment in zip(chains, mission.segments, strict=True)
        ]
        found = _chained(chains, np.array(first), solver)
    return {c.segment: c.fixes(solutions) for c, solutions in zip(chains, found, strict=True)}


def virtual_beacons(mission: Mission, segment: Segment, window: int) -> Windows:
    """Windows of a segment's ranges to virtual beacons, Cao 2017's equation (3).

    Parameters
    ----------
    mission : Mission
        Beacons, sound speed, lever arms.
    segment : Segment
        Ranges, velocities over the bottom, attitude, depth.
    window : int
        Pings in a window.

    Returns
    -------
    Windows
        One a ping from the `window`-th on.

    Raises
    ------
    DataError
        As `cao2017` does.
    """
    return _Chain.of(mission, segment, window).windows


def converged_position(
    east: ArrayLike,
    north: ArrayLike,
    *,
    forward: float = 0.0,
    right: float = 0.0,
    up: float = 0.0,
    speed: float = 1.0,
    height: float = 100.0,
    length: float = 90.0,
) -> FloatArray:
    """Where the converged window solution ends on an eastward track: a closed form.

    A velocity that is measured with an error bends the squared ranges that the virtual beacons
    predict along the window, |X - d t|^2 with the measured velocity d. Where the line through these
    and the line through the true ones, |P - v t|^2, agree is the solution: a circle about the
    beacon cut by a straight line across the track, at one point on either side. To first order

    - forward: north'^2 = north^2 + 2 error east^2, east' = east (1 - error), error being that of
      the velocity over the speed: off by error east^2 / north, hyperbolas
    - right: turned about the beacon by the error, clockwise seen from above: circles
    - up: north'^2 = north^2 - 2 error east height

    whatever the window's length and the pings' interval. No window gets past that but by ending
    its iterations early.

    Parameters
    ----------
    east, north : array, shape (M,)
        Of the vehicle from the beacon, m.
    forward, right, up : float
        Error of the measured velocity, m/s.
    speed : float
        m/s, towards east.
    height : float
        Of the beacon above the vehicle, m.
    length : float
        Of the window, s.

    Returns
    -------
    array, shape (M, 2)
        East and north, m; nan where the line misses the circle.

    Examples
    --------
    >>> converged_position([2000.0], [400.0], forward=0.005, length=0.0).round(1).tolist()
    [[1990.0, 446.9]]
    """
    east, north = np.asarray(east, dtype=np.float64), np.asarray(north, dtype=np.float64)
    along, across = 1.0 + forward / speed, -right / speed
    lengthened = speed * length * (along**2 + across**2 + (up / speed) ** 2 - 1.0)
    cut = east + height * up / speed + lengthened / 2.0
    squared = east**2 + north**2 + speed * length * lengthened / 6.0
    unit = np.hypot(along, across)
    half = squared - (cut / unit) ** 2
    half = np.sqrt(np.where(half >= 0.0, half, np.nan)) * np.where(north < 0.0, -1.0, 1.0)
    foot = cut / unit**2
    return np.stack(
        [foot * along - half * across / unit, foot * across + half * along / unit], axis=-1
    )


@dataclass(frozen=True, eq=False)
class _Chain:
    """A segment's windows, and what joins them."""

    segment: str
    where: str
    t: FloatArray
    windows: Windows
    covered: BoolArray
    samples: Preintegration
    lever: Callable[[FloatArray], FloatArray]

    @classmethod
    def of(cls, mission: Mission, segment: Segment, window: int) -> _Chain:
        where = f"segment '{segment.name}'" if segment.name else "the mission"
        rows = segment.velocity
        rows = None if rows is None else rows[rows.reference == "bottom"]
        if rows is None or len(rows) < 2:
            raise DataError(
                f"{where} has no velocities over the bottom",
                "virtual beacons need a DVL's bottom track",
            )
        if segment.depth is None or not len(segment.depth):
            raise DataError(f"{where} has no depth", "the window solves for east and north alone")
        attitude = AttitudeTrack(segment.attitude)
        # Only displacements are asked for; their noise, and so the density, plays no part.
        samples = Preintegration(rows, attitude, 0.0)
        t, travel, beacon = _pings(mission, segment)
        if len(t) < window:
            raise DataError(
                f"{where} has {len(t)} pings for windows of {window}", "give shorter windows"
            )
        depth = segment.depth[np.argsort(segment.depth.t)]
        up = -np.interp(t, depth.t, depth.depth)
        up = up - attitude.lever(mission.vehicle.depth_sensor, t)[:, 2]
        arm = attitude.lever(mission.vehicle.transducer, t)
        speed = mission.sound_speed.harmonic_mean(-(up + arm[:, 2]), -beacon[:, 2])

        def lever(times: FloatArray) -> FloatArray:
            return attitude.lever(mission.vehicle.dvl, times)

        way = samples.between(np.full(len(t), t[0]), t).displacement - lever(t)
        # Of window w the pings w to w + n - 1: the beacon moves with the vehicle to its end.
        pings = np.arange(len(t) - window + 1)[:, None] + np.arange(window)
        ends = pings[:, -1]
        shift = way[ends][:, None, :] - way[pings]
        windows = Windows(beacon[pings] + shift - arm[pings], (travel * speed)[pings], up[ends])
        covered = samples.between(t[pings[:, 0]], t[ends]).covered
        return cls(segment.name, where, t[ends], windows, covered, samples, lever)

    def moved(self, begin: FloatArray, end: FloatArray) -> FloatArray:
        """Way of the reference point between times (M,), s, by the DVL: (M, 2), m."""
        way = self.samples.between(begin, end).displacement - self.lever(end) + self.lever(begin)
        return way[:, :UNKNOWNS]

    def reckoned(self, start: Start | None) -> FloatArray:
        """Where the start, dead reckoned, puts the first fix: east and north, m."""
        if start is None:
            raise UnobservableError(
                f"{self.where} has no start; the first window has to begin somewhere"
            )
        begin = np.array([start.t])
        first, last = np.minimum(begin, self.t[:1]), np.maximum(begin, self.t[:1])
        if not self.samples.between(first, last).covered.all():
            raise DataError(
                f"{self.where}: the DVL does not cover the time from the start at {start.t:g} s to "
                f"the first fix at {self.t[0]:g} s",
                "give a start while the DVL is heard, or positions to begin at (seeds)",
            )
        way = self.moved(begin, self.t[:1])[0]
        return np.array([start.east, start.north]) + way

    def fixes(self, found: WindowSolutions) -> Fixes:
        solved = found.solved & self.covered
        position = np.column_stack([found.position, self.windows.up])
        position[~solved] = np.nan
        return Fixes(self.t, position, solved, found.iterations)


_Solver = Callable[[Windows, FloatArray], WindowSolutions]


def _solver(method: Method, most: int, tolerance: float | None) -> _Solver:
    def solve(windows: Windows, begin: FloatArray) -> WindowSolutions:
        if method == "linear":
            return linear_difference(windows)
        if method == "lm":
            return levenberg_marquardt(windows, begin, max_iterations=most, tolerance=tolerance)
        step = 1e-4 if tolerance is None else tolerance
        return gauss_newton(windows, begin, max_iterations=most, tolerance=step)

    return solve


def _chained(chains: Sequence[_Chain], first: FloatArray, solver: _Solver) -> list[WindowSolutions]:
    """Solve windows one after the other, each from the fix before; all segments in step.

    Where a window has no solution, the next one begins where this one did, dead reckoned.
    """
    counts = np.array([len(c.t) for c in chains])
    offset = np.concatenate([[0], np.cumsum(counts)])
    windows = Windows.joined([c.windows for c in chains])
    covered = np.concatenate([c.covered for c in chains])
    steps = np.concatenate(
        [np.concatenate([np.zeros((1, UNKNOWNS)), c.moved(c.t[:-1], c.t[1:])]) for c in chains]
    )
    position = np.full((len(windows), UNKNOWNS), np.nan)
    solved = np.zeros(len(windows), dtype=np.bool_)
    iterations = np.zeros(len(windows), dtype=np.int64)
    begin = first.copy()
    for k in range(int(counts.max())):
        going = np.flatnonzero(counts > k)
        rows = offset[going] + k
        begin[going] += steps[rows]
        found = solver(windows[rows], begin[going])
        position[rows], solved[rows] = found.position, found.solved
        iterations[rows] = found.iterations
        good = found.solved & covered[rows]
        begin[going[good]] = found.position[good]
    return [
        WindowSolutions(position[a:b], solved[a:b], iterations[a:b]) for a, b in pairwise(offset)
    ]


def _seeded(chain: _Chain, seeds: Mapping[str, Reference]) -> FloatArray:
    """Where each window's solver begins, (W, 2), m, on the given track."""
    seed = seeds.get(chain.segment)
    if seed is None:
        raise UnobservableError(f"{chain.where} has no seeds; its windows have to begin somewhere")
    if not len(seed.t) or chain.t[0] < seed.t[0] - SLACK or chain.t[-1] > seed.t[-1] + SLACK:
        raise TimeError(
            f"{chain.where} has fixes from {chain.t[0]} to {chain.t[-1]} s, which its seeds do not "
            "cover"
        )
    return np.stack([np.interp(chain.t, seed.t, seed.position[:, axis]) for axis in (0, 1)], axis=1)


def _pings(mission: Mission, segment: Segment) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times (M,), one-way travel times (M,), s, and beacons (M, 3), m, in order of time."""
    parts: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    sites = np.array([b.position for b in mission.beacons]).reshape(-1, 3)
    for rows, share in ((segment.one_way_range, 1.0), (segment.two_way_range, 0.5)):
        if rows is not None and len(rows):
            sent = rows.t_receive if share == 1.0 else rows.t_transmit
            beacon = sites[mission.beacon_numbers(rows.beacon)]
            parts.append((0.5 * (sent + rows.t_receive), share * rows.travel_time, beacon))
    if not parts:
        return np.empty(0), np.empty(0), np.empty((0, 3))
    t, travel, beacon = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(t, kind="stable")
    return t[order], travel[order], beacon[order]
