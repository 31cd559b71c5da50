"""Travel times along refracted rays (eigenrays) through a layered ocean.

The direct ray is sought among those that do not turn (`rays`); where the ends are farther apart
than these reach, among those that turn once (`turning`).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ubl_graph.acoustics.profile import SoundSpeedProfile
from ubl_graph.acoustics.rays import direct_rays, direct_reach, stack
from ubl_graph.acoustics.straight import TravelTimes, point_pairs, straight
from ubl_graph.acoustics.turning import SAMPLES, turning_rays, turns_below
from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.errors import ConfigurationError, NoDirectRayError

_CHUNK = 32768  # elements (layers times rows) worked on at once: the arrays stay in the L2 cache
_NEAR = 1e-3  # level ends so near, m, are joined straight: a gradient of 0.1/s changes 2e-16
_LEVEL = 1e-8  # ends whose depths differ by less, m, are level; no time changes by over 1e-11 s


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
    level = np.abs(line[:, 2]) < _LEVEL
    if level.any():
        # The speeds at such ends may differ by rounding alone, which would hide the gradient.
        a, b = np.broadcast_to(a, line.shape), np.broadcast_to(b, line.shape).copy()
        b[level, 2] = a[level, 2]
        line = b - a
    away = np.hypot(line[:, 0], line[:, 1])
    depth_a, depth_b = -a[:, 2], -b[:, 2]
    depth = np.empty((2, rows))
    np.minimum(depth_a, depth_b, out=depth[0])
    np.maximum(depth_a, depth_b, out=depth[1])
    chunk = max(1, _CHUNK // (profile.nodes.depth.size + 2))
    # A row that makes nan or infinity in the plain search goes to the careful one.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if rows <= chunk:
            (time, p, vertical), hard = direct_rays(profile, depth, away)
        else:
            parts = [
                direct_rays(profile, depth[:, k : k + chunk], away[k : k + chunk])
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
        rays = turning_rays(nodes, np.sort(ends, axis=0), distance, ceiling)
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
        thickness, speed = stack(z, c, depth[:, first], np.interp(depth[:, first], z, c))
        fastest = np.maximum.reduce(speed)
        e = (fastest - speed) * (fastest + speed) / (fastest * fastest)
        reach = [direct_reach(e, thickness * (speed[:-1] + speed[1:]) / fastest)]
        anywhere = np.zeros(1), np.full(1, np.inf)
        for nodes, ends in (
            (profile.nodes, depth[:, first]),
            (profile.upward, -depth[::-1, first]),
        ):
            turns = turns_below(nodes, ends, *anywhere)
            if turns is not None:
                reach += [turns.reach(share * turns.widest) for share in SAMPLES[1:]]
    upper, lower, distance = depth[0, first[0]], depth[1, first[0]], away[first[0]]
    return (
        f"{lost.size} of {away.size} rows have no direct ray, first row {lost[0]}: depths "
        f"{upper:.6g} and {lower:.6g} m, {distance:.6g} m apart horizontally, where direct rays "
        f"reach {np.concatenate(reach).max():.6g} m at most; use missing='straight' to go on with "
        "the straight line there, or check the positions and the sound speed profile"
    )
