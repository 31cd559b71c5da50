"""Poses between nodes.

Between two nodes a pose moves as the prior on poses expects (white noise on the twist's change):
in the first node's axes the logarithm of the way is the cubic Hermite polynomial through both
ends. Nodes without velocities are joined by a constant twist. Source: Barfoot, State Estimation for
Robotics, ch. 11.1; Anderson and Barfoot 2015.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ubl_graph import lie
from ubl_graph.arrays import FloatArray
from ubl_graph.trajectory import interpolation_weights


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses and twists of m nodes.

    Attributes
    ----------
    position : array, shape (m, 3)
        East, north, up, m.
    rotation : array, shape (m, 3, 3)
        `world_R_body`.
    slope : array, shape (m, 3, 3)
        How the body turns as the columns of the rotation change.
    twist : array, shape (m, 6)
        Velocity (m/s) and turning rate (rad/s), body axes.
    """

    position: FloatArray
    rotation: FloatArray
    slope: FloatArray
    twist: FloatArray


def path_weights(dt: FloatArray, s: FloatArray) -> FloatArray:
    """Weights (M, 3) of the first twist, the whole way and the arriving twist in the way so far.

    The first node's own place, the origin of its axes, has no part.
    """
    return interpolation_weights(2, dt, s)[:, 1:]


def path_rates(dt: FloatArray, s: FloatArray) -> FloatArray:
    """The same for the way's rate of change, 1/s."""
    return interpolation_weights(2, dt, s, 1)[:, 1:]


def still_weights(s: FloatArray) -> FloatArray:
    """The same as `path_weights` for nodes without velocities."""
    none = np.zeros_like(s)
    return np.stack([none, s, none], axis=1)


def still_rates(dt: FloatArray) -> FloatArray:
    """The same as `path_rates` for nodes without velocities."""
    none = np.zeros_like(dt)
    return np.stack([none, 1.0 / dt, none], axis=1)


@dataclass(frozen=True, eq=False)
class Path:
    """M poses, each between two nodes.

    Attributes
    ----------
    one, two : Poses
        The nodes.
    weights : array, shape (M, 3)
        From `path_weights` or `still_weights`.
    whole, part : array, shape (M, 6)
        Logarithms of the way from node to node, and of the way so far.
    bend : array, shape (M, 6, 6)
        Derivative of the arriving twist by the whole way.
    arriving : array, shape (M, 6)
        Twist at the second node, as the logarithm's rate of change.
    turned, moved : array, shape (M, 3, 3), (M, 3)
        The pose in the first node's axes.
    """

    one: Poses
    two: Poses
    weights: FloatArray
    whole: FloatArray
    part: FloatArray
    bend: FloatArray
    arriving: FloatArray
    turned: FloatArray
    moved: FloatArray

    @cached_property
    def rotation(self) -> FloatArray:
        """`world_R_body`, (M, 3, 3)."""
        return self.one.rotation @ self.turned

    @cached_property
    def position(self) -> FloatArray:
        """East, north, up, (M, 3), m."""
        return self.one.position + np.einsum("mij,mj->mi", self.one.rotation, self.moved)

    def twist(self, rates: FloatArray) -> FloatArray:
        """Velocity and turning rate in the body, (M, 6); `rates` from `path_rates`."""
        return np.einsum("mij,mj->mi", lie.slope(self.part), self._speed(rates))

    def slopes(self) -> tuple[FloatArray, FloatArray]:
        """How the poses move and turn in the body as the nodes do, (M, 6, 12) for each."""
        first, second = self._combined(self.weights)
        after = lie.slope(self.part)
        back = np.swapaxes(self.turned, 1, 2)
        first, second = after @ first, after @ second
        first[:, :, :6] += lie.adjoint(back, -np.einsum("mij,mj->mi", back, self.moved))
        return first, second

    def twist_slopes(self, rates: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How the twists change as the nodes do, (M, 6, 12) for each."""
        _, by_part = lie.slope_of(self.part, self._speed(rates))
        after = lie.slope(self.part)
        by_way, by_speed = self._combined(self.weights), self._combined(rates)
        first, second = (
            by_part @ way + after @ speed for way, speed in zip(by_way, by_speed, strict=True)
        )
        return first, second

    def _speed(self, rates: FloatArray) -> FloatArray:
        """Rate of change of the way's logarithm."""
        one, whole = rates[:, :1] * self.one.twist, rates[:, 1:2] * self.whole
        return one + whole + rates[:, 2:] * self.arriving

    def _combined(self, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Derivatives of what `weights` make of first twist, whole way and arriving twist."""
        weights = weights[:, :, None, None]
        by_two, by_one = lie.slope_inverse(self.whole), -lie.slope_inverse(-self.whole)
        by_whole = weights[:, 1] * np.eye(6) + weights[:, 2] * self.bend
        first, second = (np.zeros((len(self.part), 6, 12)) for _ in range(2))
        first[:, :, :6] = by_whole @ by_one
        first[:, :, 6:] = weights[:, 0] * np.eye(6)
        second[:, :, :6] = by_whole @ by_two
        second[:, :, 6:] = weights[:, 2] * by_two
        return first, second


def between(one: Poses, two: Poses, weights: FloatArray) -> Path:
    """Poses between nodes `one` and `two` by weights (M, 3)."""
    turn, way = lie.between(one.rotation, one.position, two.rotation, two.position)
    whole = lie.logarithm(turn, way)
    arriving, bend = lie.inverse_slope_of(whole, two.twist)
    part = weights[:, :1] * one.twist + weights[:, 1:2] * whole + weights[:, 2:] * arriving
    return Path(one, two, weights, whole, part, bend, arriving, *lie.exponential(part))
