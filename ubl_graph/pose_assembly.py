"""From a solver's flat vector to the trajectory of pose nodes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ubl_graph import lie
from ubl_graph.arrays import FloatArray
from ubl_graph.factors.poses import PoseNodes
from ubl_graph.layout import POSE_PLACES, Chain, Layout
from ubl_graph.options import Options
from ubl_graph.pose_path import Poses
from ubl_graph.pose_trajectory import PoseTrajectory
from ubl_graph.problem import Problem
from ubl_graph.solve.marginals import Covariances
from ubl_graph.trajectory import NodeCovariance


def pose_trajectory(
    problem: Problem, x: FloatArray, marginals: Covariances, chain: Chain, options: Options
) -> PoseTrajectory:
    """The trajectory of a chain of pose nodes, with covariances in the world's axes.

    Parameters
    ----------
    problem, x, marginals
        Solved, with covariances.
    chain : Chain
        Whose nodes.
    options : Options
        For the noise of the turning rates.
    """
    layout = problem.layout
    names = [name for name, _ in layout.kinematic]
    nodes = PoseNodes(layout, chain.first + np.arange(len(chain.t))).at(x)
    following = slice(chain.nodes.start, chain.nodes.stop - 1)
    columns = NodeCovariance(
        marginals.joint(names)[chain.nodes], marginals.following(names)[following]
    )
    return trajectory_of(layout, chain.t, nodes, columns, options)


def trajectory_of(
    layout: Layout, t: FloatArray, nodes: Poses, columns: NodeCovariance, options: Options
) -> PoseTrajectory:
    """The trajectory of pose nodes.

    Parameters
    ----------
    layout : Layout
        What a node holds.
    t : array, shape (N,)
        s.
    nodes : Poses
        At these times.
    columns : NodeCovariance
        Of the columns of their motion.
    options : Options
        For the noise of the prior.
    """
    to_body = motion_slopes(layout, nodes)
    motion = NodeCovariance(
        to_body @ columns.node @ np.swapaxes(to_body, 1, 2),
        to_body[:-1] @ columns.following @ np.swapaxes(to_body[1:], 1, 2),
    )
    world = world_slopes(nodes)
    joint = NodeCovariance(
        world @ motion.node @ np.swapaxes(world, 1, 2),
        world[:-1] @ motion.following @ np.swapaxes(world[1:], 1, 2),
    )
    trajectory = PoseTrajectory(
        t,
        nodes.position,
        np.einsum("nij,nj->ni", nodes.rotation, nodes.twist[:, :3]),
        None,
        np.ascontiguousarray(joint.node[:, :3, :3]),
        (options.horizontal_psd, options.vertical_psd),
        joint,
        nodes.rotation,
        nodes.twist[:, 3:],
        motion,
        layout.still,
        options.angular_acceleration_psd,
        layout.node == "pose2",
    )
    return with_differences(trajectory) if layout.still else trajectory


def motion_slopes(layout: Layout, nodes: Poses) -> FloatArray:
    """How nodes move and turn in their own axes as their columns change, (N, 12, C)."""
    whole = np.zeros((len(nodes.position), 12, 12))
    whole[:, :3, :3] = np.swapaxes(nodes.rotation, 1, 2)
    whole[:, 3:6, 3:6] = nodes.slope
    whole[:, 6:, 6:] = np.eye(6)
    return whole[:, :, POSE_PLACES[layout.node][: layout.kinematic_width]]


def world_slopes(nodes: Poses) -> FloatArray:
    """How position and velocity in the world change as nodes move and turn, (N, 6, 12)."""
    out = np.zeros((len(nodes.position), 6, 12))
    out[:, :3, :3] = out[:, 3:, 6:9] = nodes.rotation
    out[:, 3:, 3:6] = -nodes.rotation @ lie.cross_matrix(nodes.twist[:, :3])
    return out


def with_differences(trajectory: PoseTrajectory) -> PoseTrajectory:
    """Velocities of nodes that have none: those of the constant twist to the next node."""
    assert trajectory.joint is not None
    # The cross covariance of such velocities with their neighbours' is not looked at.
    node, following = trajectory.joint.node.copy(), trajectory.joint.following.copy()
    following[:, 3:] = following[:, :, 3:] = np.nan
    if len(trajectory.t) == 1:
        node[:, 3:] = node[:, :, 3:] = np.nan
        return replace(trajectory, joint=NodeCovariance(node, following))
    velocity, rate, covariance = trajectory.differences()
    node[:, 3:, :3] = node[:, :3, 3:] = np.nan
    node[:, 3:, 3:] = covariance
    joint = NodeCovariance(node, following)
    return replace(trajectory, velocity=velocity, rate=rate, joint=joint)
