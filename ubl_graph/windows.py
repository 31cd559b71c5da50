"""Fits of one short window of pings from many starts at once.

In a window the vehicle moves along what dead reckoning says plus a constant velocity or, where
the motion prior is that of constant acceleration, a constant acceleration,

    p(t) = d(t) + p0 + v s + a s^2 / 2,  s = t - t_mid,

with d(t) the DVL's displacement (zero without one) and, where depth is known, its up in place of
d's. Unknown are p0, v, a, the log scale g of the travel times and the clock offset.
Gauss-Newton with Marquardt's damping runs from many starts side by side, all in one array, along
straight rays; what converges to distinct places are the window's hypotheses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ubl_graph.acoustics import SoundSpeedProfile, straight
from ubl_graph.arrays import BoolArray, FloatArray, IntArray, frozen
from ubl_graph.factors.loss import WIDTHS

#: Columns of a fit's parameters.
EAST_NORTH_UP, VELOCITY, ACCELERATION = slice(0, 3), slice(3, 6), slice(6, 9)
SCALE, CLOCK = 9, 10
PARAMETERS = 11

#: Directions around a beacon in which starts are laid on its range circle.
AZIMUTHS = 16
ITERATIONS = 40
#: A one-way range longer than this may be mostly clock offset, s.
LONG_FLIGHT = 3.0
#: Hypotheses kept for a window in any case,
KEPT = 6
#: and more of them where so little tells them apart (one beacon and no heading: a whole circle).
VALLEY_COST, MOST_KEPT = 10.0, 48
#: Cauchy width, in sigmas, of the windows' residuals.
WIDTH = WIDTHS["cauchy"]


@dataclass(frozen=True, eq=False)
class Sightings:
    """Ranges (M rows, two legs each) and fixes (F rows) of a window or of a whole segment.

    Attributes
    ----------
    t : array, shape (M, 2)
        Time of each leg, s; a one-way range has its receive time twice.
    share : array, shape (M, 2)
        How often a leg counts: 1 and 1 for two-way, 1 and 0 for one-way ranges.
    offset : array, shape (M, 2, 3)
        Transducer's displacement by dead reckoning (and its up where depth is known), m.
    beacon : array, shape (M, 3)
        East, north, up, m.
    measured, sigma : array, shape (M,)
        Travel time and its standard deviation, s.
    clock : array, shape (M,)
        1 where the clock offset counts (one-way), else 0.
    fix_t : array, shape (F,)
        s.
    fix, fix_offset : array, shape (F, 3)
        Fixed position and displacement by dead reckoning, m.
    fix_sigma : array, shape (F, 3)
        m; infinite for a component that a fix lacks.
    """

    t: FloatArray
    share: FloatArray
    offset: FloatArray
    beacon: FloatArray
    measured: FloatArray
    sigma: FloatArray
    clock: FloatArray
    fix_t: FloatArray
    fix: FloatArray
    fix_offset: FloatArray
    fix_sigma: FloatArray

    def select(self, rows: BoolArray, fixes: BoolArray) -> Sightings:
        """Pick some of the ranges and some of the fixes."""
        columns = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return Sightings(
            **{n: a[fixes if n.startswith("fix") else rows] for n, a in columns.items()}
        )


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known of a window's parameters before its pings: mean and standard deviation."""

    mean: FloatArray
    sigma: FloatArray


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Distinct answers to a window, best first.

    Attributes
    ----------
    t : float
        Middle of the window, s.
    parameters : array, shape (H, 11)
        East, north, up (m), velocity (m/s), acceleration (m/s^2), log scale, clock offset (s)
        at `t`.
    covariance : array, shape (H, 11, 11)
        Of the parameters.
    cost : array, shape (H,)
        Cauchy cost of ranges and fixes, and half the prior's square.
    """

    t: float
    parameters: FloatArray
    covariance: FloatArray
    cost: FloatArray

    def select(self, rows: IntArray | BoolArray) -> Hypotheses:
        """Some of the hypotheses."""
        return Hypotheses(self.t, self.parameters[rows], self.covariance[rows], self.cost[rows])


def fit(
    profile: SoundSpeedProfile,
    sightings: Sightings,
    t_mid: float,
    prior: Prior,
    model_sigma: float,
    extra: FloatArray | None = None,
) -> Hypotheses:
    """Fit a window from starts all around and return its distinct minima.

    Parameters
    ----------
    profile : SoundSpeedProfile
        For straight-line travel times.
    sightings : Sightings
        Of the window; at least one range or fix.
    t_mid : float
        Reference time of the parameters, s.
    prior : Prior
        Over the parameters.
    model_sigma : float
        What the vehicle's real motion may deviate from the window's by, m.
    extra : array, shape (K, 11), optional
        Further starts (from the neighbouring window).

    Returns
    -------
    Hypotheses
    """
    starts = _starts(profile, sightings, prior)
    if extra is not None:
        starts = np.concatenate([extra, starts])
    system = _System(profile, sightings, t_mid, prior, model_sigma)
    theta, cost, hessian = _levenberg_marquardt(system, starts)
    return _distinct(t_mid, theta, cost, hessian, model_sigma)


def _starts(profile: SoundSpeedProfile, s: Sightings, prior: Prior) -> FloatArray:
    """Parameters on the range circles of a few pings, and on the fixes; shape (S, 11)."""
    starts: list[FloatArray] = []
    for row in np.unique(np.linspace(0, len(s.t) - 1, 3).astype(int)) if len(s.t) else []:
        speed = float(profile.harmonic_mean(-s.offset[row, 0, 2], -s.beacon[row, 2]))
        for up in _start_levels(s, row, prior):
            drop = s.offset[row, 0, 2] + up - s.beacon[row, 2]
            for flight, clock in _start_flights(s, row, prior, abs(drop) / speed):
                reach = np.sqrt(max((flight * speed) ** 2 - drop**2, (0.05 * flight * speed) ** 2))
                angle = 2.0 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS
                theta = np.tile(prior.mean, (AZIMUTHS, 1))
                theta[:, 0] = s.beacon[row, 0] - s.offset[row, 0, 0] + reach * np.sin(angle)
                theta[:, 1] = s.beacon[row, 1] - s.offset[row, 0, 1] + reach * np.cos(angle)
                theta[:, 2] = up
                theta[:, CLOCK] = clock
                starts.append(theta)
    if len(s.fix_t):
        theta = prior.mean.copy()
        theta[:2] = np.mean((s.fix - s.fix_offset)[:, :2], axis=0)
        starts.append(theta[None])
    return np.concatenate(starts)


def _start_flights(
    s: Sightings, row: int, prior: Prior, straight_up: float
) -> list[tuple[float, float]]:
    """Times of flight to start at, each with its clock offset, s.

    A one-way range holds the clock offset too. Where it is longer than sound takes over 4.5 km, the
    offset may be most of it: then flights of one and a half and of three times the way straight up
    are tried as well.
    """
    measured = float(s.measured[row])
    if not s.clock[row]:
        return [(measured / s.share[row].sum(), float(prior.mean[CLOCK]))]
    flights = [(abs(measured - prior.mean[CLOCK]), float(prior.mean[CLOCK]))]
    if abs(measured) > LONG_FLIGHT or measured < 0.0:
        flights += [(f, measured - f) for f in (1.5 * straight_up + 0.1, 3.0 * straight_up + 0.3)]
    return flights


def _start_levels(s: Sightings, row: int, prior: Prior) -> list[float]:
    """Ups to start at: the known one, or surface, middle and the beacon's level."""
    if prior.sigma[2] < 100.0:
        return [float(prior.mean[2])]
    return [0.0, 0.5 * float(s.beacon[row, 2]), float(s.beacon[row, 2]) + 5.0]


class _System:
    """Normal equations of S parameter vectors at once."""

    def __init__(
        self,
        profile: SoundSpeedProfile,
        s: Sightings,
        t_mid: float,
        prior: Prior,
        model_sigma: float,
    ) -> None:
        self.profile, self.s, self.prior = profile, s, prior
        self.dt = s.t - t_mid
        self.fix_dt = s.fix_t - t_mid
        self.bend, self.fix_bend = 0.5 * self.dt**2, 0.5 * self.fix_dt**2
        slowness = s.share.sum(axis=1) / 1500.0
        self.inverse = 1.0 / np.hypot(s.sigma, slowness * model_sigma)
        self.fix_inverse = 1.0 / np.hypot(s.fix_sigma, model_sigma)
        self.legs_beacon = np.repeat(s.beacon[:, None, :], 2, axis=1)

    def evaluate(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Cost (S,), gradient (S, 11) and Gauss-Newton Hessian (S, 11, 11)."""
        residual, jacobian = self._ranges(theta)
        fixes, fix_jacobian = self._fixes(theta)
        residual = np.concatenate([residual, fixes], axis=1)
        jacobian = np.concatenate([jacobian, fix_jacobian], axis=1)
        q = (residual / WIDTH) ** 2
        weight = 1.0 / (1.0 + q)
        off = (theta - self.prior.mean) / self.prior.sigma
        cost = 0.5 * WIDTH**2 * np.log1p(q).sum(axis=1) + 0.5 * (off**2).sum(axis=1)
        weighted = weight[..., None] * jacobian
        gradient = (weighted * residual[..., None]).sum(axis=1) + off / self.prior.sigma
        hessian = np.swapaxes(weighted, 1, 2) @ jacobian + np.diag(self.prior.sigma**-2.0)
        return cost, gradient, hessian

    def _ranges(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        s = self.s
        n_starts, m = len(theta), len(s.t)
        position = (
            theta[:, None, None, EAST_NORTH_UP]
            + theta[:, None, None, VELOCITY] * self.dt[None, :, :, None]
            + theta[:, None, None, ACCELERATION] * self.bend[None, :, :, None]
            + s.offset[None]
        )
        beacon = np.broadcast_to(self.legs_beacon, position.shape)
        travel = straight(self.profile, position.reshape(-1, 3), beacon.reshape(-1, 3))
        scale = np.exp(theta[:, SCALE])[:, None, None]
        times = travel.time.reshape(n_starts, m, 2) * scale * s.share
        slopes = travel.gradient_a.reshape(n_starts, m, 2, 3) * (scale * s.share)[..., None]
        # Two legs: adding them is many times faster than numpy's sum over so short an axis.
        total = times[..., 0] + times[..., 1]
        residual = (total + s.clock * theta[:, CLOCK, None] - s.measured) * self.inverse
        jacobian = np.empty((n_starts, m, PARAMETERS))
        jacobian[..., EAST_NORTH_UP] = slopes[..., 0, :] + slopes[..., 1, :]
        for columns, factor in ((VELOCITY, self.dt), (ACCELERATION, self.bend)):
            legs = slopes * factor[..., None]
            jacobian[..., columns] = legs[..., 0, :] + legs[..., 1, :]
        jacobian[..., SCALE] = total
        jacobian[..., CLOCK] = s.clock
        return residual, jacobian * self.inverse[:, None]

    def _fixes(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        s = self.s
        n_starts, f = len(theta), len(s.fix_t)
        position = (
            theta[:, None, EAST_NORTH_UP]
            + theta[:, None, VELOCITY] * self.fix_dt[:, None]
            + theta[:, None, ACCELERATION] * self.fix_bend[:, None]
            + s.fix_offset
        )
        residual = (position - s.fix) * self.fix_inverse
        jacobian = np.zeros((f, 3, PARAMETERS))
        axis = np.arange(3)
        jacobian[:, axis, axis] = self.fix_inverse
        jacobian[:, axis, 3 + axis] = self.fix_inverse * self.fix_dt[:, None]
        jacobian[:, axis, 6 + axis] = self.fix_inverse * self.fix_bend[:, None]
        rows = jacobian.reshape(1, 3 * f, PARAMETERS)
        return residual.reshape(n_starts, 3 * f), np.repeat(rows, n_starts, axis=0)


def _levenberg_marquardt(
    system: _System, theta: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Run all starts side by side; parameters, costs and Hessians where they ended."""
    damping = np.full(len(theta), 1e-3)
    cost, gradient, hessian = system.evaluate(theta)
    active = np.arange(len(theta))
    diagonal = np.arange(PARAMETERS)
    for _ in range(ITERATIONS):
        damped = hessian[active]
        damped[:, diagonal, diagonal] *= 1.0 + damping[active, None]
        step = np.linalg.solve(damped, gradient[active][..., None])[..., 0]
        trial = theta[active] - step
        c, g, h = system.evaluate(trial)
        better = c < cost[active]
        done = better & (cost[active] - c < 1e-3)
        won = active[better]
        for held, new in ((theta, trial), (cost, c), (gradient, g), (hessian, h)):
            held[won] = new[better]
        damping[active] = np.where(better, damping[active] / 10.0, damping[active] * 10.0)
        active = active[~done & (damping[active] < 1e8)]
        if not len(active):
            break
    return theta, cost, hessian


def _distinct(
    t_mid: float, theta: FloatArray, cost: FloatArray, hessian: FloatArray, tolerance: float
) -> Hypotheses:
    """Best first, one of each place: places nearer than the model's own error are one."""
    kept: list[int] = []
    # A tie in cost is broken by the start's number: the same data give the same order.
    for i in np.argsort(cost, kind="stable"):
        gaps = np.linalg.norm(theta[kept, :3] - theta[i, :3], axis=1) if kept else np.empty(0)
        if not (gaps < max(5.0, 3.0 * tolerance)).any():
            kept.append(int(i))
        close = cost[i] < cost[kept[0]] + VALLEY_COST
        if len(kept) >= (MOST_KEPT if close else KEPT):
            break
    return Hypotheses(t_mid, theta[kept], frozen(np.linalg.inv(hessian[kept])), cost[kept])
