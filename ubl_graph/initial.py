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
from ubl_graph.builder import FREE_POSITION, SegmentModel
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
#: Speeds (m/s) and accelerations (m/s^2) are searched around zero within these.
WINDOW_SPEED, WINDOW_ACCELERATION = 10.0, 1.0
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
    runner_up : float or None
        How much dearer the next best answer was, where the search compares whole tracks.
    """

    tracks: tuple[Track, ...]
    start_sigmas: float | None
    runner_up: float | None = None


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
    spans = _windows(mission, reckoning)
    windows = [_fit_window(mission, segment, reckoning, span) for span in spans]
    own = [window.cost for window in windows]
    steps = [
        _step_cost(mission, a, b, pair)
        for (a, b), pair in zip(pairwise(windows), pairwise(spans), strict=True)
    ]
    ways = _cheapest_ways(own, steps)
    tracks = [_track(model, reckoning, windows, way, cost) for way, cost in ways]
    sigmas = None
    at = _start_window(windows, segment)
    if at is not None and segment.start is not None:
        sigmas = float(
            _start_sigmas(windows[at], spans[at], reckoning, segment.start)[ways[0][0][at]]
        )
    return Starts(tuple(_apart(tracks)), sigmas)


@dataclass(frozen=True)
class _Window:
    """Span of a window, s, and whether odometry covers it."""

    begin: float
    end: float
    reckoned: bool


def _windows(mission: Mission, reckoning: DeadReckoning) -> list[_Window]:
    """Windows as long as asked, longer where ranges are few, never across an end of odometry."""
    s = reckoning.sightings
    times = np.sort(np.concatenate([s.t[:, 0], s.fix_t]))
    breaks = reckoning.breaks()
    ends = np.append(np.searchsorted(times, breaks[(breaks > times[0])]), len(times))
    length = mission.options.start_window
    windows: list[_Window] = []
    first = 0
    while first < len(times):
        stop = int(ends[ends > first].min())
        reckoned = reckoning.covers(float(times[first]), float(times[stop - 1]))
        span = ODOMETRY_WINDOWS * length if reckoned else length
        last = int(np.searchsorted(times, times[first] + span, side="right"))
        last = min(max(last, first + FEWEST_RANGES), stop)
        if stop - last < FEWEST_RANGES:
            last = stop
        windows.append(_Window(float(times[first]), float(times[last - 1]), reckoned))
        first = last
    return windows


def _fit_window(
    mission: Mission, segment: Segment, reckoning: DeadReckoning, window: _Window
) -> Hypotheses:
    s = reckoning.sightings
    begin, end = window.begin, window.end
    rows = (s.t[:, 0] >= begin) & (s.t[:, 0] <= end)
    fixes = (s.fix_t >= begin) & (s.fix_t <= end)
    for chosen in (rows, fixes):
        many = np.flatnonzero(chosen)
        if len(many) > WINDOW_RANGES:
            keep = many[np.linspace(0, len(many) - 1, WINDOW_RANGES).astype(int)]
            chosen[:] = False
            chosen[keep] = True
    middle = 0.5 * (begin + end)
    prior = _window_prior(mission, segment, reckoning, window.reckoned)
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
        _model_sigma(mission, reckoning, window),
        extra,
    )


def _window_prior(
    mission: Mission, segment: Segment, reckoning: DeadReckoning, reckoned: bool
) -> Prior:
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
    if reckoned:
        water = reckoning.odometry is not reckoning.model.bottom
        speed = np.hypot(ODOMETRY_SPEED, options.current_sigma if water else 0.0)
    sigma[3:5] = speed
    # Only the constant-acceleration prior lets a window bend; odometry knows the bends already.
    bends = order_of(options) == 3 and not reckoned
    sigma[ACCELERATION] = WINDOW_ACCELERATION if bends else 1e-9
    if reckoning.depth is not None:
        sigma[8] = 1e-9
    sigma[SCALE] = mission.sound_speed_sigma + 1e-6 if options.estimate_sound_speed else 1e-6
    sigma[CLOCK] = options.clock_offset_sigma + 1e-9
    return Prior(mean, sigma)


def _model_sigma(mission: Mission, reckoning: DeadReckoning, window: _Window) -> float:
    """What the true motion may deviate from the window's model by, m."""
    span = window.end - window.begin
    if not window.reckoned:
        # What the motion prior does between the window's ends.
        order = order_of(mission.options)
        variance = interpolation_variance(order, np.array(span), np.array(0.5))
        return float(np.sqrt(mission.options.horizontal_psd * variance)) + 0.1
    places = reckoning.offset(np.linspace(window.begin, window.end, 20))[:, :2]
    way = np.linalg.norm(np.diff(places, axis=0), axis=1)
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
    mission: Mission, a: Hypotheses, b: Hypotheses, spans: tuple[_Window, _Window]
) -> FloatArray:
    """Price of going from each answer of one window to each of the next, (H_a, H_b).

    Half the squared Mahalanobis distance of the two answers' states, both carried to where one
    window ends and the next begins.
    """
    meeting = 0.5 * (spans[0].end + spans[1].begin)
    wander = np.zeros((PARAMETERS, PARAMETERS))
    carried: list[tuple[FloatArray, FloatArray]] = []
    for window, span in zip((a, b), spans, strict=True):
        carried.append(_carried(window, meeting - window.t))
        wander += _wander(mission, abs(meeting - window.t), span.reckoned)
    if spans[0].reckoned != spans[1].reckoned:
        # On one side the velocity is the vehicle's, on the other the odometry's error.
        wander[VELOCITY, VELOCITY] += WINDOW_SPEED**2 * np.eye(3)
        wander[ACCELERATION, ACCELERATION] += WINDOW_ACCELERATION**2 * np.eye(3)
    gap = carried[0][0][:, None, :] - carried[1][0][None, :, :]
    spread = carried[0][1][:, None] + carried[1][1][None, :] + wander
    return 0.5 * np.einsum("abi,abi->ab", gap, np.linalg.solve(spread, gap[..., None])[..., 0])


def _wander(mission: Mission, dt: float, reckoned: bool) -> FloatArray:
    """What a window's model may have strayed from the truth after `dt` seconds, (11, 11)."""
    if reckoned:
        noise = np.diag([ODOMETRY_SLACK**2 + (ODOMETRY_SPEED * dt) ** 2, ODOMETRY_SPEED**2])
    else:
        order = order_of(mission.options)
        noise = mission.options.horizontal_psd * process_noise(order, dt + 1e-3)[0]
    wander = np.zeros((PARAMETERS, PARAMETERS))
    for axis in range(3):
        states = axis + 3 * np.arange(len(noise))
        wander[np.ix_(states, states)] = noise
    wander[SCALE, SCALE] = (1e-4) ** 2
    wander[CLOCK, CLOCK] = (1e-4 + min(mission.options.clock_drift_sigma, 1e-5) * dt) ** 2
    return wander


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


def _start_sigmas(
    window: Hypotheses, span: _Window, reckoning: DeadReckoning, start: Start
) -> FloatArray:
    """Mahalanobis distance of each of a window's answers from the start prior, (H,)."""
    dt = start.t - window.t
    parameters, covariance = _carried(window, dt)
    position = parameters[:, :2] + reckoning.offset(np.array([start.t]))[0, :2]
    wander = _wander(reckoning.mission, abs(dt), span.reckoned)[0, 0]
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
