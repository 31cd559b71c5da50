"""Poses at one time from a solved window, between its last nodes and ahead of them.

Ahead a pose goes on at its last twist, which the prior on poses expects. With x = dt w the way's
logarithm and J the slope of the exponential there, a node moved by d, its twist changed by e, and
noise n on way and twist carry it to

    d' = Ad(Exp(-x)) d + J (dt e + n1),    e' = e + (1 - J) n1 / dt + J n2

in the body's axes: the derivative of J(dt w) w = w says the rest. Source: Barfoot, State Estimation
for Robotics, ch. 11.1.
"""

from __future__ import annotations

import numpy as np

from ubl_graph import lie
from ubl_graph.arrays import FloatArray
from ubl_graph.factors.block import LinearBlock
from ubl_graph.factors.poses import PoseNodes
from ubl_graph.layout import POSE_PLACES
from ubl_graph.mission import Start, Vehicle
from ubl_graph.nodes import grid
from ubl_graph.online.buffer import Buffer
from ubl_graph.online.frame import Frame
from ubl_graph.pose_assembly import motion_slopes, world_slopes
from ubl_graph.pose_path import Poses, between, path_rates, path_weights
from ubl_graph.pose_trajectory import to_world, velocity_of, velocity_slopes
from ubl_graph.trajectory import interpolation_covariance, process_noise


def poses_of(frame: Frame, x: FloatArray, up: FloatArray) -> Poses:
    """Poses of nodes.

    Parameters
    ----------
    frame : Frame
        What a node holds.
    x : array, shape (N, W)
        Their columns.
    up : array, shape (N,)
        Where planar ones are held, m.
    """
    layout = frame.layout(grid(0, len(x), frame.spacing), up)
    return PoseNodes(layout, np.arange(len(x))).at(x.ravel())


def nearest_vector(rotation: FloatArray, near: FloatArray) -> FloatArray:
    """Rotation vectors of rotations (M, 3, 3) that lie nearest to others (M, 3), rad.

    A rotation has many vectors, whole turns apart.
    """
    vector = lie.rotation_vector(rotation)
    length = np.linalg.norm(vector, axis=1)
    axis = np.divide(
        vector, length[:, None], out=np.zeros_like(vector), where=length[:, None] > 1e-9
    )
    turns = np.round((np.einsum("mi,mi->m", near, axis) - length) / (2.0 * np.pi))
    return vector + 2.0 * np.pi * turns[:, None] * axis


def is_turned(buffer: Buffer) -> bool:
    """Whether anything in the buffer tells how the vehicle turns, or what it does in its axes."""
    kinds = ("attitude", "heading", "angular_rate", "odometry", "velocity")
    return any(buffer.of(kind) for kind in kinds)


def heights_of(buffer: Buffer, vehicle: Vehicle) -> FloatArray:
    """Times and ups (M, 2), s and m, at which a planar vehicle was: by depth, else by fixes."""
    depths = [e for e in buffer.of("depth") if not e.gated]
    if depths:
        arm = vehicle.depth_sensor.body[2]
        return np.array([[e.t, -e.values[1] - arm] for e in depths])
    fixes = [e for e in buffer.of("position") if not e.gated and e.values[1].shape[1] == 3]
    if fixes:
        arm = vehicle.antenna.body[2]
        return np.array([[e.t, e.values[1][0, 2] - arm] for e in fixes])
    told = [e.record for e in buffer.of("set_position")]
    known = [[r.t, r.up] for r in told if isinstance(r, Start) and r.up is not None]
    return np.array(known, dtype=np.float64).reshape(-1, 2)


def put_poses(frame: Frame, nodes: FloatArray, poses: Poses, near: FloatArray | None) -> None:
    """Write poses and twists into nodes (N, W), in place.

    Parameters
    ----------
    frame, nodes, poses
        What, and where.
    near : array, shape (N, W), optional
        Nodes to whose rotation vectors those written shall be near; left out, they are no longer
        than half a turn.
    """
    place = POSE_PLACES[frame.node.node]
    whole = np.zeros((len(nodes), 12))
    whole[:, :3], whole[:, 6:] = poses.position, poses.twist
    old = np.zeros((len(nodes), 12))
    if near is not None:
        old[:, place] = near[:, : len(place)]
    whole[:, 3:6] = nearest_vector(poses.rotation, old[:, 3:6])
    nodes[:, : len(place)] = whole[:, place]


def moved_on(poses: Poses, dt: FloatArray) -> Poses:
    """Poses (M) after times dt (M,) at their twists."""
    turn, way = lie.exponential(dt[:, None] * poses.twist)
    rotation = poses.rotation @ turn
    position = poses.position + np.einsum("mij,mj->mi", poses.rotation, way)
    return Poses(position, rotation, lie.rotation_slope(lie.rotation_vector(rotation)), poses.twist)


def step_ahead(frame: Frame, twist: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """How a node's errors grow over a time, body axes.

    Parameters
    ----------
    frame : Frame
        For the noise.
    twist : array, shape (6,)
        Of the node.
    dt : float
        s, not zero.

    Returns
    -------
    array, shape (12, 12)
        What they become.
    array, shape (12, 12)
        Covariance that is added.
    """
    way = dt * twist[None]
    slope = lie.slope(way)[0]
    turn, moved = lie.exponential(-way)
    carry = np.eye(12)
    carry[:6, :6], carry[:6, 6:] = lie.adjoint(turn, moved)[0], dt * slope
    by_noise = np.zeros((12, 12))
    by_noise[:6, :6] = by_noise[6:, 6:] = slope
    by_noise[6:, :6] = (np.eye(6) - slope) / dt
    noise = np.kron(process_noise(2, abs(dt))[0], np.diag(densities(frame)))
    return carry, by_noise @ noise @ by_noise.T


def densities(frame: Frame) -> FloatArray:
    """Noise density of the motion prior along and about the body's axes, (6,)."""
    options = frame.setup.options
    along = [options.horizontal_psd, options.horizontal_psd, options.vertical_psd]
    return np.array(along + [options.angular_acceleration_psd] * 3)


def leap_block(frame: Frame, nodes: FloatArray, up: FloatArray, dt: float) -> LinearBlock:
    """The motion from one node to another far ahead, about where it is expected.

    Parameters
    ----------
    frame : Frame
        The unknowns.
    nodes : array, shape (2, W)
        The node, and where it is expected.
    up : array, shape (2,)
        Where planar ones are held, m.
    dt : float
        s.
    """
    layout = frame.layout(np.array([0.0, dt]), up)
    poses = poses_of(frame, nodes, up)
    carry, noise = step_ahead(frame, poses.twist[0], dt)
    slopes = motion_slopes(layout, poses)
    kept = POSE_PLACES[layout.node]
    white = np.linalg.inv(np.linalg.cholesky(noise[np.ix_(kept, kept)]))
    first, second = -white @ (carry @ slopes[0])[kept], white @ slopes[1][kept]
    columns = layout.motion_columns(np.arange(2)).ravel()
    matrix = np.concatenate([first, second], axis=1)
    target = matrix @ nodes[:, : layout.kinematic_width].ravel()
    return LinearBlock("motion", columns[None], matrix[None], target[None])


def pose_moment(
    frame: Frame, ends: FloatArray, up: FloatArray, joint: FloatArray, ahead: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Position, velocity and pose near the last node.

    Parameters
    ----------
    frame : Frame
        The unknowns.
    ends : array, shape (2, W)
        The last two nodes.
    up : array, shape (2,)
        Where planar ones are held, m.
    joint : array, shape (2 K, 2 K)
        Covariance of the columns of their motion.
    ahead : float
        Time after the last node, s; negative in the last interval.

    Returns
    -------
    array, shape (6,)
        East, north, up (m) and their rates (m/s).
    array, shape (6, 6)
        Their covariance.
    array, shape (3, 3)
        `world_R_body`.
    array, shape (6, 6)
        Covariance of position (m), then of the rotation about east, north, up (rad).
    """
    poses = poses_of(frame, ends, up)
    slopes = motion_slopes(frame.node, poses)
    size = slopes.shape[2]
    to_body = np.zeros((24, 2 * size))
    to_body[:12, :size], to_body[12:, size:] = slopes
    pair = to_body @ joint @ to_body.T
    if ahead > 0.0:
        return _ahead(frame, poses, pair[12:, 12:], ahead)
    return _between(frame, poses, pair, min(max(1.0 + ahead / frame.spacing, 0.0), 1.0))


def _ahead(
    frame: Frame, poses: Poses, own: FloatArray, dt: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    last = _one(poses, 1)
    carry, noise = step_ahead(frame, last.twist[0], dt)
    if frame.is_planar:
        noise = _flattened(noise)
    there = moved_on(last, np.array([dt]))
    covariance = carry @ own @ carry.T + noise
    world = world_slopes(there)[0]
    mean = np.concatenate([there.position[0], there.rotation[0] @ there.twist[0, :3]])
    pose = to_world(covariance[None, :6, :6], there.rotation)[0]
    return mean, world @ covariance @ world.T, there.rotation[0], pose


def _between(
    frame: Frame, poses: Poses, pair: FloatArray, s: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    dt, at = np.array([frame.spacing]), np.array([s])
    path = between(_one(poses, 0), _one(poses, 1), path_weights(dt, at))
    rates = path_rates(dt, at)
    slopes = np.concatenate(path.slopes(), axis=2)
    rotation = path.rotation
    by_place, by_velocity = rotation[0] @ slopes[0, :3], velocity_slopes(path, rates, slopes)[0]
    unit = interpolation_covariance(2, frame.spacing, s)
    density = densities(frame)
    noise: FloatArray = np.asarray(np.kron(unit, np.diag(density)), dtype=np.float64)
    if frame.is_planar:
        noise = _flattened(noise)
    world = np.concatenate([by_place, by_velocity])
    turned = np.kron(np.eye(2), rotation[0])
    along = noise[np.ix_([0, 1, 2, 6, 7, 8], [0, 1, 2, 6, 7, 8])]
    covariance = world @ pair @ world.T + turned @ along @ turned.T
    pose = slopes[0] @ pair @ slopes[0].T + noise[:6, :6]
    mean = np.concatenate([path.position[0], velocity_of(path, rates)[0]])
    return mean, covariance, rotation[0], to_world(pose[None], rotation)[0]


def _flattened(noise: FloatArray) -> FloatArray:
    """Noise (12, 12) of a vehicle in the plane."""
    out = np.zeros_like(noise)
    kept = np.ix_(POSE_PLACES["pose2"], POSE_PLACES["pose2"])
    out[kept] = noise[kept]
    return out


def _one(poses: Poses, at: int) -> Poses:
    own = slice(at, at + 1)
    return Poses(poses.position[own], poses.rotation[own], poses.slope[own], poses.twist[own])
