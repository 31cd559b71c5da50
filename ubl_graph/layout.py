"""Where every unknown sits: the sole index of a problem's columns.

The unknowns form one flat vector: node after node (position, velocity, acceleration where the prior
has one, for poses also their rotation and turning rate, then the slow states that travel with the
nodes), and behind them what all nodes share (DVL errors, beacons). A chain is the run of nodes of
one segment; between chains nothing is interpolated. `Variable` says how GTSAM sees a run of
columns: one key each.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.options import Node
from ubl_graph.trajectory import Order, interpolation_weights, locate

#: Names of the kinematic states of a node, in order; the prior's order says how many there are.
KINEMATIC = ("position", "velocity", "acceleration")
#: What a pose holds and how fast that changes, by kind of node, with sizes. Positions stand in the
#: world's axes, velocities and rates in the body's. The rotation is a rotation vector of
#: `world_R_body`, in the plane the yaw, counter-clockwise from east.
POSE_STATES: dict[Node, tuple[tuple[str, int], ...]] = {
    "pose2": (("position", 2), ("rotation", 1)),
    "pose3": (("position", 3), ("rotation", 3)),
}
TWIST_STATES: dict[Node, tuple[tuple[str, int], ...]] = {
    "pose2": (("velocity", 2), ("rate", 1)),
    "pose3": (("velocity", 3), ("rate", 3)),
}
#: Where the columns of a node stand among position, rotation, velocity and rate of three each.
POSE_PLACES: dict[Node, IntArray] = {
    "pose2": np.array([0, 1, 5, 6, 7, 11]),
    "pose3": np.arange(12),
}
#: Columns hold these quantities in units near what they vary by; others in SI. A log scale of
#: 1e-5 beside metres spoils the normal equations' conditioning: GTSAM then calls sound systems
#: indeterminate. `get`, `put` and the covariances speak SI.
UNITS: dict[str, float] = {
    "sound_speed": 1e-4,
    "clock_offset": 1e-4,
    "clock_drift": 1e-7,
    "dvl_scale": 1e-3,
    "dvl_misalignment": 1e-2,
    "dvl_bias": 1e-2,
    "heading_bias": 1e-2,
    "gyro_bias": 1e-4,
    "odometry_scale": 1e-2,
    "odometry_turn_bias": 1e-3,
}


@dataclass(frozen=True)
class Variable:
    """A group of unknowns that GTSAM holds under one key.

    Attributes
    ----------
    name : str
        "position", "sound_speed", "beacon B1", ...; "pose" and "twist" for pose nodes, whose
        position and rotation GTSAM holds under one key, as it does velocity and rate.
    index : int
        Node number, or 0 for a shared variable.
    column : int
        First column in the flat vector.
    size : int
        Number of columns.
    """

    name: str
    index: int
    column: int
    size: int


@dataclass(frozen=True)
class Chain:
    """The nodes of one segment.

    Attributes
    ----------
    name : str
        The segment's label.
    first : int
        Number of its first node.
    t : array, shape (N,)
        Node times, s, strictly increasing.
    """

    name: str
    first: int
    t: FloatArray

    @property
    def nodes(self) -> slice:
        """Its nodes among all."""
        return slice(self.first, self.first + len(self.t))


class Columns(ABC):
    """What solvers ask of a layout.

    Attributes
    ----------
    node : str
        Kind of node; of a fleet any of poses, where it has some.
    shared : tuple of (str, int)
        Name and size of what all nodes share.
    """

    node: Node
    shared: tuple[tuple[str, int], ...]

    @cached_property
    @abstractmethod
    def node_count(self) -> int:
        """Nodes in all."""
        ...

    @cached_property
    @abstractmethod
    def node_width(self) -> int:
        """Columns of one node, of the widest where they differ."""
        ...

    @cached_property
    @abstractmethod
    def inner(self) -> int:
        """Columns of all nodes; behind them stands what nodes share."""
        ...

    @cached_property
    @abstractmethod
    def size(self) -> int:
        """Columns in all."""
        ...

    @cached_property
    @abstractmethod
    def variables(self) -> tuple[Variable, ...]:
        """Every variable, in order of its columns."""
        ...

    @cached_property
    def variable_of_column(self) -> IntArray:
        """Number of the variable that each column belongs to, shape (size,)."""
        return np.repeat(np.arange(len(self.variables)), [v.size for v in self.variables])


@dataclass(frozen=True, eq=False)
class Layout(Columns):
    """Columns of all unknowns.

    Attributes
    ----------
    chains : tuple of Chain
        In order of their nodes.
    order : 2 or 3
        Order of the motion prior: with or without acceleration.
    slow : tuple of (str, int)
        Name and size of the slow states at every node.
    shared : tuple of (str, int)
        Name and size of what all nodes share.
    node : str
        "point", "pose2" or "pose3".
    still : bool
        Whether pose nodes have no velocities: odometry alone joins them.
    held_up : array, shape (N,), optional
        Up at which the nodes of a planar vehicle stay, m; left out, zero.
    """

    chains: tuple[Chain, ...]
    order: Order
    slow: tuple[tuple[str, int], ...] = ()
    shared: tuple[tuple[str, int], ...] = ()
    node: Node = "point"
    still: bool = False
    held_up: FloatArray | None = None

    @cached_property
    def kinematic(self) -> tuple[tuple[str, int], ...]:
        """Name and size of what a node holds of the vehicle's motion."""
        if self.node == "point":
            return tuple((name, 3) for name in KINEMATIC[: self.order])
        twist = () if self.still else TWIST_STATES[self.node]
        return POSE_STATES[self.node] + twist

    @cached_property
    def kinematic_width(self) -> int:
        """Columns of a node's motion; they stand before the slow states."""
        return sum(size for _, size in self.kinematic)

    @cached_property
    def pose_width(self) -> int:
        """Columns of a node's pose alone, which stand first; of a point its position's."""
        if self.node == "point":
            return 3
        return sum(size for _, size in POSE_STATES[self.node])

    @cached_property
    def node_width(self) -> int:
        """Columns of one node."""
        return self.kinematic_width + sum(size for _, size in self.slow)

    @cached_property
    def node_count(self) -> int:
        """Nodes of all chains."""
        return sum(len(c.t) for c in self.chains)

    @cached_property
    def inner(self) -> int:
        """Columns of all nodes; behind them stands what the nodes share."""
        return self.node_count * self.node_width

    @cached_property
    def size(self) -> int:
        """Columns in all."""
        return self.inner + sum(size for _, size in self.shared)

    @cached_property
    def _node_offset(self) -> dict[str, tuple[int, int]]:
        offsets: dict[str, tuple[int, int]] = {}
        at = 0
        for name, size in self.kinematic + self.slow:
            offsets[name] = (at, size)
            at += size
        return offsets

    @cached_property
    def _shared_offset(self) -> dict[str, tuple[int, int]]:
        offsets: dict[str, tuple[int, int]] = {}
        at = self.inner
        for name, size in self.shared:
            offsets[name] = (at, size)
            at += size
        return offsets

    def has(self, name: str) -> bool:
        """Whether `name` is among the unknowns."""
        return name in self._node_offset or name in self._shared_offset

    def node_columns(self, name: str, nodes: IntArray) -> IntArray:
        """Columns of a per-node quantity at `nodes` (M,), shape (M, size)."""
        offset, size = self._node_offset[name]
        return np.asarray(nodes)[:, None] * self.node_width + offset + np.arange(size)

    def shared_columns(self, name: str) -> IntArray:
        """Columns of a shared quantity, shape (size,)."""
        offset, size = self._shared_offset[name]
        return offset + np.arange(size)

    @staticmethod
    def unit(name: str) -> float:
        """SI value of one in a column of this quantity."""
        return UNITS.get(name, 1.0)

    def get(self, x: FloatArray, name: str) -> FloatArray:
        """A quantity's SI values in the flat vector `x`: (N, size) per node, (size,) if shared."""
        return x[self._columns(name)] * self.unit(name)

    def put(self, x: FloatArray, name: str, values: FloatArray) -> None:
        """Write a quantity's SI values into the flat vector `x`, in place."""
        x[self._columns(name)] = values / self.unit(name)

    def _columns(self, name: str) -> IntArray:
        if name in self._shared_offset:
            return self.shared_columns(name)
        return self.node_columns(name, np.arange(self.node_count))

    @cached_property
    def variables(self) -> tuple[Variable, ...]:
        """Every variable, in order of its columns."""
        held = dict(self._node_offset)
        if self.node != "point":
            # GTSAM holds a pose under one key, and its twist under another.
            poses = sum(size for _, size in POSE_STATES[self.node])
            grouped = {"pose": (0, poses)}
            if not self.still:
                grouped["twist"] = (poses, poses)
            held = grouped | {name: held[name] for name, _ in self.slow}
        out = [
            Variable(name, k, k * self.node_width + offset, size)
            for k in range(self.node_count)
            for name, (offset, size) in held.items()
        ]
        out += [Variable(n, 0, at, size) for n, (at, size) in self._shared_offset.items()]
        return tuple(out)

    def motion_columns(self, nodes: IntArray) -> IntArray:
        """Columns of all that `nodes` (M,) hold of the motion, shape (M, kinematic_width)."""
        return np.asarray(nodes)[:, None] * self.node_width + np.arange(self.kinematic_width)

    def up_of(self, nodes: IntArray) -> FloatArray:
        """Up (m) at which planar `nodes` (M,) stay; zero for others, whose up is an unknown."""
        if self.node != "pose2" or self.held_up is None:
            return np.zeros(len(nodes))
        return self.held_up[nodes]

    def positions(self, x: FloatArray) -> FloatArray:
        """East, north, up of all nodes in the flat vector `x`, (N, 3), m."""
        position = self.get(x, "position")
        if position.shape[1] == 3:
            return position
        return np.column_stack([position, self.up_of(np.arange(self.node_count))])

    def position_covariance(self, covariance: FloatArray) -> FloatArray:
        """Covariances of positions as (N, 3, 3), m^2; the up of planar nodes is held: zero."""
        if covariance.shape[1] == 3:
            return covariance
        out = np.zeros((len(covariance), 3, 3))
        out[:, :2, :2] = covariance
        return out

    def positions_at(self, chain: Chain, times: FloatArray) -> Interpolation:
        """How the position at `times` (M,) of a chain is made of node states."""
        k, dt, s = locate(chain.t, times)
        if len(chain.t) == 1:
            weights = np.zeros((len(times), 2 * self.order))
            weights[:, 0] = 1.0
        else:
            weights = interpolation_weights(self.order, dt, s)
        ends = [k, np.minimum(k + 1, len(chain.t) - 1)]
        columns = np.concatenate(
            [
                self.node_columns(name, chain.first + end)[:, None, :]
                for end in ends
                for name in KINEMATIC[: self.order]
            ],
            axis=1,
        )
        columns = np.where(weights[:, :, None] == 0.0, -1, columns)
        return Interpolation(columns, weights, dt, s)

    def slow_at(self, name: str, chain: Chain, times: FloatArray) -> Interpolation:
        """How a slow state (SI) at `times` (M,) is made of its columns: linear in time."""
        k, dt, s = locate(chain.t, times)
        weights = np.stack([1.0 - s, s], axis=1) * self.unit(name)
        after = np.minimum(k + 1, len(chain.t) - 1)
        columns = np.stack(
            [self.node_columns(name, chain.first + end) for end in (k, after)], axis=1
        )
        columns = np.where(weights[:, :, None] == 0.0, -1, columns)
        return Interpolation(columns, weights, dt, s)

    def travelling_or_shared_at(self, name: str, chain: Chain, times: FloatArray) -> Interpolation:
        """How a state that travels with the nodes, or that all share, is made at `times` (M,)."""
        if name in dict(self.slow):
            return self.slow_at(name, chain, times)
        columns = np.broadcast_to(self.shared_columns(name), (len(times), 1, 1))
        weights = np.full((len(times), 1), self.unit(name))
        return Interpolation(columns, weights, np.ones(len(times)), np.zeros(len(times)))


@dataclass(frozen=True, eq=False)
class Interpolation:
    """A quantity of D components as a weighted sum of W node states.

    Attributes
    ----------
    columns : array of int, shape (M, W, D)
        Columns of each node state, -1 where its weight is zero.
    weights : array, shape (M, W)
        Shared by the components.
    dt, s : array, shape (M,)
        Interval (s) and place in it (0 to 1).
    """

    columns: IntArray
    weights: FloatArray
    dt: FloatArray
    s: FloatArray

    @staticmethod
    def together(parts: Sequence[Interpolation]) -> Interpolation:
        """The sum of several quantities of as many rows and components."""
        columns = np.concatenate([part.columns for part in parts], axis=1)
        weights = np.concatenate([part.weights for part in parts], axis=1)
        return Interpolation(columns, weights, parts[0].dt, parts[0].s)

    def compact(self) -> Interpolation:
        """The same with the states of zero weight left out as far as all rows have some.

        At a node one state is all there is; what a row does not have keeps the pad -1.
        """
        unused = self.weights == 0.0
        width = int(self.weights.shape[1] - unused.sum(axis=1).min(initial=self.weights.shape[1]))
        if width == self.weights.shape[1]:
            return self
        order = np.argsort(unused, axis=1, kind="stable")[:, : max(width, 1)]
        columns = np.take_along_axis(self.columns, order[:, :, None], axis=1)
        return Interpolation(
            columns, np.take_along_axis(self.weights, order, axis=1), self.dt, self.s
        )
