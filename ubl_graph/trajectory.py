"""Motion priors in continuous time, and the trajectory that they let us read at any time.

The prior of a node chain is a Gaussian process: white noise on acceleration (WNOA, the
"constant-velocity" model, order 2) or on jerk (WNOJ, "constant acceleration", order 3). Each
world axis is an independent process, so everything here is written for one axis with unit noise
density and scaled by the axis' density (m^2/s^3 or m^2/s^5) where it is used.

Source: Barfoot, State Estimation for Robotics, ch. 3.4 and 11; Xue 2024 for the window models
that these priors replace.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ubl_graph.arrays import ArrayLike, BoolArray, FloatArray, IntArray, frozen
from ubl_graph.errors import TimeError

Order = Literal[2, 3]

#: Times whose covariances are interpolated at once: joint covariances of pairs of nodes are big.
AT_ONCE = 16384


def transition(order: Order, dt: ArrayLike) -> FloatArray:
    """Transition matrix over `dt` (s) of [p, v] or [p, v, a] of one axis, (M, order, order)."""
    dt = np.atleast_1d(np.asarray(dt, dtype=np.float64))
    phi = np.broadcast_to(np.eye(order), (len(dt), order, order)).copy()
    phi[:, 0, 1] = dt
    if order == 3:
        phi[:, 1, 2] = dt
        phi[:, 0, 2] = dt**2 / 2.0
    return phi


def process_noise(order: Order, dt: ArrayLike) -> FloatArray:
    """Covariance that unit noise density adds over `dt` (s), shape (M, order, order).

    WNOA: [dt^3/3, dt^2/2; ., dt]. WNOJ: [dt^5/20, dt^4/8, dt^3/6; ., dt^3/3, dt^2/2; ., ., dt].
    """
    scale = _scale(order, dt)
    return scale[:, :, None] * _UNIT_NOISE[order] * scale[:, None, :]


def whitening(order: Order, dt: ArrayLike) -> FloatArray:
    """W with W Q W' = I for Q = process_noise(order, dt), shape (M, order, order).

    It is the inverse Cholesky factor of the unit-time covariance, scaled: as well conditioned
    for a millisecond as for an hour.
    """
    return _UNIT_WHITENING[order] / _scale(order, dt)[:, None, :]


def _scale(order: Order, dt: ArrayLike) -> FloatArray:
    """Powers of dt that carry the unit-time covariance to dt, shape (M, order)."""
    dt = np.atleast_1d(np.asarray(dt, dtype=np.float64))
    return dt[:, None] ** (np.arange(order - 1, -1, -1) + 0.5)


_UNIT_NOISE: dict[int, FloatArray] = {
    2: np.array([[1 / 3, 1 / 2], [1 / 2, 1]]),
    3: np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1]]),
}
_UNIT_WHITENING: dict[int, FloatArray] = {
    order: frozen(np.linalg.inv(np.linalg.cholesky(q))) for order, q in _UNIT_NOISE.items()
}


def interpolation_weights(
    order: Order, dt: ArrayLike, s: ArrayLike, derivative: Literal[0, 1] = 0
) -> FloatArray:
    """Weights of the end states in the prior's mean between two nodes.

    For WNOA the mean is the cubic Hermite polynomial, for WNOJ the quintic one.

    Parameters
    ----------
    order : 2 or 3
        WNOA or WNOJ.
    dt : array, shape (M,)
        Interval between the nodes, s.
    s : array, shape (M,)
        Where in the interval, 0 to 1.
    derivative : 0 or 1
        Weights of the position or of the velocity.

    Returns
    -------
    array, shape (M, 2 * order)
        Of p0, v0, (a0,) p1, v1, (a1). At s = 0 and s = 1 all but one are exactly zero.
    """
    s = np.asarray(s, dtype=np.float64)
    dt = np.asarray(dt, dtype=np.float64)
    powers = s[..., None] ** np.arange(2 * order)
    if derivative == 1:
        k = np.arange(1, 2 * order)
        slope = np.zeros_like(powers)
        slope[..., 1:] = k * powers[..., :-1]
        powers = slope / dt[..., None]
    node = dt[..., None] ** np.arange(order)
    return (powers @ _HERMITE[order]) * np.concatenate([node, node], axis=-1)


def _hermite_basis(order: int) -> FloatArray:
    """Coefficients (power of s, end state) of the Hermite polynomials on [0, 1]."""
    n = 2 * order
    ends = np.zeros((n, n))
    for derivative in range(order):
        for power in range(derivative, n):
            factor = np.prod(np.arange(power, power - derivative, -1), initial=1.0)
            ends[derivative, power] = factor if power == derivative else 0.0
            ends[order + derivative, power] = factor
    return frozen(np.round(np.linalg.inv(ends) * 2.0) / 2.0)  # all are multiples of a half


_HERMITE: dict[int, FloatArray] = {2: _hermite_basis(2), 3: _hermite_basis(3)}


def interpolation_variance(
    order: Order, dt: ArrayLike, s: ArrayLike, derivative: Literal[0, 1] = 0
) -> FloatArray:
    """Variance between two known nodes at unit noise density, shape (M,).

    With u = s (1 - s), of the position dt^3 u^3 / 3 for WNOA (dt^3/192 in the middle) and
    dt^5 u^5 / 20 for WNOJ; of the velocity dt (u - 3 u^2) and dt^3 (u^3 / 3 - 5 u^4 / 4).

    Parameters
    ----------
    order, dt, s, derivative
        As for `interpolation_weights`.
    """
    dt, u = np.asarray(dt, dtype=np.float64), np.asarray(s) * (1.0 - np.asarray(s))
    if order == 2:
        return dt * (u - 3.0 * u**2) if derivative else (dt * u) ** 3 / 3.0
    return dt**3 * (u**3 / 3.0 - 1.25 * u**4) if derivative else (dt * u) ** 5 / 20.0


def bridge_variance(dt: ArrayLike, s: ArrayLike, derivative: Literal[0, 1] = 0) -> FloatArray:
    """Variance between two known places whose velocities are free, at unit density, shape (M,).

    That of WNOA about the straight way: with u = s (1 - s), of the position dt^3 u^2 / 3, 4 times
    as much in the middle as where velocities are known, and of the velocity dt (1/3 - u).
    """
    dt, u = np.asarray(dt, dtype=np.float64), np.asarray(s) * (1.0 - np.asarray(s))
    return dt * (1.0 / 3.0 - u) if derivative else dt**3 * u**2 / 3.0


def interpolation_covariance(order: Order, dt: float, s: float) -> FloatArray:
    """Covariance of the whole state between two known nodes at unit density, (order, order).

    Parameters
    ----------
    order : 2 or 3
        WNOA or WNOJ.
    dt : float
        Interval, s.
    s : float
        Where in it, 0 to 1.
    """
    part = process_noise(order, s * dt)[0]
    onward = transition(order, (1.0 - s) * dt)[0]
    w = whitening(order, dt)[0] @ onward @ part
    return part - w.T @ w


def longest_interval(order: Order, psd: float, sd: float) -> float:
    """Longest node interval (s) over which the interpolation's sd in the middle stays under `sd`.

    Inverse of `interpolation_variance` at s = 1/2 for noise density `psd`; `sd` in metres.
    """
    return (192.0 * sd**2 / psd) ** (1 / 3) if order == 2 else (20480.0 * sd**2 / psd) ** (1 / 5)


@dataclass(frozen=True, eq=False)
class States:
    """What a trajectory says at some times.

    Attributes
    ----------
    t : array, shape (M,)
        Seconds.
    position, velocity : array, shape (M, 3)
        East, north, up; m and m/s.
    covariance : array, shape (M, 3, 3)
        Of the position, m^2.
    velocity_covariance : array, shape (M, 3, 3)
        Of the velocity, (m/s)^2; nan where the trajectory does not know it (dead reckoning).
    """

    t: FloatArray
    position: FloatArray
    velocity: FloatArray
    covariance: FloatArray
    velocity_covariance: FloatArray


@dataclass(frozen=True, eq=False)
class NodeCovariance:
    """Joint covariances of the nodes' kinematic states, and of neighbours.

    A state is position, velocity and, where the prior is WNOJ, acceleration: S = 6 or 9; m, s.

    Attributes
    ----------
    node : array, shape (N, S, S)
        Of each node.
    following : array, shape (N - 1, S, S)
        Of each node (rows) with the next one (columns).
    """

    node: FloatArray
    following: FloatArray

    def pairs(self, k: IntArray) -> FloatArray:
        """Joint covariance of the nodes k (M,) and k + 1, shape (M, 2 S, 2 S)."""
        cross = self.following[k]
        upper = np.concatenate([self.node[k], cross], axis=2)
        lower = np.concatenate([np.swapaxes(cross, 1, 2), self.node[k + 1]], axis=2)
        return np.concatenate([upper, lower], axis=1)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Smoothed trajectory of one segment: its nodes, and the prior's mean between them.

    Attributes
    ----------
    t : array, shape (N,)
        Node times, s, strictly increasing.
    position, velocity : array, shape (N, 3)
        East, north, up; m and m/s.
    acceleration : array, shape (N, 3), or None
        m/s^2, where the prior is WNOJ.
    covariance : array, shape (N, 3, 3)
        Marginal covariance of each node's position, m^2.
    psd : tuple of float
        Horizontal and vertical noise density of the prior.
    joint : NodeCovariance, optional
        Covariances of whole states and of neighbours; a smoothed trajectory has them.
    """

    t: FloatArray
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray | None
    covariance: FloatArray
    psd: tuple[float, float]
    joint: NodeCovariance | None = None

    @property
    def order(self) -> Order:
        """2 for WNOA, 3 for WNOJ."""
        return 2 if self.acceleration is None else 3

    def at(self, times: ArrayLike) -> States:
        """Position and velocity with their covariances at any times of the trajectory's span.

        Parameters
        ----------
        times : float or array, shape (M,)
            Seconds, in any order.

        Returns
        -------
        States
            At a node its own values. Between two nodes the mean is the prior's; the covariance
            is that of the two nodes together, carried through the interpolation, plus the
            prior's own between known nodes. Where there is no `joint`, the position's covariance
            is interpolated linearly instead.

        Raises
        ------
        TimeError
            Where a time is not finite or outside the span, or `times` has two dimensions.
        """
        times = self.checked(times)
        k, dt, s = locate(self.t, times)
        position = self._mean(k, dt, s, 0)
        velocity = self._mean(k, dt, s, 1)
        covariance = [self._spread(k, dt, s, 0), self._spread(k, dt, s, 1)]
        return States(times, position, velocity, *covariance)

    def checked(self, times: ArrayLike) -> FloatArray:
        """Times as an array (M,), all of them within the span.

        Raises
        ------
        TimeError
            As `at` does.
        """
        times = np.atleast_1d(np.asarray(times, dtype=np.float64))
        if times.ndim != 1:
            raise TimeError(f"times have {times.ndim} dimensions; give one time or a list of them")
        outside = ~((times >= self.t[0]) & (times <= self.t[-1]))
        if outside.any():
            raise TimeError(
                f"t = {times[np.argmax(outside)]} s is outside the trajectory, "
                f"{self.t[0]} to {self.t[-1]} s"
            )
        return times

    def _spread(
        self, k: IntArray, dt: FloatArray, s: FloatArray, derivative: Literal[0, 1]
    ) -> FloatArray:
        """Covariance of position or velocity at (k, s): (M, 3, 3)."""
        out = self._by_nodes(k, dt, s, derivative)
        horizontal, vertical = self.psd
        own = interpolation_variance(self.order, dt, s, derivative)
        diagonal = np.arange(3)
        out[:, diagonal, diagonal] += own[:, None] * [horizontal, horizontal, vertical]
        return out

    def _by_nodes(
        self, k: IntArray, dt: FloatArray, s: FloatArray, derivative: Literal[0, 1]
    ) -> FloatArray:
        """What the nodes' errors make of it."""
        if self.joint is None:
            if derivative:
                return np.full((len(k), 3, 3), np.nan)
            w, after = s[:, None, None], np.minimum(k + 1, len(self.t) - 1)
            return (1.0 - w) * self.covariance[k] + w * self.covariance[after]
        if len(self.t) == 1:
            own = slice(3 * derivative, 3 * derivative + 3)
            return self.joint.node[k, own, own]
        weights = interpolation_weights(self.order, dt, s, derivative)
        out = np.empty((len(k), 3, 3))
        for first in range(0, len(k), AT_ONCE):
            rows = slice(first, first + AT_ONCE)
            states = 2 * self.order
            pairs = self.joint.pairs(k[rows]).reshape(-1, states, 3, states, 3)
            half = np.einsum("mi,miajb->majb", weights[rows], pairs)
            out[rows] = np.einsum("majb,mj->mab", half, weights[rows])
        return out

    def _mean(
        self, k: IntArray, dt: FloatArray, s: FloatArray, derivative: Literal[0, 1]
    ) -> FloatArray:
        if len(self.t) == 1:
            return (self.velocity if derivative else self.position)[k]
        parts = [self.position, self.velocity]
        if self.acceleration is not None:
            parts.append(self.acceleration)
        ends = np.stack([p[k] for p in parts] + [p[k + 1] for p in parts], axis=1)
        weights = interpolation_weights(self.order, dt, s, derivative)
        return np.einsum("mw,mwa->ma", weights, ends)


def locate(nodes: FloatArray, times: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Interval of each time among node times.

    Parameters
    ----------
    nodes : array, shape (N,)
        Strictly increasing, s.
    times : array, shape (M,)
        Within the nodes' span, s.

    Returns
    -------
    k : array of int, shape (M,)
        Node before; k + 1 is the one after. With a single node all are 0.
    dt : array, shape (M,)
        Length of the interval, s (1 with a single node).
    s : array, shape (M,)
        Where in the interval, exactly 0 or 1 within a nanosecond of a node.
    """
    if len(nodes) == 1:
        zero = np.zeros(len(times))
        return zero.astype(np.int64), zero + 1.0, zero
    k = np.clip(np.searchsorted(nodes, times, side="right") - 1, 0, len(nodes) - 2)
    dt = nodes[k + 1] - nodes[k]
    elapsed = times - nodes[k]
    s = np.where(elapsed < 1e-9, 0.0, np.where(dt - elapsed < 1e-9, 1.0, elapsed / dt))
    return k, dt, s


def inside(nodes: FloatArray, times: FloatArray) -> BoolArray:
    """Which times lie within the nodes' span (to a nanosecond)."""
    return (times >= nodes[0] - 1e-9) & (times <= nodes[-1] + 1e-9)
