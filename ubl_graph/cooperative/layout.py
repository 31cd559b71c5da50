"""Where every unknown of a fleet sits.

Each vehicle has a layout of its own, and its blocks speak of its own columns. The fleet's flat
vector holds the nodes of all vehicles in order of time, so that what a range joins lies near the
diagonal, and behind them what does not travel: each vehicle's shared states, beacons, the sound
speed between vehicles, and targets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.layout import Columns, Layout, Variable
from ubl_graph.options import Node

BEACON = "beacon "


@dataclass(frozen=True, eq=False)
class FleetLayout(Columns):
    """Columns of all unknowns of a fleet.

    Attributes
    ----------
    vehicles : tuple of Layout
        Each vehicle's own, of a single chain.
    common : tuple of (str, int)
        Name and size of what belongs to no vehicle, beside beacons.
    node : str
        Kind of node of any vehicle that has poses, "point" where none has.
    shared : tuple
        Empty: no unknown is every node's.
    """

    vehicles: tuple[Layout, ...]
    common: tuple[tuple[str, int], ...] = ()
    node: Node = "point"
    shared: tuple[tuple[str, int], ...] = ()

    @staticmethod
    def of(vehicles: Sequence[Layout], common: Sequence[tuple[str, int]]) -> FleetLayout:
        """The layout of some vehicles, and of what belongs to none of them."""
        kinds: list[Node] = [v.node for v in vehicles if v.node != "point"]
        return FleetLayout(tuple(vehicles), tuple(common), kinds[0] if kinds else "point")

    @cached_property
    def node_count(self) -> int:
        """Nodes of all vehicles."""
        return sum(v.node_count for v in self.vehicles)

    @cached_property
    def node_width(self) -> int:
        """Columns of one node, of the widest."""
        return max(v.node_width for v in self.vehicles)

    @cached_property
    def inner(self) -> int:
        """Columns of all nodes."""
        return sum(v.inner for v in self.vehicles)

    @cached_property
    def size(self) -> int:
        """Columns in all."""
        return self.inner + sum(size for _, _, size in self._border)

    @cached_property
    def _first(self) -> tuple[IntArray, ...]:
        """First column of each vehicle's nodes, in order of time."""
        times = np.concatenate([v.chains[0].t for v in self.vehicles])
        widths = np.concatenate([np.full(v.node_count, v.node_width) for v in self.vehicles])
        order = np.argsort(times, kind="stable")
        first = np.empty(len(times), dtype=np.int64)
        first[order] = np.concatenate([[0], np.cumsum(widths[order])[:-1]])
        ends = np.cumsum([v.node_count for v in self.vehicles])[:-1]
        return tuple(np.split(first, ends))

    @cached_property
    def _border(self) -> tuple[tuple[int, str, int], ...]:
        """Vehicle (-1 for none), name and size of what does not travel, in order."""
        own = [
            (i, name, size)
            for i, v in enumerate(self.vehicles)
            for name, size in v.shared
            if not name.startswith(BEACON)
        ]
        beacons = dict(
            state for v in self.vehicles for state in v.shared if state[0].startswith(BEACON)
        )
        rest = {**beacons, **dict(self.common)}
        return (*own, *((-1, name, size) for name, size in rest.items()))

    @cached_property
    def _offset(self) -> dict[tuple[int, str], int]:
        ends = self.inner + np.cumsum([0, *(size for _, _, size in self._border)])
        return {
            (vehicle, name): int(at)
            for (vehicle, name, _), at in zip(self._border, ends[:-1], strict=True)
        }

    @cached_property
    def place(self) -> tuple[IntArray, ...]:
        """Of each vehicle's columns, where they stand in the fleet's flat vector."""
        out: list[IntArray] = []
        for i, (layout, first) in enumerate(zip(self.vehicles, self._first, strict=True)):
            nodes = (first[:, None] + np.arange(layout.node_width)).ravel()
            parts = [nodes]
            for name, size in layout.shared:
                owner = -1 if name.startswith(BEACON) else i
                parts.append(self._offset[owner, name] + np.arange(size))
            out.append(np.concatenate(parts))
        return tuple(out)

    def common_columns(self, name: str) -> IntArray:
        """Columns of what belongs to no vehicle, shape (size,)."""
        size = next(size for owner, n, size in self._border if (owner, n) == (-1, name))
        return self._offset[-1, name] + np.arange(size)

    def has(self, name: str) -> bool:
        """Whether `name` is an unknown that belongs to no vehicle."""
        return (-1, name) in self._offset

    @cached_property
    def variables(self) -> tuple[Variable, ...]:
        """Every variable, in order of its columns; nodes are counted over the whole fleet."""
        found: list[Variable] = []
        starts = np.sort(np.concatenate(self._first))
        for layout, place in zip(self.vehicles, self.place, strict=True):
            for v in layout.variables[: len(layout.variables) - len(layout.shared)]:
                column = int(place[v.column])
                number = int(np.searchsorted(starts, column, side="right")) - 1
                found.append(replace(v, index=number, column=column))
        found.sort(key=lambda v: v.column)
        for vehicle, name, size in self._border:
            # Behind all nodes: a state may be every node's in one vehicle and a constant in others.
            index = self.node_count + vehicle + 1
            found.append(Variable(name, index, self._offset[vehicle, name], size))
        return tuple(found)

    def split(self, x: FloatArray) -> list[FloatArray]:
        """Each vehicle's own flat vector, out of the fleet's."""
        return [x[place] for place in self.place]

    def joined(self, parts: Sequence[FloatArray]) -> FloatArray:
        """The fleet's flat vector of the vehicles' own; what belongs to none is zero."""
        x = np.zeros(self.size)
        for place, part in zip(self.place, parts, strict=True):
            x[place] = part
        return x
