"""Smoothed trajectory of a vehicle whose nodes are poses."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from ubl_graph import lie
from ubl_graph.arrays import ArrayLike, FloatArray, IntArray
from ubl_graph.pose_path import (
    Path,
    Poses,
    between,
    path_rates,
    path_weights,
    still_rates,
    still_weights,
)
from ubl_graph.trajectory import (
    NodeCovariance,
    States,
    Trajectory,
    bridge_variance,
    interpolation_variance,
    locate,
)

#: Times that are interpolated at once.
AT_ONCE = 4096


@dataclass(frozen=True, eq=False)
class PoseStates(States):
    """What a trajectory of poses says at some times.

    Attributes
    ----------
    rotation : array, shape (M, 3, 3)
        `world_R_body`, body forward-left-up.
    pose_covariance : array, shape (M, 6, 6)
        East, north, up (m), then rotation about east, north, up (rad): world axes, translation
        first.
    """

    rotation: FloatArray
    pose_covariance: FloatArray


@dataclass(frozen=True, eq=False)
class PoseTrajectory(Trajectory):
    """A trajectory that knows the attitude; see `Trajectory` for what both have.

    Attributes
    ----------
    rotation : array, shape (N, 3, 3)
        `world_R_body` of the nodes, body forward-left-up.
    rate : array, shape (N, 3)
        Turning rate about the body's axes, rad/s.
    motion : NodeCovariance
        Covariances (N, 12, 12) of what moves and turns the nodes in their own axes, and of their
        velocities and rates there.
    still : bool
        Whether the nodes have no velocities: a constant twist joins them, and is what `velocity`
        and `rate` say.
    turning_psd : float
        Noise density of the turning rates, rad^2/s^3.
    planar : bool
        Whether up, roll and pitch are held: they have no noise.
    """

    rotation: FloatArray = None  # pyright: ignore[reportAssignmentType] - the parent has defaults
    rate: FloatArray = None  # pyright: ignore[reportAssignmentType] - likewise
    motion: NodeCovariance = None  # pyright: ignore[reportAssignmentType] - likewise
    still: bool = False
    turning_psd: float = 0.0
    planar: bool = False

    @cached_property
    def pose_covariance(self) -> FloatArray:
        """Covariance of position (m) then rotation (rad), east, north, up each, (N, 6, 6)."""
        return to_world(self.motion.node[:, :6, :6], self.rotation)

    @property
    def attitude(self) -> FloatArray:
        """Heading clockwise from true north, pitch bow up, roll starboard down, (N, 3), rad."""
        return mariners_angles(self.rotation)

    @property
    def attitude_sigma(self) -> FloatArray:
        """Standard deviations of heading, pitch and roll, (N, 3), rad; zero where they are held."""
        slopes = mariners_slopes(self.rotation)
        turned = self.pose_covariance[:, 3:, 3:]
        variance = np.einsum("nij,njk,nik->ni", slopes, turned, slopes)
        return np.sqrt(np.maximum(variance, 0.0))

    def at(self, times: ArrayLike) -> PoseStates:
        """Poses and velocities with their covariances at any times of the trajectory's span.

        Parameters
        ----------
        times : float or array, shape (M,)
            Seconds, in any order.

        Returns
        -------
        PoseStates
            Between two nodes the motion prior's mean, and the covariance of the two nodes together
            carried there, plus the prior's own between known nodes.

        Raises
        ------
        TimeError
            Where a time is not finite or outside the span, or `times` has two dimensions.
        """
        times = self.checked(times)
        k, dt, s = locate(self.t, times)
        if len(self.t) == 1:
            return PoseStates(
                times,
                self.position[k],
                self.velocity[k],
                self.covariance[k],
                self._joint.node[k, 3:, 3:],
                self.rotation[k],
                self.pose_covariance[k],
            )
        out = [self._between(k[rows], dt[rows], s[rows]) for rows in _portions(len(times))]
        columns = (np.concatenate(part) for part in zip(*out, strict=True))
        return PoseStates(times, *columns)

    def differences(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Velocities (world), rates (body) and the velocities' covariances, of nodes without any.

        They are those of the constant twist to the next node, at the last one from the one before.
        """
        k = np.minimum(np.arange(len(self.t)), len(self.t) - 2)
        dt, s = np.diff(self.t)[k], (np.arange(len(self.t)) - k).astype(np.float64)
        rows = [self._between(k[r], dt[r], s[r])[1:4:2] for r in _portions(len(k))]
        velocity, covariance = (np.concatenate(part) for part in zip(*rows, strict=True))
        path, rates = self._path(k, dt, s)
        return velocity, path.twist(rates)[:, 3:], covariance

    @property
    def _joint(self) -> NodeCovariance:
        assert self.joint is not None
        return self.joint

    def _nodes(self, k: IntArray) -> Poses:
        twist = np.concatenate(
            [np.einsum("mji,mj->mi", self.rotation[k], self.velocity[k]), self.rate[k]], axis=1
        )
        none = np.broadcast_to(np.eye(3), (len(k), 3, 3))
        return Poses(self.position[k], self.rotation[k], none, twist)

    def _path(self, k: IntArray, dt: FloatArray, s: FloatArray) -> tuple[Path, FloatArray]:
        if self.still:
            weights, rates = still_weights(s), still_rates(dt)
        else:
            weights, rates = path_weights(dt, s), path_rates(dt, s)
        return between(self._nodes(k), self._nodes(k + 1), weights), rates

    def _between(self, k: IntArray, dt: FloatArray, s: FloatArray) -> tuple[FloatArray, ...]:
        """Position, velocity, covariances of both, rotation and pose covariance, (M, ...)."""
        path, rates = self._path(k, dt, s)
        pairs = self.motion.pairs(k)
        slopes = np.concatenate(path.slopes(), axis=2)
        covariance = slopes @ pairs @ np.swapaxes(slopes, 1, 2)
        diagonal = np.arange(6)
        covariance[:, diagonal, diagonal] += self._own(dt, s, 0)
        world = to_world(covariance, path.rotation)
        velocity = velocity_of(path, rates)
        by_motion = velocity_slopes(path, rates, slopes)
        spread = by_motion @ pairs @ np.swapaxes(by_motion, 1, 2)
        spread[:, diagonal[:3], diagonal[:3]] += self._own(dt, s, 1)[:, :3]
        return path.position, velocity, world[:, :3, :3], spread, path.rotation, world

    def _own(self, dt: FloatArray, s: FloatArray, derivative: int) -> FloatArray:
        """The prior's variance between known nodes, along and about the axes, (M, 6)."""
        (horizontal, vertical), turning = self.psd, self.turning_psd
        density = np.array([horizontal, horizontal, vertical, turning, turning, turning])
        if self.planar:
            density[2:5] = 0.0
        order: Literal[0, 1] = 1 if derivative else 0
        if self.still:
            own = bridge_variance(dt, s, order)
        else:
            own = interpolation_variance(2, dt, s, order)
        return own[:, None] * density


def mariners_angles(rotation: FloatArray) -> FloatArray:
    """Heading clockwise from true north (0 to 2 pi), pitch bow up and roll starboard down, rad.

    Parameters
    ----------
    rotation : array, shape (M, 3, 3)
        `world_R_body` from forward-left-up to east-north-up.
    """
    bow, port, top = rotation[:, :, 0], rotation[:, :, 1], rotation[:, :, 2]
    heading = np.arctan2(bow[:, 0], bow[:, 1]) % (2.0 * np.pi)
    pitch = np.arcsin(np.clip(bow[:, 2], -1.0, 1.0))
    roll = np.arctan2(port[:, 2], top[:, 2])
    return np.stack([heading, pitch, roll], axis=1)


def mariners_slopes(rotation: FloatArray) -> FloatArray:
    """How heading, pitch and roll change as the vehicle turns about the world's axes, (M, 3, 3).

    Parameters
    ----------
    rotation : array, shape (M, 3, 3)
        As for `mariners_angles`; not with the bow straight up or down, where heading and roll are
        one.
    """
    bow, port, top = rotation[:, :, 0], rotation[:, :, 1], rotation[:, :, 2]
    level = bow[:, 0] ** 2 + bow[:, 1] ** 2
    # A turn d moves an axis a by d x a = -[a]x d.
    by_bow, by_port, by_top = (-lie.cross_matrix(axis) for axis in (bow, port, top))
    heading = bow[:, 1:2] * by_bow[:, 0] - bow[:, 0:1] * by_bow[:, 1]
    roll = top[:, 2:] * by_port[:, 2] - port[:, 2:] * by_top[:, 2]
    pitch = by_bow[:, 2] / np.sqrt(level)[:, None]
    return np.stack([heading / level[:, None], pitch, roll / level[:, None]], axis=1)


def velocity_of(path: Path, rates: FloatArray) -> FloatArray:
    """Velocity in the world, (M, 3), m/s."""
    return np.einsum("mij,mj->mi", path.rotation, path.twist(rates)[:, :3])


def velocity_slopes(path: Path, rates: FloatArray, slopes: FloatArray) -> FloatArray:
    """How the velocity in the world changes as the nodes move, (M, 3, 24).

    `slopes` (M, 6, 24) say how the poses move and turn.
    """
    changed = np.concatenate([part[:, :3] for part in path.twist_slopes(rates)], axis=2)
    swung = lie.cross_matrix(path.twist(rates)[:, :3]) @ slopes[:, 3:]
    return path.rotation @ (changed - swung)


def to_world(covariance: FloatArray, rotation: FloatArray) -> FloatArray:
    """Covariances (M, 6, 6) of what moves and turns a body, in the world's axes."""
    turn = np.zeros((len(rotation), 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = rotation
    return turn @ covariance @ np.swapaxes(turn, 1, 2)


def _portions(count: int) -> list[slice]:
    return [slice(first, first + AT_ONCE) for first in range(0, count, AT_ONCE)]
