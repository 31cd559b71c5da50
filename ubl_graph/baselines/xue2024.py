"""Windows of two-way pings after Xue et al. 2024: a polynomial track fitted to a few pings.

A two-way travel time says something of two places, where the ping was sent and where its reply was
heard. Within a window the vehicle follows a polynomial of time, so that a few coefficients stand
for all these places (equations 4 and 12 to 17),

    P(t) = sum over i of C_i (t - t_c)^i,  t_c midway between first emission and last reception,

in east and north; the depth is known. Gauss-Newton fits the lengths of the pings' ways,

    L = c T = |P(t_s) - B| + |P(t_r) - B|,

unweighted, along straight rays at the harmonic mean c of the speed over depth. Space intersection
(section 1) is the same with a vehicle that stands still, in terms of l = L / 2.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ubl_graph.arrays import BoolArray, FloatArray, IntArray
from ubl_graph.baselines.fixes import Fixes
from ubl_graph.baselines.polynomial_fit import Pings, PolynomialFit
from ubl_graph.errors import ConfigurationError, DataError, UnobservableError
from ubl_graph.graph import model_segment
from ubl_graph.initial import find_starts
from ubl_graph.mission import Mission, Reference, Segment
from ubl_graph.options import Options
from ubl_graph.reckoning import DeadReckoning

WindowModel = Literal["static", "constant_velocity", "constant_acceleration"]

#: Orders of the polynomials by name.
ORDERS: dict[str, int] = {"static": 0, "constant_velocity": 1, "constant_acceleration": 2}


@dataclass(frozen=True, eq=False)
class Windows:
    """Polynomial windows of a segment, one row a window, in order of time.

    Attributes
    ----------
    count : array of int, shape (W,)
        Pings in each.
    coefficients : array, shape (W, 2, q + 1)
        East and north, about the epoch; m, m/s, m/s^2 (half the acceleration), and so on; nan where
        the window has no solution.
    dop : array, shape (W, q + 1)
        Dilution of precision of each power's coefficients, sqrt(Q_E + Q_N) with
        Q = (A' A)^-1 (equation 11): PDOP, VDOP, ADOP, and so on. A range error of one metre makes
        one of so many m, m/s, m/s^2. Space intersection counts l = L / 2, all else L.
    centre : Fixes
        Positions at the epochs t_c, midway between first emission and last reception.
    current : Fixes
        Positions at the last emission, the paper's "current" epoch.
    newest : Fixes
        Positions at the last reception, when the window's data are complete.
    """

    count: IntArray
    coefficients: FloatArray
    dop: FloatArray
    centre: Fixes
    current: Fixes
    newest: Fixes

    def __len__(self) -> int:
        return len(self.count)

    @property
    def order(self) -> int:
        """Order q of the polynomial; 0 for space intersection."""
        return self.coefficients.shape[2] - 1

    @property
    def trdop(self) -> FloatArray:
        """Trajectory dilution of precision (W,): sqrt(trace((A' A)^-1)), equation 10."""
        return np.sqrt((self.dop**2).sum(axis=1))

    @property
    def velocity(self) -> FloatArray:
        """East and north velocity at the epoch, (W, 2), m/s; zero for space intersection."""
        if self.order == 0:
            return np.zeros((len(self), 2))
        return self.coefficients[:, :, 1]


def xue2024(
    mission: Mission,
    model: WindowModel | int = "constant_velocity",
    *,
    window: int = 8,
    window_seconds: float | None = None,
    starts: Mapping[str, Reference] | None = None,
) -> dict[str, Windows]:
    """Locate a vehicle by windows of two-way pings, each for itself.

    Parameters
    ----------
    mission : Mission
        Two-way ranges, depth, attitude, beacons, lever arms and sound speed are used; nothing else.
        Sigmas are not: the paper weighs all pings alike.
    model : {"static", "constant_velocity", "constant_acceleration"} or int
        Space intersection, or the order of the polynomial.
    window : int
        Pings in a window, in order of emission; there is a window for each ping that has so many
        up to itself.
    window_seconds : float, optional
        Instead of a number of pings: those sent and heard within so many seconds up to a reception,
        and a window for each reception so long after the first emission.
    starts : mapping of str to Reference, optional
        Tracks to start Gauss-Newton at, by segment name. Left out, it starts at the track that
        `smooth` would start at too, which is searched in the same pings.

    Returns
    -------
    dict of str to Windows
        By segment name. A window that has no more pings than parameters, or whose geometry is
        singular, or in which Gauss-Newton does not converge, is not solved.

    Raises
    ------
    ConfigurationError
        Where the model is unknown, or a window of so many pings has no more than parameters.
    DataError
        Where a segment has no two-way range, no depth, or fewer pings than a window.
    UnobservableError
        Where no window of a segment has more pings than parameters.

    Examples
    --------
    >>> from ubl_graph.sim.xue2024 import xue_pass
    >>> mission, truth = xue_pass("straight", seed=1, noise=0.0)
    >>> windows = xue2024(mission, "constant_velocity")[""]
    >>> len(windows), windows.velocity.mean(axis=0).round(3).tolist()
    (94, [3.0, 0.0])
    >>> round(float(windows.trdop.mean()), 3)
    0.796
    """
    order = _order(model)
    if window_seconds is None:
        if window <= 2 * (order + 1):
            raise ConfigurationError(
                f"a window of {window} pings for {2 * (order + 1)} parameters",
                f"take {2 * (order + 1) + 1} pings or more",
                field="window",
            )
    elif not 0.0 < window_seconds < float("inf"):
        raise ConfigurationError(
            f"a window of {window_seconds} s", "give seconds", field="window_seconds"
        )
    found: dict[str, Windows] = {}
    for segment in mission.segments:
        pings = _pings(mission, segment)
        index, used = _members(pings, segment, window, window_seconds)
        _check_windows(segment, used, order)
        start = None if starts is None else starts.get(segment.name)
        track = _searched(mission, segment) if start is None else start
        found[segment.name] = _windows(pings, index, used, order, track)
    return found


def _order(model: WindowModel | int) -> int:
    if isinstance(model, int) and not isinstance(model, bool) and model >= 0:
        return model
    if model in ORDERS:
        return ORDERS[str(model)]
    raise ConfigurationError(
        f"'{model}' is no model of a window",
        f"choose {', '.join(ORDERS)}, or an order of 0 or more",
        field="model",
    )


def _bare(mission: Mission, segment: Segment) -> tuple[Mission, Segment]:
    """The mission with two-way pings, depth and attitude of one segment alone."""
    only = Segment(
        segment.name,
        two_way_range=segment.two_way_range,
        depth=segment.depth,
        attitude=segment.attitude,
    )
    return replace(mission, segments=(only,), options=Options()), only


def _pings(mission: Mission, segment: Segment) -> Pings:
    for kind in ("two_way_range", "depth"):
        if kind not in segment.records():
            raise DataError(f"{_where(segment)} has no {kind}", "windows of pings need both")
    bare, only = _bare(mission, segment)
    reckoning = DeadReckoning(bare, model_segment(only, bare.options))
    s = reckoning.sightings
    from_beacon = s.offset - s.beacon[:, None]
    mean = 1.0 / mission.sound_speed.harmonic_mean(-s.offset[:, :, 2], -s.beacon[:, None, 2])
    both = mean.mean(axis=1)
    return Pings(
        s.t,
        from_beacon[:, :, :2],
        from_beacon[:, :, 2],
        mean / both[:, None],
        s.measured / both,
        reckoning,
    )


def _members(
    pings: Pings, segment: Segment, window: int, seconds: float | None
) -> tuple[IntArray, BoolArray]:
    """Pings of each window (W, m), filled up with any, and which of them count."""
    sent, heard = pings.t.T
    if seconds is None:
        index = np.arange(window) + np.arange(len(pings) - window + 1)[:, None]
        used = np.ones(index.shape, dtype=np.bool_)
    else:
        ends = np.sort(heard[heard >= sent[0] + seconds])
        begins = np.searchsorted(sent, ends - seconds)
        most = int((np.searchsorted(sent, ends) - begins).max(initial=0))
        index = np.minimum(begins[:, None] + np.arange(most), len(pings) - 1)
        # Replies overtake each other: not all that were sent by then were heard.
        used = (begins[:, None] + np.arange(most) < len(pings)) & (heard[index] <= ends[:, None])
    if not len(index):
        asked = f"{window} pings" if seconds is None else f"{seconds:g} s"
        raise DataError(
            f"{_where(segment)} has {len(pings)} two-way pings in {heard.max() - sent[0]:g} s, "
            f"less than a window of {asked}",
            "take a shorter window",
        )
    return index, used


def _check_windows(segment: Segment, used: BoolArray, order: int) -> None:
    most, parameters = int(used.sum(axis=1).max()), 2 * (order + 1)
    if most <= parameters:
        raise UnobservableError(
            f"{_where(segment)} has windows of {most} pings at the most, for {parameters} "
            "parameters; take a longer window or a lower order"
        )


def _where(segment: Segment) -> str:
    return f"segment '{segment.name}'" if segment.name else "the mission"


def _searched(mission: Mission, segment: Segment) -> Reference:
    bare, only = _bare(mission, segment)
    model = model_segment(only, bare.options)
    return Reference(model.t, find_starts(bare, model).tracks[0].position)


def _windows(
    pings: Pings, index: IntArray, used: BoolArray, order: int, start: Reference
) -> Windows:
    sent, heard = pings.t[index, 0], pings.t[index, 1]
    last_sent = np.where(used, sent, -np.inf).max(axis=1)
    last_heard = np.where(used, heard, -np.inf).max(axis=1)
    epoch = 0.5 * (np.where(used, sent, np.inf).min(axis=1) + last_heard)
    # Times are counted in half windows within the fit: powers of seconds are ill conditioned.
    half = last_heard - epoch
    fit = PolynomialFit(pings, index, used, order, epoch, half)
    theta, iterations, solved = fit.solve(fit.along(start))
    powers = half[:, None] ** np.arange(order + 1)
    coefficients = np.where(solved[:, None, None], theta / powers[:, None], np.nan)

    def fixes(t: FloatArray) -> Fixes:
        elapsed = (t - epoch)[:, None, None] ** np.arange(order + 1)
        position = np.full((len(t), 3), np.nan)
        position[:, :2] = (coefficients * elapsed).sum(axis=2)
        position[solved, 2] = pings.reckoning.offset(t[solved])[:, 2]
        return Fixes(t, position, solved, iterations)

    return Windows(
        used.sum(axis=1),
        coefficients,
        fit.dops(theta, solved) / powers,
        *(fixes(t) for t in (epoch, last_sent, last_heard)),
    )
