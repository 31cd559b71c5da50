"""Where every unknown sits: the sole index of a problem's columns.

The unknowns form one flat vector: node after node (position, velocity, acceleration where the
prior has one, then the slow states that travel with the nodes), and behind them what all nodes
share (DVL errors, beacons). A chain is the run of nodes of one segment; between chains nothing
is interpolated. `Variable` says how GTSAM sees a run of columns: one key each.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.trajectory import Order, interpolation_weights, locate

#: Names of the kinematic states of a node, in order; the prior's order says how many there are.
KINEMATIC = ("position", "velocity", "acceleration")
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
}


@dataclass(frozen=True)
class Variable:
    """A group of unknowns that GTSAM holds under one key.

    Attributes
    ----------
    name : str
        "position", "sound_speed", "beacon B1", ...
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


@dataclass(frozen=True, eq=False)
class Layout:
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
    """

    chains: tuple[Chain, ...]
    order: Order
    slow: tuple[tuple[str, int], ...] = ()
    shared: tuple[tuple[str, int], ...] = ()

    @cached_property
    def node_width(self) -> int:
        """Columns of one node."""
        return 3 * self.order + sum(size for _, size in self.slow)

    @cached_property
    def node_count(self) -> int:
        """Nodes of all chains."""
        return sum(len(c.t) for c in self.chains)

    @cached_property
    def size(self) -> int:
        """Columns in all."""
        return self.node_count * self.node_width + sum(size for _, size in self.shared)

    @cached_property
    def _node_offset(self) -> dict[str, tuple[int, int]]:
        offsets: dict[str, tuple[int, int]] = {}
        at = 0
        for name, size in [(n, 3) for n in KINEMATIC[: self.order]] + list(self.slow):
            offsets[name] = (at, size)
            at += size
        return offsets

    @cached_property
    def _shared_offset(self) -> dict[str, tuple[int, int]]:
        offsets: dict[str, tuple[int, int]] = {}
        at = self.node_count * self.node_width
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
        out = [
            Variable(name, k, k * self.node_width + offset, size)
            for k in range(self.node_count)
            for name, (offset, size) in self._node_offset.items()
        ]
        out += [Variable(n, 0, at, size) for n, (at, size) in self._shared_offset.items()]
        return tuple(out)

    @cached_property
    def variable_of_column(self) -> IntArray:
        """Number of the variable that each column belongs to, shape (size,)."""
        return np.repeat(np.arange(len(self.variables)), [v.size for v in self.variables])

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
