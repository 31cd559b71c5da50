"""Rays that do not turn between two depths: Snell's law through layers, and the search for p.

Snell's law keeps the ray parameter p = sin(theta)/c constant (theta from the vertical), and in a
layer whose speed is linear in depth the ray is a circular arc. With w = cos(theta) =
sqrt(1 - p^2 c^2), a layer of thickness dz and end speeds c_a, c_b is crossed with

    dx   = p dz (c_a + c_b) / (w_a + w_b)
    time = d / s asinh(u) / u,  d = hypot(dx, dz), s = sqrt(c_a c_b), u = (c_b - c_a) d/dz / (2 s)

Both are the textbook arcs (Jensen, Kuperman, Porter, Schmidt, Computational Ocean Acoustics,
2nd ed., section 3.3.1) rewritten without a division by the gradient, so that an isovelocity layer
is no special case: from p c = sin(theta), (w_a - w_b)/(p g) = p dz (c_a + c_b)/(w_a + w_b), and
the arc's chord d obeys sinh(g time / 2) = g d / (2 s).

The ray is sought in q = tan(theta) where it is flattest, at the fastest speed c_m on its way: then
w = sqrt(1 + q^2 e) / sqrt(1 + q^2) with e = 1 - (c/c_m)^2, and X(q), the horizontal distance it
covers, is increasing, concave and free of singularities; a grazing ray is q -> infinity.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ubl_graph.acoustics.profile import Nodes, SoundSpeedProfile
from ubl_graph.arrays import BoolArray, FloatArray, IntArray

MISS = 1e-9  # horizontal miss at which the search ends, over the distance
_NEWTON = 5  # plain Newton steps; a ray far from grazing needs two
_CAREFUL = 80  # bound on the bracketed steps for the other rows; random profiles took 23
GRAZING = 1e120  # stands for an infinite tangent; its square does not overflow
_NONE: IntArray = np.empty(0, dtype=np.intp)


class Rays(NamedTuple):
    """Rays between M pairs of depths, the upper end in row 0 and the lower in row 1."""

    time: FloatArray  # (M,) s
    p: FloatArray  # (M,) s/m
    vertical: FloatArray  # (2, M) vertical slowness at the ends, s/m, without sign


def stack(
    z: FloatArray, c: FloatArray, depth: FloatArray, speed: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Layers between two depths of every row.

    Nodes that lie between the ends of one row but not of another become layers of zero thickness
    there, which add nothing to any sum.

    Parameters
    ----------
    z, c : (N,) arrays
        Nodes of the profile.
    depth, speed : (2, M) arrays
        Of the upper and lower ends.

    Returns
    -------
    thickness : (K + 1, M) array
    speed : (K + 2, M) array
        At the nodes, the ends included.
    """
    lo, hi = depth[0], depth[1]
    first = z.searchsorted(np.fmin.reduce(lo), "right")  # fmin: a nan row spoils no other
    last = max(first, z.searchsorted(np.fmax.reduce(hi), "left"))
    nodes, speeds = np.empty((2, last - first + 2, lo.size))
    nodes[0], nodes[-1] = lo, hi
    speeds[0], speeds[-1] = speed[0], speed[1]
    if first < last:
        inner, inner_speed = z[first:last, None], c[first:last, None]
        if lo.size > 1 and (z[first] < np.fmax.reduce(lo) or z[last - 1] > np.fmin.reduce(hi)):
            nodes[1:-1] = np.minimum(np.maximum(inner, lo), hi)
            speeds[1:-1] = np.where(
                inner <= lo, speed[0], np.where(inner >= hi, speed[1], inner_speed)
            )
        else:
            nodes[1:-1], speeds[1:-1] = inner, inner_speed
    return nodes[1:] - nodes[:-1], speeds


def _reach(
    q: FloatArray, e: FloatArray, run: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """X(q) and dX/dq, each (M,), from e (K + 2, M) and run = dz (c_a + c_b)/c_m (K + 1, M).

    Also the sums over both ends of every layer of sqrt(1 + q^2 e), (K + 1, M).
    """
    s = np.sqrt(1.0 + q * q * e)
    top, bottom = s[:-1], s[1:]
    both = top + bottom
    share = run / both
    return q * np.add.reduce(share), np.add.reduce(share / (top * bottom)), both


def layer_times(thickness: FloatArray, speed: FloatArray, tangent: FloatArray) -> FloatArray:
    """Sum over the layers of the arcs' times; `tangent` is dx/dz of their chords."""
    stretch = np.sqrt(1.0 + tangent * tangent)
    top, bottom = speed[:-1], speed[1:]
    mean = np.sqrt(top * bottom)
    u = (bottom - top) * stretch / (mean + mean)
    u += 1e-200  # makes asinh(u)/u its limit 1 at u = 0 and changes no other u
    return np.add.reduce(thickness * stretch * np.arcsinh(u) / (u * mean))


def direct_rays(
    profile: SoundSpeedProfile, depth: FloatArray, away: FloatArray
) -> tuple[Rays, IntArray]:
    """Rays that do not turn, and the rows for which there is none."""
    z, c, _ = profile.nodes
    ends = np.interp(depth, z, c)
    thickness, speed = stack(z, c, depth, ends)
    fastest = np.maximum.reduce(speed)
    square = fastest * fastest
    e = (fastest - speed) * (fastest + speed) / square
    ratio = (speed[:-1] + speed[1:]) / fastest
    run = ratio * thickness
    # Start: the straight line at the mean speed. As X is concave, q is at least away/X'(0), and
    # Newton's method converges from anywhere: slowly near grazing, which is left to _search.
    height = depth[1] - depth[0]
    initial = np.add.reduce(run)
    initial *= 0.5
    least = away / initial
    bend = initial / height
    q = least / np.sqrt(np.maximum(1.0 - least * least * (1.0 - bend * bend), 0.1))
    tolerance = MISS * (away + height)
    hard = _NONE
    for _ in range(_NEWTON):
        reach, slope, both = _reach(q, e, run)
        miss = away - reach
        refined = np.maximum(q + miss / slope, least)
        if (np.abs(miss) <= tolerance).all():
            break
        q = refined
    else:
        reach, slope, both = _reach(q, e, run)
        miss = away - reach
        refined = np.maximum(q + miss / slope, least)
        open_ = np.flatnonzero(~(np.abs(miss) <= tolerance))  # nan is open too
        if open_.size:
            creeping = _may_creep(profile.nodes, depth[:, open_], e[:, open_])
            q[open_], none = _search(away[open_], e[:, open_], run[:, open_], creeping)
            hard = open_[none]
            reach, _, both = _reach(q, e, run)
            miss = away - reach
            refined[open_] = q[open_]
    # By Fermat dT/dX = p: this correction leaves an error of second order in the miss. The last
    # Newton step is free and makes p as good.
    flat = refined * refined
    secant = np.sqrt(1.0 + flat)
    p = refined / (fastest * secant)
    time = layer_times(thickness, speed, q * ratio / both) + p * miss
    return Rays(time, p, np.sqrt(1.0 + flat * e[:: e.shape[0] - 1]) / (secant * ends)), hard


def direct_reach(e: FloatArray, run: FloatArray) -> FloatArray:
    """Return X as q goes to infinity: how far a ray goes without turning; huge stands for inf."""
    root = np.sqrt(e)
    return np.add.reduce(run / np.maximum(root[:-1] + root[1:], 1e-150))


def _may_creep(nodes: Nodes, depth: FloatArray, e: FloatArray) -> BoolArray:
    """Tell where the ray may run on horizontally at the depth of its faster end.

    It may if the speed is constant on the far side of that end: it is then the limit of the rays
    for an end slightly farther out, and in the constant layer it is the straight line.
    """
    above = nodes.gradient[nodes.depth.searchsorted(depth[0], "left")]
    below = nodes.gradient[nodes.depth.searchsorted(depth[1], "right")]
    up = (e[0] == 0.0) & (above == 0.0) & (depth[0] > 0.0)
    return up | ((e[-1] == 0.0) & (below == 0.0))


def _search(
    away: FloatArray, e: FloatArray, run: FloatArray, creeping: BoolArray
) -> tuple[FloatArray, BoolArray]:
    """Solve X(q) = away near grazing, bracketed; return q and where there is no solution.

    Towards its limit R, X(q) levels off like R - const/q, and Newton's method only doubles q in a
    step. X / (1 - X/R) instead goes on linearly, with at most twice its initial slope in a single
    layer.
    """
    limit = direct_reach(e, run)
    none = ~((away <= limit * (1.0 + 1e-12)) & (limit > 0.0))
    target = np.minimum(away, limit * (1.0 - 1e-13))
    goal = target / (1.0 - target / limit)
    initial = 0.5 * np.add.reduce(run)
    lower, upper = target / initial, np.full(away.size, np.inf)
    q = np.minimum(np.maximum(goal / initial, lower), GRAZING)
    for k in range(_CAREFUL):
        reach, slope, _ = _reach(q, e, run)
        miss = target - reach
        done = none | (np.abs(miss) <= 1e-3 * MISS * away)
        if done.all():
            break
        short = miss > 0.0
        lower, upper = np.where(short, q, lower), np.where(short, upper, q)
        gap = np.maximum(1.0 - reach / limit, 1e-16)
        step = q + (goal - reach / gap) * gap * gap / slope
        middle = np.where(np.isinf(upper), 4.0 * lower, np.sqrt(lower * upper))
        inside = (step > lower) & (step < upper)
        if k % 4 == 3:
            inside &= np.isinf(upper)
        q = np.where(done, q, np.minimum(np.where(inside, step, middle), GRAZING))
    creeping &= none & np.isfinite(away)
    q[none] = GRAZING
    return q, none & ~creeping
