"""Travel times along refracted rays (eigenrays) through a layered ocean.

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

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ubl_graph.acoustics.profile import BoolArray, FloatArray, Nodes, SoundSpeedProfile
from ubl_graph.acoustics.straight import TravelTimes, point_pairs, straight
from ubl_graph.errors import ConfigurationError, NoDirectRayError

IntArray = NDArray[np.intp]

_CHUNK = 32768  # elements (layers times rows) worked on at once: the arrays stay in the L2 cache
_MISS = 1e-9  # horizontal miss at which the search ends, over the distance
_NEWTON = 5  # plain Newton steps; a ray far from grazing needs two
_CAREFUL = 80  # bound on the bracketed steps for the other rows; random profiles took 23
_TURNING = 60  # bound on those for turning rays, which take 8; random profiles took 41
_SAMPLES = np.linspace(0.0, 1.0, 7)  # where X is looked at while a ray turns within one layer
_GRAZING = 1e120  # stands for an infinite tangent; its square does not overflow
_NEAR = 1e-3  # level ends so near, m, are joined straight: a gradient of 0.1/s changes 2e-16
_NONE: IntArray = np.empty(0, dtype=np.intp)


class _Rays(NamedTuple):
    """Rays between M pairs of depths, the upper end in row 0 and the lower in row 1."""

    time: FloatArray  # (M,) s
    p: FloatArray  # (M,) s/m
    vertical: FloatArray  # (2, M) vertical slowness at the ends, s/m, without sign


def eigenray(
    profile: SoundSpeedProfile,
    a: ArrayLike,
    b: ArrayLike,
    *,
    missing: Literal["raise", "straight"] = "raise",
) -> TravelTimes:
    """Travel time along the direct refracted ray from a to b.

    The ray runs from one depth to the other without turning. Where the ends are farther apart
    than such a ray reaches (both at nearly the same depth, say, with a gradient), it leaves the
    end with the faster water outward, turns once where c = 1/p and comes back; the first arrival
    of these is taken. A ray never turns above the sea surface, and one slower than the straight
    line is no direct arrival. The gradients are the slowness vectors at the ends:
    -(direction of the ray)/c at a, +(direction)/c at b. In a constant profile this is `straight`.

    Parameters
    ----------
    profile : SoundSpeedProfile
        Speed of sound over depth.
    a, b : (M, 3) or (3,) array_like
        Ends, m, east-north-up with up = -depth; a single point is joined to all of the other.
    missing : {"raise", "straight"}
        What to do where no direct ray joins the ends: raise, or take the straight line's time and
        gradients with `found` False, so that an optimiser's trial step may wander.

    Returns
    -------
    TravelTimes
        M rows.

    Raises
    ------
    NoDirectRayError
        If a row has no direct ray and `missing` is "raise"; rows that are not finite count.
    DataError
        If the shapes do not fit.
    ConfigurationError
        If `missing` is unknown.

    Examples
    --------
    >>> profile = SoundSpeedProfile([0.0, 100.0], [1500.0, 1510.0])
    >>> rays = eigenray(profile, [0.0, 0.0, -20.0], [300.0, 400.0, -90.0])
    >>> rays.time.round(7).tolist()
    [0.3353397]
    """
    if missing not in ("raise", "straight"):
        raise ConfigurationError(f"missing is {missing!r}", "choose 'raise' or 'straight'")
    a, b = point_pairs(a, b)
    line = b - a
    rows = line.shape[0]
    if profile.is_constant or rows == 0:
        return straight(profile, a, b)
    away = np.hypot(line[:, 0], line[:, 1])
    depth_a, depth_b = -a[:, 2], -b[:, 2]
    depth = np.empty((2, rows))
    np.minimum(depth_a, depth_b, out=depth[0])
    np.maximum(depth_a, depth_b, out=depth[1])
    chunk = max(1, _CHUNK // (profile.nodes.depth.size + 2))
    # A row that makes nan or infinity in the plain search goes to the careful one.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if rows <= chunk:
            (time, p, vertical), hard = _direct(profile, depth, away)
        else:
            parts = [
                _direct(profile, depth[:, k : k + chunk], away[k : k + chunk])
                for k in range(0, rows, chunk)
            ]
            time = np.concatenate([rays.time for rays, _ in parts])
            p = np.concatenate([rays.p for rays, _ in parts])
            vertical = np.concatenate([rays.vertical for rays, _ in parts], axis=1)
            hard = np.concatenate([k * chunk + hard for k, (_, hard) in enumerate(parts)])
        gradient_b = line * (p / np.maximum(away, 1e-300))[:, None]
        gradient_a = -gradient_b
        downward = depth_b >= depth_a
        if downward.all():
            gradient_a[:, 2], gradient_b[:, 2] = vertical[0], -vertical[1]
        else:
            gradient_a[:, 2] = np.where(downward, vertical[0], -vertical[1])
            gradient_b[:, 2] = np.where(downward, -vertical[1], vertical[0])
    found = np.ones(rows, dtype=np.bool_)
    result = TravelTimes(time, gradient_a, gradient_b, found)
    if hard.size:
        a, b = np.broadcast_to(a, line.shape), np.broadcast_to(b, line.shape)
        chunk = max(1, chunk // 8)  # a row has a column for every layer it may turn in
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for k in range(0, hard.size, chunk):
                _turn_rows(profile, a, b, away, hard[k : k + chunk], result)
        lost = np.flatnonzero(~found)
        if lost.size and missing == "raise":
            raise NoDirectRayError(_complaint(profile, depth, away, lost))
    return result


def _stack(
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


def _layer_times(thickness: FloatArray, speed: FloatArray, tangent: FloatArray) -> FloatArray:
    """Sum over the layers of the arcs' times; `tangent` is dx/dz of their chords."""
    stretch = np.sqrt(1.0 + tangent * tangent)
    top, bottom = speed[:-1], speed[1:]
    mean = np.sqrt(top * bottom)
    u = (bottom - top) * stretch / (mean + mean)
    u += 1e-200  # makes asinh(u)/u its limit 1 at u = 0 and changes no other u
    return np.add.reduce(thickness * stretch * np.arcsinh(u) / (u * mean))


def _direct(
    profile: SoundSpeedProfile, depth: FloatArray, away: FloatArray
) -> tuple[_Rays, IntArray]:
    """Rays that do not turn, and the rows for which there is none."""
    z, c, _ = profile.nodes
    ends = np.interp(depth, z, c)
    thickness, speed = _stack(z, c, depth, ends)
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
    tolerance = _MISS * (away + height)
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
    time = _layer_times(thickness, speed, q * ratio / both) + p * miss
    return _Rays(time, p, np.sqrt(1.0 + flat * e[:: e.shape[0] - 1]) / (secant * ends)), hard


def _limit(e: FloatArray, run: FloatArray) -> FloatArray:
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
    limit = _limit(e, run)
    none = ~((away <= limit * (1.0 + 1e-12)) & (limit > 0.0))
    target = np.minimum(away, limit * (1.0 - 1e-13))
    goal = target / (1.0 - target / limit)
    initial = 0.5 * np.add.reduce(run)
    lower, upper = target / initial, np.full(away.size, np.inf)
    q = np.minimum(np.maximum(goal / initial, lower), _GRAZING)
    for k in range(_CAREFUL):
        reach, slope, _ = _reach(q, e, run)
        miss = target - reach
        done = none | (np.abs(miss) <= 1e-3 * _MISS * away)
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
        q = np.where(done, q, np.minimum(np.where(inside, step, middle), _GRAZING))
    creeping &= none & np.isfinite(away)
    q[none] = _GRAZING
    return q, none & ~creeping


class _Turns(NamedTuple):
    """Rays that pass the lower end, turn in a given layer below, and come back to the lower end.

    One column for each of P pairs of a row and a layer. The cosine w = sqrt(1 - p^2 c_r^2) at the
    speed c_r above which a ray turns in the layer, and no earlier, runs from 0 to `widest`; in w
    the reach X(w) is smooth, though not monotonic: it falls where the gradient grows with depth.
    """

    row: IntArray  # (P,)
    thickness: FloatArray  # (K + 1, P) of the layers passed; those below the lower end twice
    speed: FloatArray  # (K + 2, P) at their ends; the last is where the layer of turning starts
    e: FloatArray  # (K + 2, P) 1 - (speed / c_r)^2
    reference: FloatArray  # (P,) c_r
    gradient: FloatArray  # (P,) of the layer of turning, positive
    widest: FloatArray  # (P,)
    lower_end: int  # row of `speed` that is the lower end

    def pick(self, columns: IntArray) -> _Turns:
        """Return some of the pairs."""
        return _Turns(
            self.row[columns],
            self.thickness[:, columns],
            self.speed[:, columns],
            self.e[:, columns],
            self.reference[columns],
            self.gradient[columns],
            self.widest[columns],
            self.lower_end,
        )

    def tangents(self, w: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return p (P,), the cosines (K + 2, P) and the chords' dx/dz (K + 1, P)."""
        sine = (1.0 - w) * (1.0 + w)
        cosine = np.sqrt(w * w + sine * self.e)
        p = np.sqrt(sine) / self.reference
        both = np.maximum(cosine[:-1] + cosine[1:], 1.0 / _GRAZING)
        return p, cosine, p * (self.speed[:-1] + self.speed[1:]) / both

    def reach(self, w: FloatArray) -> FloatArray:
        """Return X(w), (P,)."""
        p, cosine, tangent = self.tangents(w)
        layers = np.add.reduce(self.thickness * tangent)
        return layers + 2.0 * cosine[-1] / (p * self.gradient)

    def rays(self, w: FloatArray, away: FloatArray) -> _Rays:
        """Return the rays, their time brought from X(w) to the distance `away`."""
        p, cosine, tangent = self.tangents(w)
        arc = 2.0 * np.arctanh(cosine[-1]) / self.gradient
        time = _layer_times(self.thickness, self.speed, tangent) + arc
        ends = [0, self.lower_end]
        return _Rays(time + p * (away - self.reach(w)), p, cosine[ends] / self.speed[ends])


def _turns(nodes: Nodes, depth: FloatArray, away: FloatArray, ceiling: FloatArray) -> _Turns | None:
    """Pairs of rows and layers for which a turning ray can be faster than the time `ceiling`."""
    z, c, gradient = nodes
    ends = np.interp(depth, z, c)
    first = z.searchsorted(np.fmin.reduce(depth[1]), "right")
    thickness, speed = _stack(z, c, depth, ends)
    # Only from an end that is the fastest place between the two can a ray go on outward.
    open_ = np.maximum.reduce(speed) <= ends[1]
    if first >= z.size or not open_.any():
        return None
    below = z[first:, None] > depth[1]
    deeper = np.concatenate((depth[1:], np.maximum(z[first:, None], depth[1])))
    faster = np.concatenate((ends[1:], np.where(below, c[first:, None], ends[1])))
    # A ray turns at the first depth where c = 1/p, so in a layer that brings a new maximum.
    record = np.maximum.accumulate(faster)
    # It is no shorter than the straight line folded at that layer, and nowhere faster than c
    # where it turns.
    shortest = np.hypot(away, 2.0 * deeper[:-1] - depth[0] - depth[1])
    layer, row = np.nonzero((faster[1:] > record[:-1]) & open_ & (shortest <= ceiling * faster[1:]))
    if not row.size:
        return None
    reference, entry, end = record[layer, row], faster[layer, row], faster[layer + 1, row]
    out, out_speed = _stack(
        z, c, np.stack((depth[1, row], deeper[layer, row])), np.stack((ends[1, row], entry))
    )
    speeds = np.concatenate((speed[:, row], out_speed))
    return _Turns(
        row=row,
        # The lower end stands twice, with a layer of no thickness between.
        thickness=np.concatenate((thickness[:, row], np.zeros((1, row.size)), 2.0 * out)),
        speed=speeds,
        e=(reference - speeds) * (reference + speeds) / (reference * reference),
        reference=reference,
        gradient=gradient[first + layer],
        widest=np.sqrt((end - reference) * (end + reference)) / end,
        lower_end=speed.shape[0] - 1,
    )


def _turn_down(nodes: Nodes, depth: FloatArray, away: FloatArray, ceiling: FloatArray) -> _Rays:
    """First arrivals among the rays that turn below both ends; infinite times where is none."""
    rows = away.size
    result = _Rays(np.full(rows, np.inf), np.zeros(rows), np.zeros((2, rows)))
    turns = _turns(nodes, depth, away, ceiling)
    if turns is None:
        return result
    # Every change of sign of X - away between samples of a layer brackets a ray.
    distance = away[turns.row]
    samples = _SAMPLES[:, None] * turns.widest
    excess = np.stack([turns.reach(w) for w in samples]) - distance
    place, column = np.nonzero((excess[:-1] <= 0.0) != (excess[1:] <= 0.0))
    if not column.size:
        return result
    turns, distance = turns.pick(column), distance[column]
    w = _bracketed(
        turns,
        distance,
        (samples[place, column], samples[place + 1, column]),
        (excess[place, column], excess[place + 1, column]),
    )
    rays = turns.rays(w, distance)
    early = np.flatnonzero(rays.time <= ceiling[turns.row] * (1.0 + 1e-12))
    order = early[np.argsort(-rays.time[early], kind="stable")]
    row = turns.row[order]  # of several values for one row the last stays, the fastest
    result.time[row], result.p[row] = rays.time[order], rays.p[order]
    result.vertical[:, row] = rays.vertical[:, order]
    return result


def _bracketed(
    turns: _Turns,
    distance: FloatArray,
    bracket: tuple[FloatArray, FloatArray],
    excess: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """Solve X(w) = distance by the Illinois method, with a bisection every eighth step."""
    (left, right), (f_left, f_right) = bracket, excess
    w, moved_left = left, np.zeros(left.size, dtype=np.bool_)
    for k in range(_TURNING):
        secant = right - f_right * (right - left) / (f_right - f_left)
        inside = (secant - left) * (secant - right) < 0.0
        middle = 0.5 * (left + right)
        w = middle if k % 8 == 7 else np.where(inside, secant, middle)
        f = turns.reach(w) - distance
        if (np.abs(f) <= 1e-3 * _MISS * distance).all():
            break
        moves_left = (f <= 0.0) == (f_left <= 0.0)
        # An end kept twice running has its value halved, or it would never move.
        again = np.where(moves_left == moved_left, 0.5, 1.0) if k else 1.0
        left, right = np.where(moves_left, w, left), np.where(moves_left, right, w)
        f_left = np.where(moves_left, f, again * f_left)
        f_right = np.where(moves_left, again * f_right, f)
        moved_left = moves_left
    return w


def _turn_rows(
    profile: SoundSpeedProfile,
    a: FloatArray,
    b: FloatArray,
    away: FloatArray,
    rows: IntArray,
    result: TravelTimes,
) -> None:
    """Fill in rows that no ray joins without turning: by turning rays, or straight, not found."""
    line = straight(profile, a[rows], b[rows])
    result.time[rows] = line.time
    result.gradient_a[rows], result.gradient_b[rows] = line.gradient_a, line.gradient_b
    near = np.hypot(away[rows], b[rows, 2] - a[rows, 2]) <= _NEAR
    result.found[rows] = near
    rows, ceiling = rows[~near], line.time[~near]
    if not rows.size:
        return
    distance = away[rows]
    toward = (b[rows, :2] - a[rows, :2]) / distance[:, None]
    best = np.full(rows.size, np.inf)
    # Upward is downward in the profile over height, where depths have the other sign.
    for nodes, sign in ((profile.nodes, 1.0), (profile.upward, -1.0)):
        ends = np.stack((-sign * a[rows, 2], -sign * b[rows, 2]))
        rays = _turn_down(nodes, np.sort(ends, axis=0), distance, ceiling)
        won = rays.time < best
        best[won] = rays.time[won]
        at = rows[won]
        result.time[at], result.found[at] = rays.time[won], True
        horizontal = rays.p[won, None] * toward[won]
        result.gradient_a[at, :2], result.gradient_b[at, :2] = -horizontal, horizontal
        of_a = np.where(ends[0] > ends[1], rays.vertical[1], rays.vertical[0])
        of_b = np.where(ends[0] > ends[1], rays.vertical[0], rays.vertical[1])
        result.gradient_a[at, 2], result.gradient_b[at, 2] = sign * of_a[won], sign * of_b[won]


def _complaint(
    profile: SoundSpeedProfile, depth: FloatArray, away: FloatArray, lost: IntArray
) -> str:
    first = lost[:1]
    z, c, _ = profile.nodes
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        thickness, speed = _stack(z, c, depth[:, first], np.interp(depth[:, first], z, c))
        fastest = np.maximum.reduce(speed)
        e = (fastest - speed) * (fastest + speed) / (fastest * fastest)
        reach = [_limit(e, thickness * (speed[:-1] + speed[1:]) / fastest)]
        anywhere = np.zeros(1), np.full(1, np.inf)
        for nodes, ends in (
            (profile.nodes, depth[:, first]),
            (profile.upward, -depth[::-1, first]),
        ):
            turns = _turns(nodes, ends, *anywhere)
            if turns is not None:
                reach += [turns.reach(share * turns.widest) for share in _SAMPLES[1:]]
    upper, lower, distance = depth[0, first[0]], depth[1, first[0]], away[first[0]]
    return (
        f"{lost.size} of {away.size} rows have no direct ray, first row {lost[0]}: depths "
        f"{upper:.6g} and {lower:.6g} m, {distance:.6g} m apart horizontally, where direct rays "
        f"reach {np.concatenate(reach).max():.6g} m at most; use missing='straight' to go on with "
        "the straight line there, or check the positions and the sound speed profile"
    )
