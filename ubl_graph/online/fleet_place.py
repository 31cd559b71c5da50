"""Where something is that nothing places yet: least squares from many starts at once.

A vehicle without a start is its odometry's path, rigid, of which place and heading are unknown; a
target is a point. Ranges alone often leave a mirror image: both are found, and nothing is placed
until one of them is clearly worse.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ubl_graph.arrays import FloatArray

#: Steps of the search, and of a derivative (m, rad, m/s alike).
STEPS, DELTA = 40, 1e-4
#: Squared pull, in standard deviations, of a place where a search has come to rest.
AT_REST = 1e-2
#: Half the difference of chi-squares by which a place is clearly better than another.
CLEARLY = 8.0
#: Places nearer to each other than so many standard deviations are one.
SAME_SIGMAS = 5.0

#: Whitened residuals (S, N) of S trial values (S, Q).
Residuals = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, eq=False)
class Place:
    """The best of some places.

    Attributes
    ----------
    value : array, shape (Q,)
        What the residuals are least at.
    covariance : array, shape (Q, Q)
        Of it.
    rival : array, shape (Q,), or None
        Another that is not clearly worse.
    """

    value: FloatArray
    covariance: FloatArray
    rival: FloatArray | None


def placed(residuals: Residuals, starts: FloatArray, angle: int | None = None) -> Place | None:
    """The least squares' best place; None where none is determined.

    Parameters
    ----------
    residuals : callable
        Whitened.
    starts : array, shape (S, Q)
        Where the search begins.
    angle : int, optional
        Which component full turns make no difference to, rad.
    """
    x = starts.copy()
    count, size = x.shape
    damping = np.full(count, 1e-3)
    value = residuals(x)
    cost = _half(value)
    for _ in range(STEPS):
        slope = _slopes(residuals, x, value)
        normal = np.swapaxes(slope, 1, 2) @ slope
        gradient = np.einsum("snq,sn->sq", slope, value)
        scale = np.maximum(np.einsum("sqq->sq", normal), 1e-12)
        damped = normal + (damping[:, None] * scale)[:, :, None] * np.eye(size)
        step = -np.linalg.solve(damped, gradient[:, :, None])[:, :, 0]
        trial = x + step
        there = residuals(trial)
        better = _half(there) < cost
        x[better], value[better] = trial[better], there[better]
        cost[better] = _half(there)[better]
        damping = np.where(better, 0.2 * damping, 10.0 * damping).clip(1e-9, 1e9)
    best = int(np.argmin(cost))
    slopes = _slopes(residuals, x, value)
    slope = slopes[best]
    normal = slope.T @ slope
    scale = np.sqrt(np.maximum(normal.diagonal(), 1e-300))
    scaled = normal / np.outer(scale, scale)
    if np.linalg.eigvalsh(scaled)[0] < 1e-10 or not np.isfinite(cost[best]):
        return None
    covariance = np.linalg.inv(scaled) / np.outer(scale, scale)
    off = x - x[best]
    if angle is not None:
        off[:, angle] = np.remainder(off[:, angle] + np.pi, 2.0 * np.pi) - np.pi
    apart = np.einsum("sq,qr,sr->s", off, normal, off) > SAME_SIGMAS**2
    # What has not come to rest is no place of its own.
    pull = np.einsum("snq,sn->sq", slopes, value)
    rest = np.einsum("sq,sq->s", pull, pull / np.einsum("snq,snq->sq", slopes, slopes)) < AT_REST
    near = np.flatnonzero(apart & rest & (cost < cost[best] + CLEARLY))
    rival = x[near[np.argmin(cost[near])]] if len(near) else None
    return Place(x[best], covariance, rival)


def _half(value: FloatArray) -> FloatArray:
    return 0.5 * np.einsum("sn,sn->s", value, value)


def _slopes(residuals: Residuals, x: FloatArray, value: FloatArray) -> FloatArray:
    """Derivatives (S, N, Q) by forward differences."""
    columns: list[FloatArray] = []
    for q in range(x.shape[1]):
        moved = x.copy()
        moved[:, q] += DELTA
        columns.append((residuals(moved) - value) / DELTA)
    return np.stack(columns, axis=2)
