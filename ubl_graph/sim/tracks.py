"""True motions: closed-form tracks, and tracks drawn from the smoother's own motion prior.

A `Truth` answers for any time of its span, exactly: what a simulated sensor sees is then hand
computable, and what a smoother gives can be compared at every time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from ubl_graph.arrays import ArrayLike, FloatArray
from ubl_graph.errors import ConfigurationError, TimeError
from ubl_graph.frames import LeverArm, world_R_body
from ubl_graph.mission import Reference
from ubl_graph.trajectory import (
    Order,
    interpolation_weights,
    locate,
    transition,
    whitening,
)

#: Position and velocity, (M, 3) each, at times (M,).
Motion: TypeAlias = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
#: An angle in radians: a constant, or a function of times (M,).
Angle: TypeAlias = float | Callable[[FloatArray], FloatArray]
Span: TypeAlias = tuple[float, float]

#: Half the interval over which rotations are differenced, s.
RATE_STEP = 1e-3


@dataclass(frozen=True, eq=False)
class Truth:
    """What a vehicle truly does.

    Attributes
    ----------
    span : tuple of float
        First and last time that may be asked for, s.
    motion : callable
        Position (m) and velocity (m/s) of the reference point, east-north-up, (M, 3) each.
    heading_is : float or callable, optional
        Heading clockwise from north, rad; left out, it follows the course over ground.
    pitch_is, roll_is : float or callable
        Pitch (bow up) and roll (starboard down), rad.
    heading_bias_is : float or callable
        What its heading reference reads too far clockwise, rad.
    """

    span: Span
    motion: Motion
    heading_is: Angle | None = None
    pitch_is: Angle = 0.0
    roll_is: Angle = 0.0
    heading_bias_is: Angle = 0.0

    def with_attitude(
        self, heading: Angle | None = None, pitch: Angle = 0.0, roll: Angle = 0.0
    ) -> Truth:
        """Return the same motion under other angles, rad; no heading means the course."""
        return replace(self, heading_is=heading, pitch_is=pitch, roll_is=roll)

    def with_heading_bias(self, bias: Angle) -> Truth:
        """Return the same motion with a heading reference that reads so much too far, rad."""
        return replace(self, heading_bias_is=bias)

    def position(self, t: ArrayLike) -> FloatArray:
        """East, north, up of the reference point at times (M,), shape (M, 3), m."""
        return self.motion(self._times(t))[0]

    def velocity(self, t: ArrayLike) -> FloatArray:
        """Velocity of the reference point at times (M,), shape (M, 3), m/s."""
        return self.motion(self._times(t))[1]

    def heading(self, t: ArrayLike) -> FloatArray:
        """Heading clockwise from north at times (M,), 0 to 2 pi where it follows the course."""
        times = self._times(t)
        if self.heading_is is not None:
            return _angle(self.heading_is, times)
        velocity = self.motion(times)[1]
        return np.arctan2(velocity[:, 0], velocity[:, 1]) % (2.0 * np.pi)

    def pitch(self, t: ArrayLike) -> FloatArray:
        """Pitch, bow up, at times (M,), rad."""
        return _angle(self.pitch_is, self._times(t))

    def roll(self, t: ArrayLike) -> FloatArray:
        """Roll, starboard down, at times (M,), rad."""
        return _angle(self.roll_is, self._times(t))

    def heading_bias(self, t: ArrayLike) -> FloatArray:
        """What the heading reference reads too far clockwise at times (M,), rad."""
        return _angle(self.heading_bias_is, self._times(t))

    def angular_rate(self, t: ArrayLike) -> FloatArray:
        """Angular rate about the body's forward, left and up axes at times (M,), (M, 3), rad/s.

        By central difference over 2 ms; where the track begins to turn it is half of the turn's.
        """
        before, after = self._around(self._times(t))
        turned = np.swapaxes(self.rotation(before), 1, 2) @ self.rotation(after)
        return Rotation.from_matrix(turned).as_rotvec() / (after - before)[:, None]

    def rotation(self, t: ArrayLike) -> FloatArray:
        """`world_R_body` at times (M,), shape (M, 3, 3)."""
        return world_R_body(self.heading(t), self.pitch(t), self.roll(t))

    def sensor_position(self, arm: LeverArm, t: ArrayLike) -> FloatArray:
        """Position of what sits at a lever arm, at times (M,), shape (M, 3), m."""
        if arm.is_zero:
            return self.position(t)
        return self.position(t) + self.rotation(t) @ arm.body

    def sensor_velocity(self, arm: LeverArm, t: ArrayLike) -> FloatArray:
        """Its velocity, rotation included, shape (M, 3), m/s."""
        if arm.is_zero:
            return self.velocity(t)
        times = self._times(t)
        before, after = self._around(times)
        turned = self.rotation(after) @ arm.body - self.rotation(before) @ arm.body
        return self.velocity(times) + turned / (after - before)[:, None]

    def reference(self, t: ArrayLike) -> Reference:
        """Track of the reference point at times (M,), as missions carry it for comparison."""
        times = np.sort(self._times(t))
        return Reference(times, self.position(times))

    def _around(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Times a little before and after, within the span."""
        return (
            np.maximum(times - RATE_STEP, self.span[0]),
            np.minimum(times + RATE_STEP, self.span[1]),
        )

    def _times(self, t: ArrayLike) -> FloatArray:
        times = np.atleast_1d(np.asarray(t, dtype=np.float64))
        outside = ~((times >= self.span[0]) & (times <= self.span[1]))
        if outside.any():
            raise TimeError(
                f"t = {times[np.argmax(outside)]} s is outside the simulated track, "
                f"{self.span[0]} to {self.span[1]} s"
            )
        return times


def constant_velocity(position: ArrayLike, velocity: ArrayLike, span: Span) -> Truth:
    """Straight line: p(t) = position + velocity (t - span[0]).

    Parameters
    ----------
    position, velocity : array, shape (3,)
        At span[0], east-north-up, m and m/s.
    span : tuple of float
        First and last time, s.

    Examples
    --------
    >>> truth = constant_velocity([0.0, 0.0, -50.0], [1.0, 1.0, 0.0], (0.0, 100.0))
    >>> truth.position([0.0, 10.0]).tolist()
    [[0.0, 0.0, -50.0], [10.0, 10.0, -50.0]]
    >>> float(np.rad2deg(truth.heading(0.0)[0]))
    45.0
    """
    return constant_acceleration(position, velocity, np.zeros(3), span)


def constant_acceleration(
    position: ArrayLike, velocity: ArrayLike, acceleration: ArrayLike, span: Span
) -> Truth:
    """Parabola: p(t) = position + velocity s + acceleration s^2/2 with s = t - span[0].

    Parameters
    ----------
    position, velocity, acceleration : array, shape (3,)
        At span[0], east-north-up, m, m/s, m/s^2.
    span : tuple of float
        First and last time, s.
    """
    p, v, a = (np.asarray(x, dtype=np.float64) for x in (position, velocity, acceleration))

    def motion(t: FloatArray) -> tuple[FloatArray, FloatArray]:
        s = (t - span[0])[:, None]
        return p + v * s + 0.5 * a * s**2, v + a * s

    return Truth(span, motion)


def lawn_mower(
    centre: Sequence[float],
    *,
    depth: float,
    lines: int = 6,
    length: float = 400.0,
    spacing: float = 50.0,
    speed: float = 1.5,
    course: float = 0.0,
    run_in: float = 0.0,
    t_start: float = 0.0,
) -> Truth:
    """Parallel lines over a point, joined by half circles, at constant speed and depth.

    Parameters
    ----------
    centre : sequence of float
        East and north of the pattern's middle, m.
    depth : float
        m, positive down.
    lines : int
        Number of lines.
    length, spacing : float
        Of a line, and between neighbouring lines (twice the turns' radius), m.
    speed : float
        m/s.
    course : float
        Of the first line, rad clockwise from north; the lines follow one another to starboard.
    run_in : float
        Straight way on the first line's course before the first line, m.
    t_start : float
        When it begins, s.
    """
    if lines < 1 or min(length, spacing, speed) <= 0.0:
        raise ConfigurationError(
            f"a survey of {lines} lines, {length} m long, {spacing} m apart, at {speed} m/s",
            "give positive numbers",
        )
    radius = spacing / 2.0
    piece = np.tile([length, np.pi * radius], lines)[:-1]  # line, turn, line, ..., line
    piece[0] += run_in
    begin = np.concatenate([[0.0], np.cumsum(piece)])
    along = np.array([np.sin(course), np.cos(course), 0.0])
    starboard = np.array([np.cos(course), -np.sin(course), 0.0])
    middle = np.array([centre[0], centre[1], -depth])

    def motion(t: FloatArray) -> tuple[FloatArray, FloatArray]:
        way = (t - t_start) * speed
        k = np.clip(np.searchsorted(begin, way, side="right") - 1, 0, len(piece) - 1)
        line, turning = (k // 2).astype(np.float64), k % 2 == 1
        forth = np.where(k % 4 < 2, 1.0, -1.0)
        done = way - begin[k]
        # The run-in lengthens the first line backwards.
        x_line = -0.5 * length + done - np.where(k == 0, run_in, 0.0)
        angle = done / radius
        x = forth * np.where(turning, 0.5 * length + radius * np.sin(angle), x_line)
        y = (line - (lines - 1) / 2.0) * spacing
        y = y + np.where(turning, radius * (1.0 - np.cos(angle)), 0.0)
        x_rate = speed * forth * np.where(turning, np.cos(angle), 1.0)
        y_rate = speed * np.where(turning, np.sin(angle), 0.0)
        position = middle + x[:, None] * along + y[:, None] * starboard
        return position, x_rate[:, None] * along + y_rate[:, None] * starboard

    return Truth((t_start, t_start + float(begin[-1]) / speed), motion)


def sampled(
    rng: np.random.Generator,
    order: Order,
    psd: tuple[float, float],
    position: ArrayLike,
    velocity: ArrayLike,
    span: Span,
    *,
    acceleration: ArrayLike = 0.0,
    step: float = 0.1,
) -> Truth:
    """Draw a track from the motion prior.

    Parameters
    ----------
    rng : numpy.random.Generator
        Seeded by the caller.
    order : 2 or 3
        White noise on acceleration or on jerk.
    psd : tuple of float
        Horizontal and vertical noise density, m^2/s^3 or m^2/s^5.
    position, velocity : array, shape (3,)
        At span[0], m and m/s.
    span : tuple of float
        First and last time, s.
    acceleration : array, shape (3,)
        At span[0], m/s^2; only for order 3.
    step : float
        Grid on which it is drawn, s. In between it is the prior's mean: what that leaves out is
        sqrt(psd step^3 / 192), 0.1 mm for 2e-3 m^2/s^3 and 0.1 s.
    """
    n = max(int(np.ceil((span[1] - span[0]) / step)), 1)
    grid = np.linspace(span[0], span[1], n + 1)
    dt = (span[1] - span[0]) / n
    root = np.linalg.inv(whitening(order, dt)[0])  # root root' = process_noise(order, dt)
    density = np.sqrt([psd[0], psd[0], psd[1]])
    noise = root @ (rng.standard_normal((n, order, 3)) * density)
    phi = transition(order, dt)[0]
    states = np.empty((n + 1, order, 3))
    start = [position, velocity, np.broadcast_to(np.asarray(acceleration), (3,))]
    states[0] = np.array(start[:order], dtype=np.float64)
    for k in range(n):
        states[k + 1] = phi @ states[k] + noise[k]

    def motion(t: FloatArray) -> tuple[FloatArray, FloatArray]:
        k, interval, s = locate(grid, t)
        ends = np.concatenate([states[k], states[k + 1]], axis=1)
        p, v = (
            (interpolation_weights(order, interval, s, d)[:, None, :] @ ends)[:, 0] for d in (0, 1)
        )
        return p, v

    return Truth(span, motion)


def wander(
    rng: np.random.Generator, sigma: float, walk: float, span: Span, *, step: float = 1.0
) -> Callable[[FloatArray], FloatArray]:
    """Draw a slow quantity: normal at the start, then a random walk, linear within a step.

    Parameters
    ----------
    rng : numpy.random.Generator
        Seeded by the caller.
    sigma : float
        Standard deviation at span[0].
    walk : float
        Random walk, per sqrt(s).
    span : tuple of float
        First and last time, s; beyond them it is held.
    step : float
        Grid, s.

    Returns
    -------
    callable
        Values at times (M,), shape (M,).
    """
    n = max(int(np.ceil((span[1] - span[0]) / step)), 1)
    grid = np.linspace(span[0], span[1], n + 1)
    steps = walk * np.sqrt(np.diff(grid)) * rng.standard_normal(n)
    values = np.concatenate([[0.0], np.cumsum(steps)]) + sigma * rng.standard_normal()

    def at(t: FloatArray) -> FloatArray:
        return np.interp(t, grid, values)

    return at


def _angle(angle: Angle, t: FloatArray) -> FloatArray:
    if callable(angle):
        return np.broadcast_to(np.asarray(angle(t), dtype=np.float64), t.shape)
    return np.full(t.shape, float(angle))
