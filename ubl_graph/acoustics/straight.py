"""Travel times along straight lines, at the harmonic mean of the speed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ubl_graph.acoustics.profile import SoundSpeedProfile
from ubl_graph.arrays import BoolArray, FloatArray
from ubl_graph.errors import DataError


class TravelTimes(NamedTuple):
    """One-way travel times over M rows, and their gradients by both ends.

    Attributes
    ----------
    time : (M,) array
        s.
    gradient_a, gradient_b : (M, 3) arrays
        Derivatives of the time by the ends a and b, s/m, east-north-up.
    found : (M,) array of bool
        False where no direct ray joins the ends; always True for straight lines.
    """

    time: FloatArray
    gradient_a: FloatArray
    gradient_b: FloatArray
    found: BoolArray


def straight(profile: SoundSpeedProfile, a: ArrayLike, b: ArrayLike) -> TravelTimes:
    """Travel time along the straight line from a to b.

    ``time = |b - a| / c_h`` with the harmonic mean c_h of the speed over the depths of the line,
    which is the exact integral of ds/c along it. The gradients are the exact derivatives of that
    formula, so they hold d c_h / d depth too. Where a and b coincide they are zero in their
    horizontal part.

    Parameters
    ----------
    profile : SoundSpeedProfile
        Speed of sound over depth.
    a, b : (M, 3) or (3,) array_like
        Ends, m, east-north-up with up = -depth; a single point is joined to all of the other.

    Returns
    -------
    TravelTimes
        M rows, all of them found.

    Raises
    ------
    DataError
        If the shapes do not fit.

    Examples
    --------
    >>> line = straight(SoundSpeedProfile.constant(1500.0), [0.0, 0.0, 0.0], [900.0, 0.0, -1200.0])
    >>> line.time.tolist()
    [1.0]
    >>> (1500.0 * line.gradient_b).round(3).tolist()
    [[0.6, 0.0, -0.8]]
    """
    a, b = point_pairs(a, b)
    line = b - a
    distance = np.sqrt(np.einsum("ij,ij->i", line, line))
    # Coincident ends have no direction: 0 / 1e-300 makes it zero.
    away = np.maximum(distance, 1e-300)
    found = np.empty(distance.size, dtype=np.bool_)
    found.fill(True)
    if profile.is_constant:
        speed = profile.speed[0]
        gradient_b = line / (away * speed)[:, None]
        return TravelTimes(distance / speed, -gradient_b, gradient_b, found)
    depth_a, depth_b = -a[:, 2], -b[:, 2]
    swap = depth_a > depth_b
    if swap.any():
        mean = profile.mean_slowness(np.minimum(depth_a, depth_b), np.maximum(depth_a, depth_b))
        by_a = np.where(swap, mean.by_hi, mean.by_lo)
        by_b = np.where(swap, mean.by_lo, mean.by_hi)
    else:
        mean = profile.mean_slowness(depth_a, depth_b)
        by_a, by_b = mean.by_lo, mean.by_hi
    gradient_b = line * (mean.value / away)[:, None]
    gradient_a = -gradient_b
    gradient_a[:, 2] -= distance * by_a
    gradient_b[:, 2] -= distance * by_b
    return TravelTimes(distance * mean.value, gradient_a, gradient_b, found)


def point_pairs(a: ArrayLike, b: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return both ends as (M, 3) or (1, 3) arrays that broadcast together.

    Parameters
    ----------
    a, b : (M, 3) or (3,) array_like
        Points, m.

    Returns
    -------
    a, b : (M, 3) or (1, 3) arrays

    Raises
    ------
    DataError
        If a shape is another, or both have rows but not equally many.
    """
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if a.ndim == 1:
        a = a[None]
    if b.ndim == 1:
        b = b[None]
    if (
        a.ndim != 2
        or b.ndim != 2
        or a.shape[1] != 3
        or b.shape[1] != 3
        or (a.shape[0] != b.shape[0] and a.shape[0] != 1 and b.shape[0] != 1)
    ):
        raise DataError(
            f"the ends a and b have shapes {a.shape} and {b.shape}",
            "give (M, 3) arrays of east, north, up with equally many rows, or one point (3,)",
        )
    return a, b
