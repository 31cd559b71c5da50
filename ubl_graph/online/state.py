"""What a solved window says at one time: mean and covariance, between nodes and ahead of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.online.frame import Frame
from ubl_graph.online.pose_state import pose_moment, poses_of
from ubl_graph.online.window import Window
from ubl_graph.pose_assembly import trajectory_of as trajectory_of_poses
from ubl_graph.solve.banded import BandedFactor
from ubl_graph.solve.marginals import selected_inverse
from ubl_graph.trajectory import (
    NodeCovariance,
    Trajectory,
    interpolation_covariance,
    interpolation_weights,
    process_noise,
    transition,
)


@dataclass(frozen=True, eq=False)
class Moment:
    """Mean and covariance of position and velocity at one time.

    Attributes
    ----------
    t : float
        s.
    mean : array, shape (6,)
        East, north, up (m) and their rates (m/s).
    covariance : array, shape (6, 6)
        Position first; m and m/s.
    rotation : array, shape (3, 3), optional
        `world_R_body`, where nodes are poses.
    pose_covariance : array, shape (6, 6), optional
        Of position (m), then of the rotation about east, north, up (rad).
    """

    t: float
    mean: FloatArray
    covariance: FloatArray
    rotation: FloatArray | None = None
    pose_covariance: FloatArray | None = None


def moment_at(
    frame: Frame, factor: BandedFactor, ends: FloatArray, up: FloatArray, end: float, t: float
) -> Moment:
    """Position and velocity at a time in the last interval of a solved window, or later.

    Parameters
    ----------
    frame : Frame
        The window's unknowns.
    factor : BandedFactor
        Of its normal matrix.
    ends : array, shape (2, W)
        Its last two nodes.
    up : array, shape (2,)
        Where planar ones are held, m.
    end : float
        Time of the last node, s.
    t : float
        s.
    """
    order, kinematic = frame.order, frame.node.kinematic_width
    options = frame.setup.options
    psd = np.array([options.horizontal_psd, options.horizontal_psd, options.vertical_psd])
    tail = tail_covariance(factor, 2 * frame.width, factor.band.shape[1])
    own = np.concatenate([np.arange(kinematic), frame.width + np.arange(kinematic)])
    joint = tail[np.ix_(own, own)]
    ahead = t - end
    if frame.is_posed:
        mean, covariance, rotation, pose = pose_moment(frame, ends, up, joint, ahead)
        return Moment(t, mean, _symmetric(covariance), rotation, _symmetric(pose))
    if ahead <= 0.0:
        s = min(max(1.0 + ahead / frame.spacing, 0.0), 1.0)
        rows = [interpolation_weights(order, frame.spacing, s, d) for d in (0, 1)]
        weights = np.stack(rows)
        noise = interpolation_covariance(order, frame.spacing, s)[:2, :2]
    else:
        weights = np.zeros((2, 2 * order))
        weights[:, order:] = transition(order, ahead)[0, :2]
        noise = process_noise(order, ahead)[0, :2, :2]
    carry = np.kron(weights, np.eye(3))
    covariance = carry @ joint @ carry.T + np.kron(noise, np.diag(psd))
    mean = np.asarray(carry @ ends[:, :kinematic].ravel(), dtype=np.float64)
    return Moment(t, mean, _symmetric(covariance))


def _symmetric(matrix: FloatArray) -> FloatArray:
    return 0.5 * (matrix + matrix.T)


def tail_covariance(factor: BandedFactor, size: int, inner: int) -> FloatArray:
    """Covariance of the last `size` of the nodes' columns: the factor's own last block says it."""
    lower = np.zeros((size, size))
    reach = len(factor.band)
    first = inner - size
    for j in range(size):
        rows = min(size - j, reach)
        lower[j : j + rows, j] = factor.band[:rows, first + j]
    inverse = np.linalg.inv(lower)
    covariance = inverse.T @ inverse
    if len(factor.corner):
        share = inverse.T @ factor.coupling[first:]
        covariance += share @ factor.inverse_corner() @ share.T
    return covariance


def trajectory_of(window: Window, factor: BandedFactor) -> Trajectory:
    """The whole window as a trajectory with covariances."""
    frame = window.frame
    kinematic = frame.node.kinematic_width
    node, following = selected_inverse(factor.band, frame.width)
    if len(factor.corner):
        share = factor.solve_transposed(factor.coupling)
        share = share.reshape(window.count, frame.width, -1)
        taken = share @ factor.inverse_corner()
        node = node + taken @ np.swapaxes(share, 1, 2)
        following = following + taken[:-1] @ np.swapaxes(share[1:], 1, 2)
    joint = NodeCovariance(
        np.ascontiguousarray(node[:, :kinematic, :kinematic]),
        np.ascontiguousarray(following[:, :kinematic, :kinematic]),
    )
    options = frame.setup.options
    if frame.is_posed:
        nodes = poses_of(frame, window.x, window.up)
        return trajectory_of_poses(frame.node, window.times, nodes, joint, options)
    return Trajectory(
        window.times,
        window.x[:, :3].copy(),
        window.x[:, 3:6].copy(),
        window.x[:, 6:9].copy() if frame.order == 3 else None,
        np.ascontiguousarray(joint.node[:, :3, :3]),
        (options.horizontal_psd, options.vertical_psd),
        joint,
    )
