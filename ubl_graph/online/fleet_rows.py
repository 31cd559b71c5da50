"""Poses of many vehicles at their nodes, as the residuals see them.

All vehicles' nodes stand in one `Layout` whose chains are the vehicles, and each row says by its
node's number whose it is: so that one block holds all rows of a kind, whoever measured them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ubl_graph import lie
from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.factors.block import ALL_ROWS, CurvedBlock
from ubl_graph.factors.poses import PoseNodes
from ubl_graph.factors.tips import PosesAt, Tips, TipTerms
from ubl_graph.layout import Interpolation, Layout
from ubl_graph.pose_path import Poses


class PlanarNodes(PoseNodes):
    """`PoseNodes` of planar poses without velocities, in closed form: a tenth of the time."""

    def __init__(self, layout: Layout, nodes: IntArray) -> None:
        super().__init__(layout, nodes, moving=False)

    def at(self, x: FloatArray, rows: slice = ALL_ROWS) -> Poses:
        """The poses of `rows` at the flat vector `x`."""
        own = x[self.columns[rows]]
        m = len(own)
        position = np.empty((m, 3))
        position[:, :2], position[:, 2] = own[:, :2], self._up[rows]
        cos, sin = np.cos(own[:, 2]), np.sin(own[:, 2])
        rotation = np.zeros((m, 3, 3))
        rotation[:, 0, 0] = rotation[:, 1, 1] = cos
        rotation[:, 0, 1], rotation[:, 1, 0] = -sin, sin
        rotation[:, 2, 2] = 1.0
        return Poses(position, rotation, np.broadcast_to(np.eye(3), (m, 3, 3)), np.zeros((m, 6)))

    def to_columns(self, poses: Poses, slopes: FloatArray) -> FloatArray:
        """Derivatives by the columns, (m, R, 3), of those by motions in the body, (m, R, 12)."""
        out = np.empty((*slopes.shape[:2], 3))
        back = np.swapaxes(poses.rotation, 1, 2)[:, :, :2]
        out[:, :, :2] = slopes[:, :, :3] @ back
        out[:, :, 2] = slopes[:, :, 5]
        return out


def nodes_of(layout: Layout, nodes: IntArray) -> PoseNodes:
    """The poses of some nodes."""
    if layout.node == "pose2":
        return PlanarNodes(layout, nodes)
    return PoseNodes(layout, nodes, moving=False)


class NodePoses(PosesAt):
    """Poses at nodes, of whichever vehicle.

    Parameters
    ----------
    layout : Layout
        Of all vehicles.
    nodes : array of int, shape (M,)
        Their numbers.
    """

    def __init__(self, layout: Layout, nodes: IntArray) -> None:
        self._still = self._at_nodes = True
        self.nodes = (nodes_of(layout, nodes),)
        self._ends = self.nodes
        self.columns = self.nodes[0].columns
        self.variance_factor = np.zeros(len(nodes))
        self._weights = np.zeros((len(nodes), 3))


class NodeTips(Tips):
    """Points fixed to vehicles at nodes, each with an arm of its own.

    Parameters
    ----------
    poses : NodePoses
        M poses.
    arms : array, shape (M, 3)
        Reference point to the point, body axes, m.
    """

    def __init__(self, poses: NodePoses, arms: FloatArray) -> None:
        self._poses, self._arms, self._off = poses, arms, None
        self._crosses = lie.cross_matrix(arms)
        self._has_arm = bool(arms.any())
        self.columns = poses.columns
        self._still = np.zeros((len(arms), 3))

    def at(self, x: FloatArray, rows: slice) -> tuple[FloatArray, TipTerms]:
        """Points (m, 3), m, and what gives their derivatives."""
        position, rotation, slopes = self._poses.at(x, rows)
        if self._has_arm:
            position = position + np.einsum("mij,mj->mi", rotation, self._arms[rows])
        return position, TipTerms(rotation, slopes, self._crosses[rows])

    def variance(self, terms: TipTerms) -> FloatArray:
        """Nothing moves between a node and itself: zeros (M, 3, 3)."""
        return np.zeros((len(terms.rotation), 3, 3))

    @property
    def level_variance(self) -> FloatArray:
        """Zeros (M, 3)."""
        return self._still


class TargetAntenna:
    """Targets as the other ends of ranges (`Antenna`).

    Parameters
    ----------
    columns : array of int, shape (M, 3) or (M, 6)
        Position, and velocity of those that move.
    later : array, shape (M, L)
        Time of each leg after that of the position, s.
    """

    def __init__(self, columns: IntArray, later: FloatArray) -> None:
        self.legs = later.shape[1]
        self.columns, self._later = columns, later

    def positions(self, x: FloatArray, rows: slice) -> tuple[FloatArray, None]:
        """Positions (m, L, 3) at `x`, m."""
        columns = self.columns[rows]
        place = np.repeat(x[columns[:, None, :3]], self.legs, axis=1)
        if columns.shape[1] == 6:
            place = place + self._later[rows][:, :, None] * x[columns[:, None, 3:]]
        return place, None

    def slopes(self, gradient: FloatArray, terms: None, rows: slice) -> FloatArray:  # noqa: ARG002 - the protocol's form
        """Derivatives (m, 3) or (m, 6) by the columns, given those by the positions (m, L, 3)."""
        at_rest = gradient.sum(axis=1)
        if self.columns.shape[1] == 3:
            return at_rest
        moving = (gradient * self._later[rows][:, :, None]).sum(axis=1)
        return np.concatenate([at_rest, moving], axis=1)

    def variance(self, gradient: FloatArray, terms: None) -> FloatArray:  # noqa: ARG002 - the protocol's form
        """Nothing between nodes: zeros (M,)."""
        return np.zeros(len(gradient))


def summed(columns: IntArray, weights: FloatArray) -> Interpolation:
    """A quantity of one component as a weighted sum (M, W) of columns, -1 pads."""
    m = len(columns)
    held = np.where(weights == 0.0, -1, columns)
    return Interpolation(held[:, :, None], weights, np.ones(m), np.zeros(m))


#: Below this angle (rad) its functions are power series.
_SMALL = 1e-2


class PlanarOdometry(CurvedBlock):
    """Odometry between planar nodes: `pose_motion.odometry` in closed form, without velocities.

    Parameters
    ----------
    columns : array of int, shape (M, 6 + E)
        East, north, yaw of both nodes, then further unknowns.
    way : array, shape (M, 2)
        Displacement forward and left in the first pose's axes, m.
    turn, dt : array, shape (M,)
        rad, counter-clockwise, and s.
    whitening : array, shape (M, 3, 3)
        Of along, across and about.
    names : sequence of str
        Which of `odometry_scale` and `odometry_turn_bias` are the further unknowns, in order.
    units : array, shape (E,)
        SI value of one in their columns.
    """

    name = "odometry"
    log_det = None

    def __init__(
        self,
        columns: IntArray,
        way: FloatArray,
        turn: FloatArray,
        dt: FloatArray,
        whitening: FloatArray,
        names: Sequence[str],
        units: FloatArray,
    ) -> None:
        self.columns = columns
        self._way, self._turn, self._dt, self._white = way, turn, dt, whitening
        self._names, self._units = names, units

    def evaluate(
        self,
        x: FloatArray,
        frozen: FloatArray | None = None,  # noqa: ARG002 - the protocol's form
        rows: slice = ALL_ROWS,
        jacobian: bool = True,
    ) -> tuple[FloatArray, FloatArray | None]:
        """Whitened residuals (m, 3) of `rows` at `x` and Jacobians (m, 3, 6 + E)."""
        own = x[self.columns[rows]]
        errors = dict(zip(self._names, (own[:, 6:] * self._units).T, strict=True))
        dt, white = self._dt[rows], self._white[rows]
        missing = errors.get("odometry_turn_bias", 0.0) * dt
        plain = _turned(0.5 * missing, self._way[rows])
        way = (1.0 + errors.get("odometry_scale", np.zeros(1)))[:, None] * plain
        turn = self._turn[rows] + missing
        p = _turned(-own[:, 2], own[:, 3:5] - own[:, :2])
        q = _turned(-turn, p - way)
        off: FloatArray = np.remainder(own[:, 5] - own[:, 2] - turn + np.pi, 2.0 * np.pi) - np.pi
        a, bend = _half_cot(off)
        value = np.stack(
            [a * q[:, 0] + 0.5 * off * q[:, 1], a * q[:, 1] - 0.5 * off * q[:, 0], off]
        )
        residual = np.einsum("mij,jm->mi", white, value)
        if not jacobian:
            return residual, None
        m = len(own)
        # Of q, then of the angle, by the columns.
        by_q = np.zeros((m, 3, own.shape[1]))
        back = own[:, 2] + turn
        cos, sin = np.cos(back), np.sin(back)
        by_q[:, 0, 3] = by_q[:, 1, 4] = cos
        by_q[:, 0, 4], by_q[:, 1, 3] = sin, -sin
        by_q[:, :2, :2] = -by_q[:, :2, 3:5]
        by_q[:, :2, 2] = _turned(-turn, np.stack([p[:, 1], -p[:, 0]], axis=1))
        by_q[:, 2, 2], by_q[:, 2, 5] = -1.0, 1.0
        for i, name in enumerate(self._names, start=6):
            if name == "odometry_scale":
                by_q[:, :2, i] = -_turned(-turn, plain)
            else:
                swung = _turned(-turn, 0.5 * np.stack([way[:, 1], -way[:, 0]], axis=1))
                by_q[:, :2, i] = dt[:, None] * (np.stack([q[:, 1], -q[:, 0]], axis=1) + swung)
                by_q[:, 2, i] = -dt
        by_q[:, :, 6:] *= self._units
        outer = np.zeros((m, 3, 3))
        outer[:, 0, 0] = outer[:, 1, 1] = a
        outer[:, 0, 1], outer[:, 1, 0] = 0.5 * off, -0.5 * off
        outer[:, 0, 2] = bend * q[:, 0] + 0.5 * q[:, 1]
        outer[:, 1, 2] = bend * q[:, 1] - 0.5 * q[:, 0]
        outer[:, 2, 2] = 1.0
        return residual, white @ outer @ by_q


def _turned(angle: FloatArray, v: FloatArray) -> FloatArray:
    """Vectors (M, 2) turned counter-clockwise."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([cos * v[:, 0] - sin * v[:, 1], sin * v[:, 0] + cos * v[:, 1]], axis=1)


def _half_cot(angle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(a/2) cot(a/2) and its derivative."""
    u = angle**2
    small = np.abs(angle) < _SMALL
    half = np.where(small, 0.5, 0.5 * angle)
    value = np.where(small, 1.0 - u / 12.0 - u**2 / 720.0, half / np.tan(half))
    closed = 0.5 / np.tan(half) - 0.5 * half / np.sin(half) ** 2
    return value, np.where(small, -angle / 6.0 - u * angle / 180.0, closed)
