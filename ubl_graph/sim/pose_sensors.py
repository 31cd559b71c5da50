"""Simulated sensors of vehicles that carry a heading: compass, gyros, odometry.

As in `ubl_graph.sim.sensors`, `noise` multiplies the standard deviation that the records or the
options state.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ubl_graph.arrays import ArrayLike, FloatArray
from ubl_graph.measurements import (
    ANGULAR_RATE_SIGMA,
    HEADING_SIGMA,
    AngularRate,
    Heading,
    Odometry,
)
from ubl_graph.options import Options
from ubl_graph.sim.tracks import Truth

#: Forward, left, up into forward, right, down, and back; of rotation vectors the same.
_FLIP = np.array([1.0, -1.0, -1.0])


def compass(
    truth: Truth,
    times: ArrayLike,
    rng: np.random.Generator,
    *,
    sigma: float = HEADING_SIGMA,
    noise: float = 1.0,
) -> Heading:
    """Headings with the track's heading bias, at times (M,), s; `sigma` in radians."""
    t = np.atleast_1d(np.asarray(times, dtype=np.float64))
    read = truth.heading(t) + truth.heading_bias(t) + noise * sigma * rng.standard_normal(len(t))
    return Heading(t, read, sigma)


def gyro(
    truth: Truth,
    times: ArrayLike,
    rng: np.random.Generator,
    *,
    bias: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sigma: float = ANGULAR_RATE_SIGMA,
    noise: float = 1.0,
    planar: bool = False,
) -> AngularRate:
    """Angular rates with a constant bias.

    Parameters
    ----------
    truth : Truth
        The vehicle.
    times : array, shape (M,)
        s.
    rng : numpy.random.Generator
        For white noise.
    bias : tuple of float
        What is read too much about the forward, right and down axes, rad/s.
    sigma, noise : float
        Standard deviation of each component, rad/s, and what multiplies it.
    planar : bool
        Whether there is a gyro about the down axis alone.
    """
    t = np.atleast_1d(np.asarray(times, dtype=np.float64))
    rates = truth.angular_rate(t) * _FLIP + np.array(bias)
    rates = rates + noise * sigma * rng.standard_normal(rates.shape)
    forward, right, down = rates.T
    if planar:
        return AngularRate(t, about_down=down, sigma=sigma)
    return AngularRate(t, forward, right, down, sigma)


def odometer(
    truth: Truth,
    times: ArrayLike,
    rng: np.random.Generator,
    options: Options,
    *,
    scale: float = 0.0,
    turn_bias: float = 0.0,
    noise: float = 1.0,
    planar: bool = False,
) -> Odometry:
    """Changes of pose between neighbouring times, with noise that grows as the options say.

    The true way is (1 + scale) times the one read. What is turned too far clockwise, turn_bias dt,
    turns the way read by half of that.

    Parameters
    ----------
    truth : Truth
        The vehicle.
    times : array, shape (M + 1,)
        s, increasing.
    rng : numpy.random.Generator
        For noise.
    options : Options
        The four numbers of the noise.
    scale : float
        Relative.
    turn_bias : float
        What it turns too far clockwise, rad/s.
    noise : float
        Multiplies the standard deviations.
    planar : bool
        Whether forward, right and the turn about down are all there is.
    """
    t = np.asarray(times, dtype=np.float64)
    rotation, dt = truth.rotation(t), np.diff(t)
    back = np.swapaxes(rotation[:-1], 1, 2)
    way = np.einsum("mij,mj->mi", back, np.diff(truth.position(t), axis=0)) / (1.0 + scale)
    clockwise = np.zeros((len(dt), 3))
    clockwise[:, 2] = -turn_bias * dt
    turned = Rotation.from_rotvec(clockwise) * Rotation.from_matrix(back @ rotation[1:])
    moved = Rotation.from_rotvec(0.5 * clockwise).apply(way)
    length = np.linalg.norm(way, axis=1)
    moved = moved + noise * _grown(
        length, dt, options.odometry_way_noise, options.odometry_time_noise
    ) * rng.standard_normal(moved.shape)
    off = noise * _grown(
        length,
        dt,
        float(np.deg2rad(options.odometry_way_turn_noise_deg)),
        float(np.deg2rad(options.odometry_time_turn_noise_deg)),
    )
    if planar:
        turn = turned.as_rotvec()[:, 2] + off[:, 0] * rng.standard_normal(len(dt))
        forward, right, _ = (moved * _FLIP).T
        return Odometry(t[:-1], t[1:], forward, right, about_down=-turn)
    turned = turned * Rotation.from_rotvec(off * rng.standard_normal(moved.shape))
    return Odometry(t[:-1], t[1:], *(moved * _FLIP).T, *(turned.as_rotvec() * _FLIP).T)


def _grown(length: FloatArray, dt: FloatArray, by_way: float, by_time: float) -> FloatArray:
    """Standard deviations (M, 1) of noise whose variance grows with way (m) and time (s)."""
    return np.sqrt(by_way**2 * length + by_time**2 * dt)[:, None]
