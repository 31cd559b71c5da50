"""The way between nodes that odometry joins, at the ends of all its records.

Where odometry was compounded, nodes stand far apart, and the vehicle turns between them as its
records say. With T_a and T_b the nodes and P the compound from the first to some record's end, the
pose there is T_a P Exp(d) with d of covariance S, and the second node sees A d + noise with A =
Ad((P^-1 Z)^-1), Z the whole compound of covariance C. So given both nodes

    d = K Log(Z^-1 T_a^-1 T_b),   K = S A' C^-1,   cov(d) = S - K A S,

and what is not known of the nodes is carried along: moves a and b of theirs in their own axes move
the pose by (Ad(P^-1) - K Ad(Z^-1)) a + K b. It is what a graph with a node at each record would
say, without the nodes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ubl_graph import lie
from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.measurements import Odometry
from ubl_graph.nodes import SAME_INSTANT
from ubl_graph.odometry_chain import Steps, compounded, steps_of
from ubl_graph.odometry_noise import PLANAR
from ubl_graph.options import Options
from ubl_graph.pose_assembly import with_differences, world_slopes
from ubl_graph.pose_path import Poses
from ubl_graph.pose_trajectory import PoseTrajectory
from ubl_graph.trajectory import NodeCovariance


def filled_in(
    trajectory: PoseTrajectory,
    records: Odometry,
    options: Options,
    errors: Mapping[str, float] | None = None,
) -> PoseTrajectory:
    """A trajectory of nodes that odometry joins with a node at every record's end.

    Parameters
    ----------
    trajectory : PoseTrajectory
        Of nodes without velocities (`still`).
    records : Odometry
        What joins the nodes, as recorded.
    options : Options
        For its noise.
    errors : mapping of str to float, optional
        Estimates of `odometry_scale` and `odometry_turn_bias` (rad/s too far clockwise).

    Returns
    -------
    PoseTrajectory
        The trajectory as it is where the records overlap or leave gaps between the nodes.
    """
    ends = np.concatenate([trajectory.t, records.t_from, records.t_to])
    pieces = compounded(records, ends, options)
    inside = (pieces.t_from > trajectory.t[0] - SAME_INSTANT) & (
        pieces.t_to < trajectory.t[-1] + SAME_INSTANT
    )
    pieces = pieces[inside]
    if len(trajectory.t) < 2 or not _joined(trajectory.t, pieces):
        return trajectory
    interval = np.searchsorted(trajectory.t, pieces.t_from + SAME_INSTANT, side="right") - 1
    dt = pieces.t_to - pieces.t_from
    steps = _corrected(steps_of(pieces, planar=trajectory.planar), dt, errors or {})
    bridges = _bridges(trajectory, steps, interval)
    last = np.append(interval[1:] != interval[:-1], True)
    return _placed(trajectory, bridges, pieces.t_to, interval, last)


def _joined(t: FloatArray, pieces: Odometry) -> bool:
    """Whether pieces lead from the first node to the last without gap or overlap."""
    if not len(pieces):
        return False
    ends = np.append(pieces.t_from, pieces.t_to[-1])
    apart = np.abs(pieces.t_from[1:] - pieces.t_to[:-1])
    reaches = abs(ends[0] - t[0]) < SAME_INSTANT and abs(ends[-1] - t[-1]) < SAME_INSTANT
    return reaches and bool((apart < SAME_INSTANT).all())


def _corrected(steps: Steps, dt: FloatArray, errors: Mapping[str, float]) -> Steps:
    """Steps without what the odometry is estimated to have been off by (`pose_motion.odometry`)."""
    scale = 1.0 + errors.get("odometry_scale", 0.0)
    missing = errors.get("odometry_turn_bias", 0.0) * dt
    if steps.planar:
        cos, sin = np.cos(0.5 * missing), np.sin(0.5 * missing)
        along, aside = steps.way.T
        way = np.stack([cos * along - sin * aside, sin * along + cos * aside], axis=1)
        return Steps(steps.rotation + missing, scale * way, steps.covariance)
    up = np.array([0.0, 0.0, 1.0])
    half, whole = (lie.rotation(share * missing[:, None] * up) for share in (0.5, 1.0))
    way = scale * np.einsum("mij,mj->mi", half, steps.way)
    return Steps(whole @ steps.rotation, way, steps.covariance)


@dataclass(frozen=True, eq=False)
class _Bridges:
    """Poses at the pieces' ends, and how they depend on the nodes, D dimensions each.

    Attributes
    ----------
    position, rotation : array, shape (M, 3), (M, 3, 3)
        Where they are.
    by_nodes : array, shape (M, D, 2 D)
        By moves of the nodes before and after, in their own axes.
    own : array, shape (M, D, D)
        Covariance given both nodes.
    onward : array, shape (M, D, D)
        Covariance with the next piece's end, given both nodes; zero for the last of an interval.
    """

    position: FloatArray
    rotation: FloatArray
    by_nodes: FloatArray
    own: FloatArray
    onward: FloatArray


def _bridges(trajectory: PoseTrajectory, steps: Steps, interval: IntArray) -> _Bridges:
    prefix = _running(steps, interval)
    last = np.append(np.flatnonzero(np.diff(interval)), len(interval) - 1)
    whole = prefix[last[interval]]
    back, back_whole = prefix.backward(), whole.backward()
    seen = back_whole @ np.asarray(np.linalg.inv(back), np.float64)
    told = np.asarray(np.linalg.solve(whole.covariance, seen @ prefix.covariance), np.float64)
    gain = np.swapaxes(told, 1, 2)
    own = prefix.covariance - gain @ seen @ prefix.covariance
    onward = np.zeros_like(own)
    carried = prefix.covariance[:-1] @ np.swapaxes(steps.backward()[1:], 1, 2)
    held = gain[:-1] @ whole.covariance[:-1] @ np.swapaxes(gain[1:], 1, 2)
    onward[:-1] = np.where((np.diff(interval) == 0)[:, None, None], carried - held, 0.0)
    by_nodes = np.concatenate([back - gain @ back_whole, gain], axis=2)

    before, after = interval, interval + 1
    first = trajectory.rotation[before], trajectory.position[before]
    way = lie.between(*first, trajectory.rotation[after], trajectory.position[after])
    turn, moved = _in_space(whole)
    back_turn = np.swapaxes(turn, 1, 2)
    off = lie.logarithm(back_turn @ way[0], np.einsum("mij,mj->mi", back_turn, way[1] - moved))
    axes = PLANAR if steps.planar else np.arange(6)
    share = np.zeros_like(off)
    share[:, axes] = np.einsum("mij,mj->mi", gain, off[:, axes])
    turn, moved = _in_space(prefix)
    bent, shifted = lie.exponential(share)
    moved = moved + np.einsum("mij,mj->mi", turn, shifted)
    position = first[1] + np.einsum("mij,mj->mi", first[0], moved)
    return _Bridges(position, first[0] @ turn @ bent, by_nodes, own, onward)


def _running(steps: Steps, interval: IntArray) -> Steps:
    """Each step compounded with those before it in its interval."""
    opens = np.append(True, interval[1:] != interval[:-1])
    rank = np.arange(len(interval)) - np.flatnonzero(opens)[np.cumsum(opens) - 1]
    out = Steps(*(part.copy() for part in (steps.rotation, steps.way, steps.covariance)))
    for place in range(1, int(rank.max()) + 1):
        rows = np.flatnonzero(rank == place)
        joined = out[rows - 1].then(steps[rows])
        out.rotation[rows], out.way[rows] = joined.rotation, joined.way
        out.covariance[rows] = joined.covariance
    return out


def _in_space(steps: Steps) -> tuple[FloatArray, FloatArray]:
    """Rotations (M, 3, 3) and displacements (M, 3) of steps, planar or not."""
    if not steps.planar:
        return steps.rotation, steps.way
    up = np.array([0.0, 0.0, 1.0])
    way = np.concatenate([steps.way, np.zeros((len(steps), 1))], axis=1)
    return lie.rotation(steps.rotation[:, None] * up), way


def _placed(
    trajectory: PoseTrajectory,
    bridges: _Bridges,
    t: FloatArray,
    interval: IntArray,
    last: FloatArray,
) -> PoseTrajectory:
    """The trajectory with the pieces' ends among its nodes; the last of an interval is a node."""
    axes = PLANAR if trajectory.planar else np.arange(6)
    size = len(axes)
    motion = trajectory.motion
    pairs = motion.pairs(interval)
    both = np.concatenate([axes, axes + len(pairs[0]) // 2])
    ends = pairs[:, both[:, None], both[None, :]]
    own = bridges.by_nodes @ ends @ np.swapaxes(bridges.by_nodes, 1, 2) + bridges.own
    # With the first node of the interval, and with the next piece's end, in one interval.
    from_first = ends[:, :size] @ np.swapaxes(bridges.by_nodes, 1, 2)
    onward = bridges.onward.copy()
    onward[:-1] += bridges.by_nodes[:-1] @ ends[:-1] @ np.swapaxes(bridges.by_nodes[1:], 1, 2)
    # What follows a node is the first piece of its interval.
    after_node = last[:-1, None, None]
    following = np.concatenate([from_first[:1], np.where(after_node, from_first[1:], onward[:-1])])
    count = len(t) + 1
    node = np.zeros((count, 12, 12))
    node[0] = motion.node[0]
    node[1:, axes[:, None], axes[None, :]] = own
    beside = np.zeros((count - 1, 12, 12))
    beside[:, axes[:, None], axes[None, :]] = following
    ends_at = np.flatnonzero(last)
    position = np.concatenate([trajectory.position[:1], bridges.position])
    rotation = np.concatenate([trajectory.rotation[:1], bridges.rotation])
    times = np.concatenate([trajectory.t[:1], t])
    # The nodes themselves stay as they are, to the last bit.
    position[1 + ends_at], rotation[1 + ends_at] = trajectory.position[1:], trajectory.rotation[1:]
    node[1 + ends_at], times[1 + ends_at] = motion.node[1:], trajectory.t[1:]
    whole = NodeCovariance(node, beside)
    none = np.zeros((count, 3))
    world = world_slopes(
        Poses(position, rotation, np.broadcast_to(np.eye(3), (count, 3, 3)), np.zeros((count, 6)))
    )
    joint = NodeCovariance(
        world @ whole.node @ np.swapaxes(world, 1, 2),
        world[:-1] @ whole.following @ np.swapaxes(world[1:], 1, 2),
    )
    return with_differences(
        replace(
            trajectory,
            t=times,
            position=position,
            velocity=none,
            rotation=rotation,
            rate=none,
            covariance=np.ascontiguousarray(joint.node[:, :3, :3]),
            motion=whole,
            joint=joint,
        )
    )
