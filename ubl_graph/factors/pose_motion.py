"""Residuals of poses: motion prior, odometry, body velocities, attitude, compass, gyro.

Each function here gives a `PoseResidual`; `ubl_graph.pose_builder` hands it nodes, noise and
columns. What a heading reference reads, or odometry turns, too far clockwise is a positive bias. A
gyro's is what it reads too much about forward, left and up: counter-clockwise about the last.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ubl_graph import lie
from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.factors.poses import ABOUT, ALONG, MOVED, TURNED, PoseResidual, Poses

UP = np.array([0.0, 0.0, 1.0])


def motion(dt: FloatArray) -> PoseResidual:
    """White noise on the change of the twist, 12 components.

    With x the logarithm of the way from the first pose to the second and w the twists,
    e = [x - dt w1; J(x)^-1 w2 - w1]: GTSAM's WnoaMotionFactor. Source: Anderson and Barfoot 2015.

    Parameters
    ----------
    dt : array, shape (M,)
        Between the nodes, s.
    """

    def residual(
        poses: Sequence[Poses], extra: FloatArray, rows: slice
    ) -> tuple[FloatArray, list[FloatArray], FloatArray]:
        one, two = poses
        span = dt[rows]
        way = lie.logarithm(*lie.between(one.rotation, one.position, two.rotation, two.position))
        arriving, bend = lie.inverse_slope_of(way, two.twist)
        value = np.concatenate([way - span[:, None] * one.twist, arriving - one.twist], axis=1)
        by_two, by_one = lie.slope_inverse(way), -lie.slope_inverse(-way)
        first, second = (np.zeros((len(way), 12, 12)) for _ in range(2))
        first[:, :6, :6], first[:, 6:, :6] = by_one, bend @ by_one
        first[:, :6, 6:] = -span[:, None, None] * np.eye(6)
        first[:, 6:, 6:] = -np.eye(6)
        second[:, :6, :6], second[:, 6:, :6] = by_two, bend @ by_two
        second[:, 6:, 6:] = by_two
        return value, [first, second], np.zeros((len(way), 12, extra.shape[1]))

    return residual


def odometry(
    way: FloatArray, turn: FloatArray, dt: FloatArray, extra_names: Sequence[str]
) -> PoseResidual:
    """Change of pose as odometry reads it, 6 components: Log(Z^-1 T1^-1 T2).

    Parameters
    ----------
    way : array, shape (M, 3)
        Displacement in the first pose's axes, m.
    turn : array, shape (M, 3)
        Rotation vector, rad.
    dt : array, shape (M,)
        s.
    extra_names : sequence of str
        Which of `odometry_scale` and `odometry_turn_bias` (rad/s, what it turns too far clockwise)
        are further unknowns, in order.
    """
    rotation = lie.rotation(turn)

    def residual(
        poses: Sequence[Poses], extra: FloatArray, rows: slice
    ) -> tuple[FloatArray, list[FloatArray], FloatArray]:
        one, two = poses
        span, moved, turned = dt[rows], way[rows], rotation[rows]
        errors = dict(zip(extra_names, extra.T, strict=True))
        along = np.zeros_like(moved)
        if "odometry_turn_bias" in errors:
            # Turned too far clockwise: turned back, half of it on the way.
            missing = (errors["odometry_turn_bias"] * span)[:, None] * UP
            moved = np.einsum("mij,mj->mi", lie.rotation(0.5 * missing), moved)
            turned = lie.rotation(missing) @ turned
        along = moved
        if "odometry_scale" in errors:
            moved = (1.0 + errors["odometry_scale"])[:, None] * moved
        r, p = lie.between(one.rotation, one.position, two.rotation, two.position)
        back = np.swapaxes(turned, 1, 2)
        value = lie.logarithm(back @ r, np.einsum("mij,mj->mi", back, p - moved))
        two_turned, one_turned = lie.slope_inverse(value), -lie.slope_inverse(-value)
        by_one = np.zeros((len(value), 6, 12))
        by_two = np.zeros_like(by_one)
        by_two[:, :, :6] = two_turned
        seen = np.swapaxes(r, 1, 2)
        by_one[:, :, :6] = -two_turned @ lie.adjoint(seen, -np.einsum("mij,mj->mi", seen, p))
        by_extra = np.zeros((len(value), 6, extra.shape[1]))
        for i, name in enumerate(extra_names):
            change = np.zeros((len(value), 6))
            if name == "odometry_scale":
                change[:, :3] = np.einsum("mij,mj->mi", back, along)
            else:
                half = 0.5 * span[:, None] * np.cross(UP, moved)
                change[:, :3] = np.einsum("mij,mj->mi", back, half)
                change[:, 3:] = span[:, None] * back[:, :, 2]
            by_extra[:, :, i] = np.einsum("mij,mj->mi", one_turned, change)
        return value, [by_one, by_two], by_extra

    return residual


@dataclass(frozen=True, eq=False)
class BodyWay:
    """Preintegrated body velocities over M intervals, in the first pose's axes.

    Attributes
    ----------
    way : array, shape (M, 3)
        Displacement of the DVL, m; for a velocity, m/s.
    by_errors : array, shape (M, 3, E)
        Derivative by the errors of DVL and gyros that are unknowns.
    dt : array, shape (M,)
        s; ones for a velocity.
    arm : array, shape (3,)
        Reference point to DVL, body axes, m.
    currents : int
        Current states (east, north) at the end of the further unknowns: 0, 1 or 2 pairs; their
        mean counts.
    """

    way: FloatArray
    by_errors: FloatArray
    dt: FloatArray
    arm: FloatArray
    currents: int = 0

    def with_error(self, slope: FloatArray) -> BodyWay:
        """The same with a further error's derivative (M, 3, size) behind the others."""
        return replace(self, by_errors=np.concatenate([self.by_errors, slope], axis=2))

    def drift(self, extra: FloatArray, rows: slice) -> FloatArray:
        """What the current carries the vehicle over the interval, east, north, up, (m, 3), m."""
        out = np.zeros((len(extra), 3))
        if self.currents:
            pairs = extra[:, -2 * self.currents :].reshape(len(extra), self.currents, 2)
            out[:, :2] = self.dt[rows][:, None] * pairs.mean(axis=1)
        return out

    def by_extra(self, rotation: FloatArray, rows: slice) -> FloatArray:
        """Derivatives of the residual by the further unknowns, (m, 3, E)."""
        parts = [-self.by_errors[rows]]
        if self.currents:
            share = self.dt[rows][:, None, None] / self.currents
            carried = -share * np.swapaxes(rotation, 1, 2)[:, :, :2]
            parts += [carried] * self.currents
        return np.concatenate(parts, axis=2)


def displacement(body: BodyWay) -> PoseResidual:
    """Way of the DVL from node to node in the first pose's axes, 3 components.

    The further unknowns are the DVL's errors, then the current at both nodes.
    """

    def residual(
        poses: Sequence[Poses], extra: FloatArray, rows: slice
    ) -> tuple[FloatArray, list[FloatArray], FloatArray]:
        one, two = poses
        r, p = lie.between(one.rotation, one.position, two.rotation, two.position)
        swung = r @ body.arm
        drift = np.einsum("mji,mj->mi", one.rotation, body.drift(extra, rows))
        errors = extra[:, : body.by_errors.shape[2]]
        told = body.way[rows] + np.einsum("mie,me->mi", body.by_errors[rows], errors)
        value = p + swung - body.arm - drift - told
        by_one, by_two = (np.zeros((len(value), 3, 12)) for _ in range(2))
        by_one[:, :, MOVED] = -np.eye(3)
        by_one[:, :, TURNED] = lie.cross_matrix(p + swung - drift)
        by_two[:, :, MOVED] = r
        by_two[:, :, TURNED] = -r @ lie.cross_matrix(body.arm[None])
        return value, [by_one, by_two], body.by_extra(one.rotation, rows)

    return residual


def velocity(body: BodyWay) -> PoseResidual:
    """Velocity of the DVL at a node, body axes, 3 components; `body.way` holds velocities."""
    cross = lie.cross_matrix(body.arm[None])[0]

    def residual(
        poses: Sequence[Poses], extra: FloatArray, rows: slice
    ) -> tuple[FloatArray, list[FloatArray], FloatArray]:
        (pose,) = poses
        drift = np.einsum("mji,mj->mi", pose.rotation, body.drift(extra, rows))
        errors = extra[:, : body.by_errors.shape[2]]
        told = body.way[rows] + np.einsum("mie,me->mi", body.by_errors[rows], errors)
        value = pose.twist[:, :3] - pose.twist[:, 3:] @ cross.T - drift - told
        slope = np.zeros((len(value), 3, 12))
        slope[:, :, ALONG] = np.eye(3)
        slope[:, :, ABOUT] = -cross
        slope[:, :, TURNED] = -lie.cross_matrix(drift)
        return value, [slope], body.by_extra(pose.rotation, rows)

    return residual


def attitude(measured: FloatArray) -> PoseResidual:
    """Attitude as the reference reads it, 3 components: Log(measured' Rz(-bias) R).

    The further unknown, where there is one, is the heading bias (rad, read too far clockwise).

    Parameters
    ----------
    measured : array, shape (M, 3, 3)
        `world_R_body` as read.
    """

    def residual(
        poses: Sequence[Poses], extra: FloatArray, rows: slice
    ) -> tuple[FloatArray, list[FloatArray], FloatArray]:
        (pose,) = poses
        back = np.swapaxes(measured[rows], 1, 2)
        bias = extra.sum(axis=1)
        value = lie.rotation_vector(back @ lie.rotation(-bias[:, None] * UP) @ pose.rotation)
        inverse = lie.rotation_slope_inverse(value)
        slope = np.zeros((len(value), 3, 12))
        slope[:, :, TURNED] = inverse
        by_bias = -np.einsum("mij,mj->mi", inverse, pose.rotation[:, 2])
        return value, [slope], np.repeat(by_bias[:, :, None], extra.shape[1], axis=2)

    return residual


def upright() -> PoseResidual:
    """Lean of a pose, 3 components: the world's up in the body's axes, less the body's own."""

    def residual(
        poses: Sequence[Poses],
        extra: FloatArray,
        rows: slice,  # noqa: ARG001 - the residuals' form
    ) -> tuple[FloatArray, list[FloatArray], FloatArray]:
        (pose,) = poses
        up = pose.rotation[:, 2]
        slope = np.zeros((len(up), 3, 12))
        slope[:, :, TURNED] = lie.cross_matrix(up)
        return up - UP, [slope], np.zeros((len(up), 3, extra.shape[1]))

    return residual


def rotation_between(measured: FloatArray, by_bias: FloatArray) -> PoseResidual:
    """Turn from node to node as gyros read it, 3 components.

    Parameters
    ----------
    measured : array, shape (M, 3, 3)
        First pose's axes to the second's, integrated.
    by_bias : array, shape (M, 3, B)
        What a bias of the rates adds to it, in the second pose's axes, s.
    """

    def residual(
        poses: Sequence[Poses], extra: FloatArray, rows: slice
    ) -> tuple[FloatArray, list[FloatArray], FloatArray]:
        one, two = poses
        turned = np.swapaxes(one.rotation, 1, 2) @ two.rotation
        off = lie.rotation_vector(np.swapaxes(measured[rows], 1, 2) @ turned)
        slopes = by_bias[rows]
        value = off + np.einsum("mib,mb->mi", slopes, extra)
        inverse = lie.rotation_slope_inverse(off)
        by_one, by_two = (np.zeros((len(value), 3, 12)) for _ in range(2))
        by_one[:, :, TURNED] = -inverse @ np.swapaxes(turned, 1, 2)
        by_two[:, :, TURNED] = inverse
        return value, [by_one, by_two], slopes

    return residual


def rate(measured: FloatArray, biased: IntArray) -> PoseResidual:
    """Turning rate at a node as gyros read it, 3 components.

    Parameters
    ----------
    measured : array, shape (M, 3)
        rad/s.
    biased : array of int, shape (B,)
        Components whose bias is a further unknown, in order.
    """

    def residual(
        poses: Sequence[Poses], extra: FloatArray, rows: slice
    ) -> tuple[FloatArray, list[FloatArray], FloatArray]:
        (pose,) = poses
        value = pose.twist[:, 3:] - measured[rows]
        slope = np.zeros((len(value), 3, 12))
        slope[:, :, ABOUT] = np.eye(3)
        by_bias = np.zeros((len(value), 3, extra.shape[1]))
        value[:, biased] += extra
        by_bias[:, biased, np.arange(len(biased))] = 1.0
        return value, [slope], by_bias

    return residual
