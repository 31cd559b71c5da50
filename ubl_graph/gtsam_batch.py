"""All rows of a graph evaluated at once, while GTSAM asks for them one by one.

Python is slow at single rows and fast at many. The callback of a factor sees its own keys only, or
every C++ optimiser would be quadratic; but one plain CustomFactor, the herald, may see all values.
It is the graph's first factor and has no residual: when GTSAM sums up the errors somewhere, it is
asked first, and has all rows evaluated there. Their callbacks find what they need, after a look at
whether they are asked at that very point; a row that is asked elsewhere is evaluated alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, NamedTuple

import gtsam
import numpy as np

from ubl_graph import lie
from ubl_graph.arrays import BoolArray, FloatArray, IntArray
from ubl_graph.factors.block import Block
from ubl_graph.factors.loss import RobustLoss
from ubl_graph.layout import Columns, Variable

#: GTSAM counts a pose's and a twist's components about the axes first.
ABOUT_FIRST = [3, 4, 5, 0, 1, 2]
#: Largest number of columns of one variable.
WIDEST = 6

#: What GTSAM calls for a factor: itself, values, and where the Jacobians go, if they are wanted.
Callback = Callable[[Any, gtsam.Values, list[FloatArray] | None], FloatArray]


class _Family(NamedTuple):
    """Variables that GTSAM holds in one way."""

    numbers: IntArray  # in the layout's order
    columns: IntArray  # (P, size)
    get: Callable[[gtsam.Values, int], Any]
    is_pose: bool
    read: Callable[[list[Any]], FloatArray]  # what `get` gave to columns, (P, size)
    slopes: Callable[[FloatArray], FloatArray] | None  # by local coordinates, (P, size, size)


@dataclass(eq=False)
class _Rows:
    """A block's rows, and what they were when they were last evaluated."""

    block: Block
    held: FloatArray | None
    loss: RobustLoss
    owner: IntArray  # (M, K), numbers of the variables that each row touches; -1 pads
    slot: IntArray  # (M, C), which of these a column belongs to
    offset: IntArray  # (M, C), and where in it the column stands
    there: BoolArray  # (M, C), which columns are no pads
    twice: bool  # whether a row meets some column again
    shaped: FloatArray = field(init=False)
    residual: FloatArray = field(init=False)
    jacobian: FloatArray = field(init=False)
    local: FloatArray | None = field(init=False, default=None)


class Batch:
    """Evaluates the rows of some blocks together.

    Parameters
    ----------
    layout : Columns
        Of the problem.
    keys : sequence of int
        GTSAM's key of each of its variables.
    """

    def __init__(self, layout: Columns, keys: Sequence[int]) -> None:
        self._layout, self._keys = layout, keys
        self._families = _families(layout)
        self._blocks: list[_Rows] = []
        count = len(layout.variables)
        self._family_of = np.zeros(count, dtype=np.int64)
        self._place = np.zeros(count, dtype=np.int64)
        for i, family in enumerate(self._families):
            self._family_of[family.numbers] = i
            self._place[family.numbers] = np.arange(len(family.numbers))
        #: What GTSAM held under each key when all rows were evaluated.
        self._at: list[Any] = [None] * count
        self._slopes: list[FloatArray | None] = [None] * len(self._families)

    def herald(self) -> gtsam.CustomFactor:
        """The factor that sees all values; it must stand before all others."""
        size = self._layout.variables[0].size
        none = np.zeros(1)

        def evaluate(
            _: Any, values: gtsam.Values, jacobians: list[FloatArray] | None
        ) -> FloatArray:
            if jacobians is None:
                self._look(values)
            else:
                # At a point whose error was just asked for.
                jacobians[0] = np.zeros((1, size))
            return none

        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [self._keys[0]], evaluate)

    def add(self, block: Block, held: FloatArray | None, loss: RobustLoss) -> int:
        """Take a block in: its number, by which `row` knows it."""
        columns = block.columns
        owner = np.where(columns >= 0, self._layout.variable_of_column[columns], -1)
        sorted_ = np.sort(owner, axis=1)
        new = np.ones(sorted_.shape, dtype=np.bool_)
        new[:, 1:] = sorted_[:, 1:] != sorted_[:, :-1]
        new &= sorted_ >= 0
        rank = np.cumsum(new, axis=1) - 1
        own = np.full((len(columns), int(new.sum(axis=1).max(initial=1))), -1)
        row, _ = np.nonzero(new)
        own[row, rank[new]] = sorted_[new]
        slot = (owner[:, :, None] == own[:, None, :]).argmax(axis=2)
        first = np.array([v.column for v in self._layout.variables])
        ordered = np.sort(columns, axis=1)
        twice = bool(((ordered[:, 1:] == ordered[:, :-1]) & (ordered[:, 1:] >= 0)).any())
        there = columns >= 0
        offset = np.where(there, columns - first[np.maximum(owner, 0)], 0)
        self._blocks.append(_Rows(block, held, loss, own, slot, offset, there, twice))
        return len(self._blocks) - 1

    def row(
        self, number: int, row: int, alone: Callable[[], Callback]
    ) -> tuple[list[int], Callback]:
        """Keys of one row of a block, and what GTSAM calls for it.

        `alone` gives what evaluates it where the others were not.
        """
        rows = self._blocks[number]
        numbers = [int(n) for n in rows.owner[row] if n >= 0]
        families = [self._families[self._family_of[n]] for n in numbers]
        checks = [
            (family.get, family.is_pose, self._keys[n], n)
            for n, family in zip(numbers, families, strict=True)
        ]
        sizes = [self._layout.variables[n].size for n in numbers]
        at, single = self._at, cache(alone)

        def evaluate(
            factor: Any, values: gtsam.Values, jacobians: list[FloatArray] | None
        ) -> FloatArray:
            for get, is_pose, key, n in checks:
                here, known = get(values, key), at[n]
                if known is None:
                    return single()(factor, values, jacobians)
                same = here.equals(known, 0.0) if is_pose else bool((here == known).all())
                if not same:
                    return single()(factor, values, jacobians)
            if jacobians is None:
                return rows.shaped[row]
            if rows.local is None:
                rows.local = self._local(rows)
            for j, size in enumerate(sizes):
                jacobians[j] = rows.local[row, j, :size].T
            return rows.residual[row]

        return [self._keys[n] for n in numbers], evaluate

    def _look(self, values: gtsam.Values) -> None:
        """Evaluate all rows at `values`."""
        x = np.empty(self._layout.size)
        self._at[:] = [None] * len(self._at)
        found: list[list[Any]] = []
        for i, family in enumerate(self._families):
            here = [family.get(values, self._keys[n]) for n in family.numbers]
            columns = family.read(here)
            if not np.isfinite(columns).all():
                return
            x[family.columns] = columns
            self._slopes[i] = None if family.slopes is None else family.slopes(columns)
            found.append(here)
        for rows in self._blocks:
            residual, jacobian = rows.block.evaluate(x, rows.held)
            assert jacobian is not None
            rows.shaped, rows.local = rows.loss.shaped(residual), None
            if rows.loss.name != "none":
                root = np.sqrt(rows.loss.weights(residual))
                residual, jacobian = root * residual, root[:, :, None] * jacobian
            rows.residual, rows.jacobian = residual, jacobian
        for family, here in zip(self._families, found, strict=True):
            for n, held in zip(family.numbers, here, strict=True):
                self._at[n] = held

    def _local(self, rows: _Rows) -> FloatArray:
        """Derivatives by GTSAM's local coordinates of each variable, (M, K, WIDEST, R)."""
        count, size = rows.jacobian.shape[:2]
        out = np.zeros((count, rows.owner.shape[1], WIDEST, size))
        row = np.broadcast_to(np.arange(count)[:, None], rows.there.shape)[rows.there]
        places = row, rows.slot[rows.there], rows.offset[rows.there]
        entries = np.swapaxes(rows.jacobian, 1, 2)[rows.there]
        if rows.twice:
            np.add.at(out, places, entries)
        else:
            out[places] = entries
        kinds = np.where(rows.owner >= 0, self._family_of[rows.owner], -1)
        for i, slopes in enumerate(self._slopes):
            if slopes is None:
                continue
            own = np.nonzero(kinds == i)
            width = slopes.shape[1]
            turned = np.swapaxes(slopes[self._place[rows.owner[own]]], 1, 2)
            out[(*own, slice(width))] = turned @ out[(*own, slice(width))]
        return out


def _families(layout: Columns) -> list[_Family]:
    """All variables, by how GTSAM holds them."""
    groups: dict[tuple[str, int], list[int]] = {}
    for n, variable in enumerate(layout.variables):
        groups.setdefault(_kind(variable), []).append(n)
    out: list[_Family] = []
    for (name, size), numbers in groups.items():
        first = np.array([layout.variables[n].column for n in numbers])
        columns = first[:, None] + np.arange(size)
        get, read, slopes = _HELD[name, size]
        out.append(_Family(np.array(numbers), columns, get, name == "pose", read, slopes))
    return out


def _kind(variable: Variable) -> tuple[str, int]:
    special = variable.name == "pose" or (variable.name == "twist" and variable.size == 6)
    return (variable.name if special else "", variable.size)


def _columns_pose3(poses: list[Any]) -> FloatArray:
    matrices = np.array([pose.matrix() for pose in poses])
    if not np.isfinite(matrices).all():
        return matrices[:, 0]
    vectors = lie.rotation_vector(np.ascontiguousarray(matrices[:, :3, :3]))
    return np.concatenate([matrices[:, :3, 3], vectors], axis=1)


def _slopes_pose3(columns: FloatArray) -> FloatArray:
    out = np.zeros((len(columns), 6, 6))
    out[:, :3, 3:] = lie.rotation(columns[:, 3:])
    out[:, 3:, :3] = lie.rotation_slope_inverse(columns[:, 3:])
    return out


def _columns_pose2(poses: list[Any]) -> FloatArray:
    return np.array([[pose.x(), pose.y(), pose.theta()] for pose in poses])


def _slopes_pose2(columns: FloatArray) -> FloatArray:
    out = np.zeros((len(columns), 3, 3))
    cos, sin = np.cos(columns[:, 2]), np.sin(columns[:, 2])
    out[:, 0, 0] = out[:, 1, 1] = cos
    out[:, 0, 1], out[:, 1, 0] = -sin, sin
    out[:, 2, 2] = 1.0
    return out


def _columns_twist3(twists: list[Any]) -> FloatArray:
    return np.array(twists)[:, ABOUT_FIRST]


def _slopes_twist3(columns: FloatArray) -> FloatArray:
    return np.broadcast_to(np.eye(6)[:, ABOUT_FIRST], (len(columns), 6, 6))


def _columns_vector(vectors: list[Any]) -> FloatArray:
    return np.array(vectors)


_Held = tuple[
    Callable[[gtsam.Values, int], Any],
    Callable[[list[Any]], FloatArray],
    Callable[[FloatArray], FloatArray] | None,
]
_HELD: dict[tuple[str, int], _Held] = {
    ("pose", 6): (gtsam.Values.atPose3, _columns_pose3, _slopes_pose3),
    ("pose", 3): (gtsam.Values.atPose2, _columns_pose2, _slopes_pose2),
    ("twist", 6): (gtsam.Values.atVector, _columns_twist3, _slopes_twist3),
    ("", 1): (gtsam.Values.atVector, _columns_vector, None),
    ("", 2): (gtsam.Values.atPoint2, _columns_vector, None),
    ("", 3): (gtsam.Values.atPoint3, _columns_vector, None),
}
