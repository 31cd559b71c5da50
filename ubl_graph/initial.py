"""A start for the solver, found from the data alone.

Each window of a segment is fitted from starts all around (`ubl_graph.windows`) and keeps its
distinct answers. The cheapest way through the windows, from answer to answer, with the price of
what the vehicle would have to do in between, is the start: one window that chose the mirror
image is outvoted by its neighbours. The cheapest way that ends elsewhere is kept as the
runner-up: where its cost is no higher the data do not say which is true.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from ubl_graph.arrays import FloatArray
from ubl_graph.graph import FREE_ACCELERATION, FREE_POSITION, SegmentModel
from ubl_graph.mission import Mission, Segment, Start
from ubl_graph.nodes import order_of
from ubl_graph.reckoning import DeadReckoning
from ubl_graph.track import Track
from ubl_graph.trajectory import interpolation_variance, process_noise
from ubl_graph.windows import (
    ACCELERATION,
    CLOCK,
    EAST_NORTH_UP,
    PARAMETERS,
    SCALE,
    VELOCITY,
    Hypotheses,
    Prior,
    fit,
)

#: Ranges of a window that are looked at; more are thinned out evenly.
WINDOW_RANGES = 24
#: Ranges that a window should hold before it is worth fitting; it is made longer until it does.
FEWEST_RANGES = 6
#: Speeds are searched around zero within this, m/s.
WINDOW_SPEED = 10.0
#: With odometry the shape of the track is known, so a window may be so many times longer.
ODOMETRY_WINDOWS = 5.0
#: What dead reckoning may be off by, as a share of the way and at the least, m.
ODOMETRY_SHARE, ODOMETRY_SLACK = 0.01, 0.5
#: Velocity error of dead reckoning over the bottom, m/s.
ODOMETRY_SPEED = 0.05
#: Two tracks whose root-mean-square distance is less than this are one, m.
SAME_TRACK = 20.0
#: A track apart from the best is tried where its cost is higher by less than this,
WORTH_TRYING = 30.0
#: and so many tracks at the most.
MOST_TRACKS = 3
#: A start prior so many sigmas from every answer of the data is not believed.
START_LIMIT = 6.0


@dataclass(frozen=True, eq=False)
class Starts:
    """What the search found.

    Attributes
    ----------
    tracks : tuple of Track
        Best first; more than one where tracks apart from each other fit comparably.
    start_sigmas : float or None
        How many sigmas the start prior lies from the best track; None without such a prior.
    """

    tracks: tuple[Track, ...]
    start_sigmas: float | None


def find_starts(mission: Mission, model: SegmentModel) -> Starts:
    """Search a segment's start.

    Parameters
    ----------
    mission : Mission
        Beacons, sound speed, options.
    model : SegmentModel
        The segment.

    Returns
    -------
    Starts
    """
    reckoning = DeadReckoning(mission, model)
    segment = model.segment
    windows = [_fit_window(mission, segment, reckoning, *w) for w in _windows(mission, reckoning)]
    own = [window.cost for window in windows]
    steps = [_step_cost(mission, a, b, reckoning) for a, b in pairwise(windows)]
    ways = _cheapest_ways(own, steps)
    tracks = [_track(model, reckoning, windows, way, cost) for way, cost in ways]
    sigmas = None
    at = _start_window(windows, segment)
    if at is not None and segment.start is not None:
        sigmas = float(_start_sigmas(windows[at], reckoning, segment.start)[ways[0][0][at]])
    return Starts(tuple(_apart(tracks)), sigmas)


def _windows(mission: Mission, reckoning: DeadReckoning) -> list[tuple[float, float]]:
    """Spans of the windows: as long as asked, longer where ranges are few."""
    s = reckoning.sightings
    times = np.sort(np.concatenate([s.t[:, 0], s.fix_t]))
    length = mission.options.start_window
    if reckoning.odometry is not None:
        length *= ODOMETRY_WINDOWS
    spans: list[tuple[float, float]] = []
    first = 0
    while first < len(times):
        last = int(np.searchsorted(times, times[first] + length, side="right"))
        last = min(max(last, first + FEWEST_RANGES), len(times))
        if len(times) - last < FEWEST_RANGES:
            last = len(times)
        spans.append((float(times[first]), float(times[last - 1])))
        first = last
    return spans


def _fit_window(
    mission: Mission, segment: Segment, reckoning: DeadReckoning, begin: float, end: float
) -> Hypotheses:
    s = reckoning.sightings
    rows = (s.t[:, 0] >= begin) & (s.t[:, 0] <= end)
    fixes = (s.fix_t >= begin) & (s.fix_t <= end)
    for chosen in (rows, fixes):
        many = np.flatnonzero(chosen)
        if len(many) > WINDOW_RANGES:
            keep = many[np.linspace(0, len(many) - 1, WINDOW_RANGES).astype(int)]
            chosen[:] = False
            chosen[keep] = True
    middle = 0.5 * (begin + end)
    prior = _window_prior(mission, segment, reckoning)
    extra = None
    if segment.start is not None:
        extra = prior.mean[None].copy()
        reckoned = reckoning.offset(np.array([segment.start.t]))[0]
        extra[0, :2] = np.array([segment.start.east, segment.start.north]) - reckoned[:2]
    return fit(
        mission.sound_speed,
        s.select(rows, fixes),
        middle,
        prior,
        _model_sigma(mission, reckoning, begin, end),
        extra,
    )


def _window_prior(mission: Mission, segment: Segment, reckoning: DeadReckoning) -> Prior:
    options = mission.options
    mean, sigma = np.zeros(PARAMETERS), np.empty(PARAMETERS)
    if mission.beacons:
        mean[:2] = np.mean([b.position[:2] for b in mission.beacons], axis=0)
    sigma[:2] = FREE_POSITION
    if reckoning.depth is not None:
        sigma[2], sigma[5] = 1.0, 1e-3
    else:
        if segment.start is not None and segment.start.up is not None:
            mean[2], sigma[2] = segment.start.up, 90.0
        else:
            sigma[2] = FREE_POSITION
        sigma[5] = 0.5
    speed = min(options.speed_sigma, WINDOW_SPEED)
    if reckoning.odometry is not None:
        water = reckoning.odometry is not reckoning.model.bottom
        speed = np.hypot(ODOMETRY_SPEED, options.current_sigma if water else 0.0)
    sigma[3:5] = speed
    # Only the constant-acceleration prior lets a window bend; odometry knows the bends already.
    bends = order_of(options) == 3 and reckoning.odometry is None
    sigma[ACCELERATION] = FREE_ACCELERATION if bends else 1e-9
    if reckoning.depth is not None:
        sigma[8] = 1e-9
    sigma[SCALE] = mission.sound_speed_sigma + 1e-6 if options.estimate_sound_speed else 1e-6
    sigma[CLOCK] = options.clock_offset_sigma + 1e-9
    return Prior(mean, sigma)


def _model_sigma(mission: Mission, reckoning: DeadReckoning, begin: float, end: float) -> float:
    """What the true motion may deviate from the window's model by, m."""
    span = end - begin
    if reckoning.odometry is None:
        # What the motion prior does between the window's ends.
        order = order_of(mission.options)
        variance = interpolation_variance(order, np.array(span), np.array(0.5))
        return float(np.sqrt(mission.options.horizontal_psd * variance)) + 0.1
    way = np.linalg.norm(
        np.diff(reckoning.offset(np.linspace(begin, end, 20))[:, :2], axis=0), axis=1
    )
    return ODOMETRY_SLACK + ODOMETRY_SHARE * float(way.sum())


def _cheapest_ways(own: list[FloatArray], steps: list[FloatArray]) -> list[tuple[list[int], float]]:
    """Cheapest way through the windows for each answer of the last and of the first window.

    Parameters
    ----------
    own : list of array (H_i,)
        Cost of each window's answers.
    steps : list of array (H_i, H_i+1)
        Cost of going from answer to answer.

    Returns
    -------
    list of (answer's number per window, cost), cheapest first
    """
    forward, backward = _viterbi(own, steps), _viterbi(own[::-1], [s.T for s in steps[::-1]])
    ways = forward + [(way[::-1], cost) for way, cost in backward]
    return sorted(ways, key=lambda w: w[1])


def _viterbi(own: list[FloatArray], steps: list[FloatArray]) -> list[tuple[list[int], float]]:
    """For each answer of the last window the cheapest way there."""
    total, back = own[0], []
    for cost, step in zip(own[1:], steps, strict=True):
        choices = total[:, None] + step
        back.append(choices.argmin(axis=0))
        total = choices.min(axis=0) + cost
    ways: list[tuple[list[int], float]] = []
    for end in range(len(total)):
        way = [end]
        for came_from in reversed(back):
            way.append(int(came_from[way[-1]]))
        ways.append((way[::-1], float(total[end])))
    return ways


def _step_cost(
    mission: Mission, a: Hypotheses, b: Hypotheses, reckoning: DeadReckoning
) -> FloatArray:
    """Price of going from each answer of one window to each of the next, (H_a, H_b).

    Half the squared Mahalanobis distance of the two answers' states, both carried to the time
    half way between the windows' middles.
    """
    half = 0.5 * (b.t - a.t)
    carried = [_carried(a, half), _carried(b, -half)]
    gap = carried[0][0][:, None, :] - carried[1][0][None, :, :]
    wander = np.zeros((PARAMETERS, PARAMETERS))
    if reckoning.odometry is None:
        order = order_of(mission.options)
        noise = 2.0 * mission.options.horizontal_psd * process_noise(order, half)[0]
    else:
        noise = np.diag([ODOMETRY_SLACK**2 + (ODOMETRY_SPEED * half) ** 2, ODOMETRY_SPEED**2])
    for axis in range(3):
        states = axis + 3 * np.arange(len(noise))
        wander[np.ix_(states, states)] = noise
    wander[SCALE, SCALE] = (1e-4) ** 2
    wander[CLOCK, CLOCK] = (1e-4 + mission.options.clock_drift_sigma * half) ** 2
    spread = carried[0][1][:, None] + carried[1][1][None, :] + wander
    return 0.5 * np.einsum("abi,abi->ab", gap, np.linalg.solve(spread, gap[..., None])[..., 0])


def _carried(window: Hypotheses, dt: float) -> tuple[FloatArray, FloatArray]:
    """Parameters and covariance of a window's answers `dt` seconds from its middle."""
    f = np.eye(PARAMETERS)
    f[EAST_NORTH_UP, VELOCITY] = f[VELOCITY, ACCELERATION] = dt * np.eye(3)
    f[EAST_NORTH_UP, ACCELERATION] = 0.5 * dt**2 * np.eye(3)
    return window.parameters @ f.T, f @ window.covariance @ f.T


def _start_window(windows: list[Hypotheses], segment: Segment) -> int | None:
    """Number of the window whose middle is nearest to the start prior's time."""
    if segment.start is None:
        return None
    return int(np.argmin([abs(w.t - segment.start.t) for w in windows]))


def _start_sigmas(window: Hypotheses, reckoning: DeadReckoning, start: Start) -> FloatArray:
    """Mahalanobis distance of each of a window's answers from the start prior, (H,)."""
    dt = start.t - window.t
    parameters, covariance = _carried(window, dt)
    position = parameters[:, :2] + reckoning.offset(np.array([start.t]))[0, :2]
    if reckoning.odometry is None:
        options = reckoning.mission.options
        wander = options.horizontal_psd * process_noise(order_of(options), abs(dt) + 1e-9)[0, 0, 0]
    else:
        wander = (ODOMETRY_SPEED * dt) ** 2
    gap = position - [start.east, start.north]
    spread = covariance[:, :2, :2] + (start.sigma**2 + wander) * np.eye(2)
    return np.sqrt(np.einsum("hi,hi->h", gap, np.linalg.solve(spread, gap[..., None])[..., 0]))


def _track(
    model: SegmentModel,
    reckoning: DeadReckoning,
    windows: list[Hypotheses],
    way: list[int],
    cost: float,
) -> Track:
    """Node states along a way: a Hermite spline through the windows' middles, plus odometry."""
    middles = np.array([w.t for w in windows])
    chosen = np.stack([w.parameters[i] for w, i in zip(windows, way, strict=True)])
    offset = reckoning.offset(model.t)
    inner = np.clip(model.t, middles[0], middles[-1])
    beyond = (model.t - inner)[:, None]
    bend = np.stack([np.interp(inner, middles, a) for a in chosen[:, ACCELERATION].T], axis=1)
    if len(windows) == 1:
        position, velocity = chosen[0, EAST_NORTH_UP], chosen[0, VELOCITY]
    else:
        spline = CubicHermiteSpline(middles, chosen[:, EAST_NORTH_UP], chosen[:, VELOCITY])
        position, velocity = spline(inner), spline(inner, 1)
    position = position + velocity * beyond + 0.5 * bend * beyond**2 + offset
    velocity = velocity + bend * beyond
    if len(model.t) > 1:
        velocity = velocity + np.gradient(offset, model.t, axis=0)
    return Track(
        position,
        velocity,
        bend,
        np.interp(model.t, middles, chosen[:, SCALE]),
        np.interp(model.t, middles, chosen[:, CLOCK]),
        cost,
    )


def _apart(tracks: list[Track]) -> list[Track]:
    """The best track, and those that are elsewhere and cost little more."""
    kept = [tracks[0]]
    for track in tracks[1:]:
        distances = [
            np.sqrt(np.mean(np.sum((track.position - k.position) ** 2, axis=1))) for k in kept
        ]
        if min(distances) > SAME_TRACK and track.cost < tracks[0].cost + WORTH_TRYING:
            kept.append(track)
        if len(kept) == MOST_TRACKS:
            break
    return kept
