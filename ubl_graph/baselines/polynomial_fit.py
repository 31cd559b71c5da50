"""Gauss-Newton for polynomial tracks in windows of two-way pings, all windows side by side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ubl_graph.arrays import BoolArray, FloatArray, IntArray
from ubl_graph.mission import Reference
from ubl_graph.observability import dops
from ubl_graph.reckoning import DeadReckoning

#: Gauss-Newton stops where no place in the window moves by more than this, m,
STEP_TOLERANCE = 1e-7
#: and gives up after so many iterations, or farther away than this, m.
MOST_ITERATIONS, FARTHEST = 100, 1e6
#: Least share of a step that is taken.
LEAST_SHARE = 0.1
#: A window is singular where a parameter changes all ranges by less than this share of the others.
SINGULAR = 1e-10


@dataclass(frozen=True, eq=False)
class Pings:
    """Pings of a segment in order of emission.

    Attributes
    ----------
    t : array, shape (M, 2)
        Emission and reception, s.
    beside : array, shape (M, 2, 2)
        Transducer's east and north from the vehicle's reference point, minus the beacon's, m.
    drop : array, shape (M, 2)
        Height of the transducer above the beacon, m.
    slowness : array, shape (M, 2)
        Mean of 1/c over the depths between, relative to that of the ping as a whole.
    length : array, shape (M,)
        L = c T, m.
    reckoning : DeadReckoning
        Knows the depth at any time.
    """

    t: FloatArray
    beside: FloatArray
    drop: FloatArray
    slowness: FloatArray
    length: FloatArray
    reckoning: DeadReckoning

    def __len__(self) -> int:
        return len(self.t)


class PolynomialFit:
    """Gauss-Newton on all windows side by side; theta is (W, 2, q + 1), in half windows.

    Parameters
    ----------
    pings : Pings
        Of the segment.
    index : array of int, shape (W, m)
        Pings of each window.
    used : array of bool, shape (W, m)
        Which of these count: windows are filled up to the longest.
    order : int
        Of the polynomial.
    epoch, half : array, shape (W,)
        Reference time and half the length of each window, s.
    """

    def __init__(
        self,
        pings: Pings,
        index: IntArray,
        used: BoolArray,
        order: int,
        epoch: FloatArray,
        half: FloatArray,
    ) -> None:
        self.pings, self.index, self.used, self.order = pings, index, used, order
        scaled = (pings.t[index] - epoch[:, None, None]) / half[:, None, None]
        self.basis = scaled[..., None] ** np.arange(order + 1)  # (W, m, 2, q + 1)
        self.width = 2 * (order + 1)

    def along(self, track: Reference) -> FloatArray:
        """Polynomials through a track at the times of each window's pings."""
        times = self.pings.t[self.index]
        place = np.stack(
            [np.interp(times, track.t, track.position[:, axis]) for axis in (0, 1)], axis=-1
        )
        count, legs = len(times), self.used.shape[1] * 2
        weight = np.repeat(self.used, 2, axis=1)[..., None]
        rows = self.basis.reshape(count, legs, self.order + 1) * weight
        target = place.reshape(count, legs, 2) * weight
        return np.swapaxes(np.linalg.pinv(rows) @ target, 1, 2)

    def system(self, theta: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (R, m), measured minus modelled, and design matrices (R, m, 2 (q + 1)), m."""
        index, basis, used = self.index[rows], self.basis[rows], self.used[rows]
        p = self.pings
        place = np.einsum("wgi,wmli->wmlg", theta, basis) + p.beside[index]
        reach = np.sqrt((place**2).sum(axis=-1) + p.drop[index] ** 2)
        slowness = p.slowness[index]
        residual = p.length[index] - (slowness * reach).sum(axis=-1)
        cosines = place * (slowness / reach)[..., None]
        design = np.einsum("wmlg,wmli->wmgi", cosines, basis)
        design = design.reshape(*index.shape, self.width)
        return residual * used, design * used[..., None]

    def solve(self, theta: FloatArray) -> tuple[FloatArray, IntArray, BoolArray]:
        """Iterate from `theta`; where it ended, iterations (W,), and which windows are solved."""
        theta = theta.copy()
        iterations = np.zeros(len(theta), dtype=np.int64)
        solved = np.zeros(len(theta), dtype=np.bool_)
        share = np.ones(len(theta))
        active = np.flatnonzero(self.used.sum(axis=1) > self.width)
        for _ in range(MOST_ITERATIONS):
            residual, design = self.system(theta[active], active)
            q, r = np.linalg.qr(design)
            sound = ~_singular(r)
            active, r, residual = active[sound], r[sound], residual[sound]
            along = np.swapaxes(q[sound], 1, 2) @ residual[..., None]
            step = np.linalg.solve(r, along).reshape(-1, 2, self.order + 1)
            whole, _ = self.system(theta[active] + step, active)
            share[active] = _share(
                (residual**2).sum(axis=1),
                (along**2).sum(axis=(1, 2)),
                (whole**2).sum(axis=1),
                share[active],
            )
            step *= share[active, None, None]
            iterations[active] += 1
            theta[active] += step
            # On -1 to 1 no power exceeds 1: the coefficients bound what any place moves by.
            done = np.abs(step).sum(axis=(1, 2)) < STEP_TOLERANCE
            solved[active[done]] = True
            near = np.abs(theta[active]).max(axis=(1, 2), initial=0.0) < FARTHEST
            active = active[~done & near]
            if not len(active):
                break
        return theta, iterations, solved

    def dops(self, theta: FloatArray, solved: BoolArray) -> FloatArray:
        """Dilution of precision of each power, (W, q + 1), nan where a window is not solved."""
        out = np.full((len(theta), self.order + 1), np.nan)
        rows = np.flatnonzero(solved)
        _, design = self.system(theta[rows], rows)
        if self.order == 0:
            design = 0.5 * design  # l = L / 2
        for power in range(self.order + 1):
            columns = [power, self.order + 1 + power]
            out[rows, power] = dops(design, {"position": columns}).position
        return out


def _share(
    cost: FloatArray, slope: FloatArray, whole: FloatArray, before: FloatArray
) -> FloatArray:
    """Share of each step to take: to the lowest point of a parabola along it.

    It is 1 where the ranges are nearly linear. Where a polynomial fits badly, as straight windows
    do a spiral, whole steps go round in circles.

    Parameters
    ----------
    cost, whole : array, shape (R,)
        Sum of squares before the step, and after a whole one.
    slope : array, shape (R,)
        What linear ranges would lower it by.
    before : array, shape (R,)
        Share of the last step: it holds where the sums differ by rounding alone.
    """
    bend = whole - cost + 2.0 * slope
    clear = (slope > 1e-8 * cost) & (bend > 0.0)
    return np.where(clear, np.clip(slope / np.where(clear, bend, 1.0), LEAST_SHARE, 1.0), before)


def _singular(r: FloatArray) -> BoolArray:
    """Which upper triangles (W, P, P) are singular or not finite."""
    size = np.abs(np.einsum("wii->wi", r))
    return ~(size.min(axis=1) > SINGULAR * size.max(axis=1))
