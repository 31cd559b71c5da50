"""Where the nodes of a segment stand in time."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ubl_graph.arrays import BoolArray, FloatArray
from ubl_graph.errors import DataError
from ubl_graph.factors.odometry import Preintegration
from ubl_graph.mission import Segment
from ubl_graph.options import Options
from ubl_graph.trajectory import Order, longest_interval, process_noise

#: Speed that turns a travel time's sigma into metres for the spacing rule, m/s.
NOMINAL_SPEED = 1500.0
#: Nodes are left out only where the interpolation's sd stays under this share of the range
#: sigma: that error is shared by the legs of a ping and by pings close in time, so it must be
#: well below what a single ping may have.
INTERPOLATION_SHARE = 0.1
#: Without any measurement to ask for a node there is one at least every so many seconds, or at the
#: distance up to which the prior is as good as known.
LONGEST_GAP = 10.0
#: Stamps of one instant may differ by rounding: times nearer than this are one, s.
SAME_INSTANT = 1e-6
#: Nodes stay apart by this share of the interval that the interpolation may span, by the prior's
#: order. Nearer ones help nobody, and they know each other's place so much better than the data do
#: (1e5 to 1e6 times at this distance, growing with its third or fifth power) that the normal
#: equations lose the absolute place in rounding.
LEAST_SHARE: dict[Order, float] = {2: 0.03, 3: 0.1}


#: What the motion noise moves a vehicle by between two nodes of a regular grid, at the least, m.
LEAST_MOVE = 1e-6
#: Spacings of regular grids, s: coarser ones would let a vehicle turn between two nodes.
ROUND_SPACINGS = (0.1, 0.2, 0.25, 0.5, 1.0)


def order_of(options: Options) -> Order:
    """Order of the motion prior that the options ask for."""
    return 2 if options.is_constant_velocity else 3


def node_times(
    segment: Segment, options: Options, odometry: tuple[Preintegration, ...] = ()
) -> FloatArray:
    """Node times of a segment, strictly increasing, s.

    A node stands at every transmit and receive time, at the start prior, where odometry begins
    and ends, and at the ends of the span of ranges, fixes and velocities; times so close that
    the motion prior bridges them well under the range noise share nodes, no two nodes are so close
    that double precision cannot tell them from one, and long gaps are filled.

    Raises
    ------
    DataError
        Where the span is longer than a year: times of different epochs.
    """
    wanted, kept, sigmas = _candidates(segment, odometry)
    _check_span(wanted)
    psd = max(options.horizontal_psd, options.vertical_psd)
    order = order_of(options)
    spacing = longest_interval(order, psd, INTERPOLATION_SHARE * min(sigmas))
    stay = np.zeros(len(wanted), dtype=np.bool_)
    after = np.searchsorted(wanted, kept).clip(1, max(len(wanted) - 1, 1))
    before = after - 1
    if len(wanted) > 1:
        nearer = kept - wanted[before] < wanted[after] - kept
        stay[np.where(nearer, before, after)] = True
    least = LEAST_SHARE[order] * spacing
    # Odometry interpolates nothing: between its nodes the vehicle may do as it likes.
    longest = LONGEST_GAP if odometry else max(LONGEST_GAP, _longest_gap(options, segment))
    return filled(_thinned(wanted, stay, min(spacing, longest), least), longest)


def grid_times(
    segment: Segment, spacing: float, odometry: tuple[Preintegration, ...] = ()
) -> FloatArray:
    """Node times at multiples of `spacing` (s) that span a segment's data, strictly increasing.

    The last one lies behind the data, so that every instant with data has a node on either side.

    Raises
    ------
    DataError
        As `node_times` does.
    """
    wanted, _, _ = _candidates(segment, odometry)
    _check_span(wanted)
    first = slot_of(wanted[0], spacing)
    return grid(first, slot_of(wanted[-1], spacing) + 2 - first, spacing)


def grid(first: int, count: int, spacing: float) -> FloatArray:
    """Times of `count` nodes of a regular grid from number `first` on, s."""
    return np.arange(first, first + count, dtype=np.float64) * spacing


def slot_of(t: float, spacing: float) -> int:
    """Number of the grid's interval that holds a time, its beginning included (to a nanosecond)."""
    return math.floor((t + 1e-9) / spacing)


def grid_spacing(options: Options) -> float:
    """Spacing of a regular grid of nodes, s: as asked for, or what the noise allows, rounded down.

    The interpolation error between nodes stays under `INTERPOLATION_SHARE` of the travel times'
    noise; a round number puts whole seconds on nodes.
    """
    if options.node_spacing is not None:
        return options.node_spacing
    sigma = INTERPOLATION_SHARE * options.number("travel_time_sigma") * NOMINAL_SPEED / 2.0
    longest = longest_interval(order_of(options), options.horizontal_psd, sigma)
    return max((s for s in ROUND_SPACINGS if s <= longest), default=ROUND_SPACINGS[0])


def grid_options(options: Options) -> Options:
    """Options with the motion noise that a regular grid needs, and no less.

    Neighbouring nodes that know each other's place to less than `LEAST_MOVE` leave double precision
    no digits for where both are. Over a lag of 80 s with a node a second it lets the vehicle move
    by 1 mm (WNOA) or 6 cm (WNOJ).
    """
    order = order_of(options)
    least = LEAST_MOVE**2 / float(process_noise(order, grid_spacing(options))[0, 0, 0])
    name = ("acceleration_psd", "jerk_psd")[order - 2]
    horizontal, vertical = options.horizontal_psd, options.vertical_psd
    if min(horizontal, vertical) >= least:
        return options
    psd = {name: max(horizontal, least), f"vertical_{name}": max(vertical, least)}
    return replace(options, **psd)


def _check_span(times: FloatArray) -> None:
    span = times[-1] - times[0]
    if span > 366 * 86400.0:
        raise DataError(
            f"the data span {span:g} s, more than a year",
            "are all times of one segment in the same epoch?",
        )


def _candidates(
    segment: Segment, odometry: tuple[Preintegration, ...]
) -> tuple[FloatArray, FloatArray, list[float]]:
    """Sorted candidate times, those that must stay, and the range sigmas in metres."""
    wanted: list[FloatArray] = [p.breaks() for p in odometry]
    kept: list[FloatArray] = list(wanted)
    sigmas: list[float] = []
    if segment.two_way_range is not None and len(segment.two_way_range):
        wanted += [segment.two_way_range.t_transmit, segment.two_way_range.t_receive]
        sigmas.append(float(segment.two_way_range.sigma.min()) * NOMINAL_SPEED / 2.0)
    if segment.one_way_range is not None and len(segment.one_way_range):
        wanted.append(segment.one_way_range.t_receive)
        sigmas.append(float(segment.one_way_range.sigma.min()) * NOMINAL_SPEED)
    if segment.slant_range is not None and len(segment.slant_range):
        wanted.append(segment.slant_range.t)
        sigmas.append(float(segment.slant_range.sigma.min()))
    if segment.position is not None and len(segment.position):
        ends = np.array([segment.position.t.min(), segment.position.t.max()])
        wanted.append(ends)
        sigmas.append(float(np.sqrt(segment.position.covariances[:, 0, 0].min())))
    if segment.start is not None:
        wanted.append(np.array([segment.start.t]))
    times = np.unique(np.concatenate(wanted))
    times = times[np.concatenate([[True], np.diff(times) > SAME_INSTANT])]
    return times, np.concatenate(kept) if kept else np.empty(0), sigmas


def _thinned(times: FloatArray, must_stay: BoolArray, spacing: float, least: float) -> FloatArray:
    """Leave out times whose neighbours are within `spacing` of each other, and any within `least`.

    The ends stay in any case; of two times within `least` the one that must stay does, else the
    earlier one.
    """
    if len(times) < 3 or np.diff(times).min() > spacing:
        return times
    chosen, fixed = [times[0]], [True]
    for i in range(1, len(times) - 1):
        t = times[i]
        if not must_stay[i] and times[i + 1] - chosen[-1] <= spacing:
            continue
        if t - chosen[-1] < least and must_stay[i] and not fixed[-1]:
            chosen[-1], fixed[-1] = t, True
        elif t - chosen[-1] >= least:
            chosen.append(t)
            fixed.append(bool(must_stay[i]))
    if times[-1] - chosen[-1] < least and len(chosen) > 1:
        chosen.pop()
    return np.array([*chosen, times[-1]])


def _longest_gap(options: Options, segment: Segment) -> float:
    """How far apart nodes may stand where nothing asks for one, s.

    What lies between two nodes is interpolated, positions by the motion prior, slow states
    linearly. The errors stay under a share of each record's noise, and as the records of an
    interval have them in common, under that share of the noise of their mean.
    """
    order, gaps = order_of(options), [np.inf]
    horizontal, vertical = options.horizontal_psd, options.vertical_psd
    larger = max(horizontal, vertical)
    two_way, one_way = segment.two_way_range, segment.one_way_range
    for rows, way in ((two_way, NOMINAL_SPEED / 2.0), (one_way, NOMINAL_SPEED)):
        if rows is not None and len(rows):
            error = INTERPOLATION_SHARE * float(rows.sigma.min())
            gaps.append(
                _shared(longest_interval(order, larger, way * error), order, rows.t_receive)
            )
            if options.estimate_sound_speed:
                flight = float(np.abs(rows.travel_time).max())
                walk = options.number("sound_speed_walk") * flight
                gaps.append(_shared(_longest_walk(walk, error), 1, rows.t_receive))
    if one_way is not None and len(one_way):
        error = INTERPOLATION_SHARE * float(one_way.sigma.min())
        drift = max(options.clock_drift_walk, 1e-30) ** 2
        gaps.append(_shared(_longest_walk(options.clock_walk, error), 1, one_way.t_receive))
        gaps.append(_shared(longest_interval(2, drift, error), 2, one_way.t_receive))
    if segment.slant_range is not None and len(segment.slant_range):
        error = INTERPOLATION_SHARE * float(segment.slant_range.sigma.min())
        gaps.append(_shared(longest_interval(order, larger, error), order, segment.slant_range.t))
    if segment.position is not None and len(segment.position):
        error = INTERPOLATION_SHARE * float(np.sqrt(segment.position.covariances[:, 0, 0].min()))
        gaps.append(_shared(longest_interval(order, larger, error), order, segment.position.t))
    if segment.depth is not None and len(segment.depth):
        error = INTERPOLATION_SHARE * float(segment.depth.sigma.min())
        gaps.append(_shared(longest_interval(order, vertical, error), order, segment.depth.t))
    return min(gaps)


def _longest_walk(walk: float, error: float) -> float:
    """Interval over which linear interpolation of a random walk is off by `error`, s."""
    return 4.0 * (error / max(walk, 1e-30)) ** 2


def _shared(alone: float, order: int, times: FloatArray) -> float:
    """What an interval (s) that is right for a single record shrinks to for records at `times`.

    The error's variance grows with the interval to the power of 2 order - 1, the number of records
    that have it in common with the interval itself.
    """
    span, power = float(np.ptp(times)), 2 * order - 1
    if span == 0.0:
        return alone
    return min(alone, (alone**power * span / len(times)) ** (1.0 / (power + 1)))


def filled(times: FloatArray, longest: float) -> FloatArray:
    """Split gaps longer than `longest` (s) into equal parts."""
    gaps = np.diff(times)
    parts = np.maximum(np.ceil(gaps / longest - 1e-9), 1.0).astype(np.int64)
    if (parts == 1).all():
        return times
    pieces = [t + gap / n * np.arange(n) for t, gap, n in zip(times[:-1], gaps, parts, strict=True)]
    return np.concatenate([*pieces, times[-1:]])
