"""Where the nodes of a segment stand in time."""

from __future__ import annotations

import math

import numpy as np

from ubl_graph.arrays import BoolArray, FloatArray
from ubl_graph.errors import DataError
from ubl_graph.factors.odometry import Preintegration
from ubl_graph.mission import Segment
from ubl_graph.options import Options
from ubl_graph.trajectory import Order, longest_interval

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
    longest = max(LONGEST_GAP, least, _shared_spacing(order, spacing, segment))
    return _filled(_thinned(wanted, stay, min(spacing, longest), least), longest)


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


def _shared_spacing(order: Order, spacing: float, segment: Segment) -> float:
    """What `spacing` (s) shrinks to where several pings share an interval, and its error.

    The interpolation's variance grows with the interval to the third or fifth power (WNOA, WNOJ),
    and as the pings in it have that error in common it must stay under the noise of their mean.
    """
    ranges = [r for r in (segment.two_way_range, segment.one_way_range) if r is not None]
    times = np.concatenate([r.t_receive for r in ranges]) if ranges else np.empty(0)
    span = float(np.ptp(times)) if len(times) else 0.0
    if span * spacing == 0.0:
        return spacing
    power = 2 * order - 1
    return min(spacing, (spacing**power * span / len(times)) ** (1.0 / (power + 1)))


def _filled(times: FloatArray, longest: float) -> FloatArray:
    """Split gaps longer than `longest` (s) into equal parts."""
    gaps = np.diff(times)
    parts = np.maximum(np.ceil(gaps / longest - 1e-9), 1.0).astype(np.int64)
    if (parts == 1).all():
        return times
    pieces = [t + gap / n * np.arange(n) for t, gap, n in zip(times[:-1], gaps, parts, strict=True)]
    return np.concatenate([*pieces, times[-1:]])
