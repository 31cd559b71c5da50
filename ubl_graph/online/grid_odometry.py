"""Odometry records laid onto a grid of nodes: one change of pose for every interval they cover.

A record that reaches over a node is cut there, as if its twist had been constant; what lies within
an interval is put one after the other, with its noise. Records that end on nodes stay as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ubl_graph import lie
from ubl_graph.arrays import FloatArray
from ubl_graph.measurements import Odometry
from ubl_graph.odometry_noise import PLANAR, odometry_covariances
from ubl_graph.options import Options

#: Gaps and overlaps shorter than this are rounding, s.
INSTANT = 1e-6
#: Forward, left, up into forward, right, down.
_SIGNS = np.array([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class Steps:
    """Odometry records of any shape.

    Attributes
    ----------
    begin, end : array, shape (M,)
        s.
    twist : array, shape (M, 6)
        What leads from the first pose to the second if held for a unit of time; forward, left, up.
    covariance : array, shape (M, 6, 6)
        Of the change of pose; zero for what a plane has not.
    planar : bool
        Whether one of them knows the motion in a plane only.
    """

    begin: FloatArray
    end: FloatArray
    twist: FloatArray
    covariance: FloatArray
    planar: bool


def on_grid(records: Sequence[Odometry], times: FloatArray, options: Options) -> Odometry | None:
    """Changes of pose over the intervals of a grid that records cover without a gap.

    Parameters
    ----------
    records : sequence of Odometry
        Each of one shape (planar or not, with noise or without). Where some overlap, the part of
        the later one that is new counts.
    times : array, shape (N,)
        Of the nodes, s, strictly increasing.
    options : Options
        For the noise.

    Returns
    -------
    Odometry or None
        With covariances that hold the options' share; None where no interval is covered.
    """
    if not records:
        return None
    steps = _steps(records, options)
    parts = _cut(steps, times)
    spans = np.diff(times)
    whole = [
        k
        for k, some in enumerate(parts)
        if some and sum(b - a for _, a, b in some) > spans[k] - INSTANT
    ]
    if not whole:
        return None
    changes = [_composed(steps, parts[k]) for k in whole]
    return _record(times[whole], times[np.array(whole) + 1], changes, steps.planar)


def _steps(records: Sequence[Odometry], options: Options) -> Steps:
    twists: list[FloatArray] = []
    noise: list[FloatArray] = []
    for some in records:
        twists.append(lie.logarithm(lie.rotation(some.rotation_vector), some.translation))
        whole = np.zeros((len(some), 6, 6))
        keep = PLANAR if some.dimension == 2 else np.arange(6)
        whole[:, keep[:, None], keep[None, :]] = odometry_covariances(some, options)
        noise.append(whole)
    begin = np.concatenate([r.t_from for r in records])
    end = np.concatenate([r.t_to for r in records])
    order = np.lexsort((begin, end))
    return Steps(
        begin[order],
        end[order],
        np.concatenate(twists)[order],
        np.concatenate(noise)[order],
        any(r.dimension == 2 for r in records),
    )


def _cut(steps: Steps, times: FloatArray) -> list[list[tuple[int, float, float]]]:
    """What lies in each interval: record, and from when to when it counts, s."""
    parts: list[list[tuple[int, float, float]]] = [[] for _ in times[1:]]
    reached = -np.inf
    for i, (begin, end) in enumerate(zip(steps.begin, steps.end, strict=True)):
        begin, reached = max(begin, reached), max(end, reached)
        if end - begin < INSTANT:
            continue
        first = max(int(np.searchsorted(times, begin + INSTANT, side="right")) - 1, 0)
        for k in range(first, len(parts)):
            low, high = max(begin, times[k]), min(end, times[k + 1])
            if high - low < INSTANT:
                break
            parts[k].append((i, float(low), float(high)))
    return parts


def _composed(
    steps: Steps, parts: Sequence[tuple[int, float, float]]
) -> tuple[FloatArray, FloatArray]:
    """One change of pose after the other: as a twist (6,), and its covariance (6, 6)."""
    which = np.array([i for i, _, _ in parts])
    share = np.array([b - a for _, a, b in parts]) / (steps.end - steps.begin)[which]
    # A record that ends on the nodes counts whole, to the last bit.
    share = np.where(np.abs(share - 1.0) < INSTANT, 1.0, share)
    twists = share[:, None] * steps.twist[which]
    noise = share[:, None, None] * steps.covariance[which]
    if len(which) == 1:
        return twists[0], noise[0]
    turns, ways = lie.exponential(twists)
    backs = np.swapaxes(turns, 1, 2)
    carry = lie.adjoint(backs, -np.einsum("mij,mj->mi", backs, ways))
    turn, way, covariance = turns[0], ways[0], noise[0]
    for one, moved, back, own in zip(turns[1:], ways[1:], carry[1:], noise[1:], strict=True):
        way, turn = way + turn @ moved, turn @ one
        covariance = back @ covariance @ back.T + own
    return lie.logarithm(turn[None], way[None])[0], covariance


def _record(
    begin: FloatArray,
    end: FloatArray,
    changes: Sequence[tuple[FloatArray, FloatArray]],
    planar: bool,
) -> Odometry:
    turns, ways = lie.exponential(np.stack([twist for twist, _ in changes]))
    forward, right, down = (ways * _SIGNS).T
    about = (lie.rotation_vector(turns) * _SIGNS).T
    signs = np.tile(_SIGNS, 2)
    covariance = np.stack([c for _, c in changes]) * np.outer(signs, signs)
    if planar:
        covariance = covariance[:, PLANAR[:, None], PLANAR[None, :]]
        return Odometry.unchecked(
            t_from=begin,
            t_to=end,
            forward=forward,
            right=right,
            about_down=about[2],
            covariance=covariance,
        )
    return Odometry.unchecked(
        t_from=begin,
        t_to=end,
        forward=forward,
        right=right,
        down=down,
        about_forward=about[0],
        about_right=about[1],
        about_down=about[2],
        covariance=covariance,
    )
