"""A Problem as GTSAM sees it: a factor graph over keys, each factor a view on one row.

Linear rows become native factors (`LinearContainerFactor`), the motion prior of poses in space
GTSAM's own; all others become `CustomFactor`s whose callback evaluates the one row of the
vectorised residual. A pose and a twist are one key each, Pose2 or Pose3 on their manifold; the
callback turns derivatives by the flat vector's columns into ones by GTSAM's local coordinates. A
plain CustomFactor makes every C++ optimiser quadratic, since all values are copied at each
callback; inside a `WnoaInterpFactorPoint3` with nothing to interpolate the callback sees only its
own keys, and the time is linear. The robust loss sits in the callback: a GTSAM Robust model in
there crashes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import gtsam
import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.factors.block import Block
from ubl_graph.factors.loss import RobustLoss
from ubl_graph.factors.poses import PoseMotion
from ubl_graph.gtsam_batch import ABOUT_FIRST, Batch, Callback
from ubl_graph.layout import Columns, Variable
from ubl_graph.problem import Frozen, LeastSquares

#: GTSAM symbol of each kind of variable; beacons are b(j).
LETTERS = {
    "position": "x",
    "pose": "x",
    "twist": "v",
    "velocity": "v",
    "acceleration": "a",
    "sound_speed": "g",
    "current": "w",
    "clock_offset": "c",
    "clock_drift": "d",
    "dvl_scale": "s",
    "dvl_misalignment": "m",
    "dvl_bias": "o",
    "heading_bias": "q",
    "gyro_bias": "y",
    "odometry_scale": "k",
    "odometry_turn_bias": "t",
}


class GraphView:
    """Keys, values and graph of a problem.

    Parameters
    ----------
    problem : LeastSquares
        What to look at.
    first : int
        Number of the first node under GTSAM's keys.
    charts : bool
        Whether poses and twists are plain vectors of their columns, and not GTSAM's poses: rows
        that were linearised by the columns are linear then.
    """

    def __init__(self, problem: LeastSquares, first: int = 0, *, charts: bool = False) -> None:
        self.problem, self._charts = problem, charts
        layout = problem.layout
        self.keys: list[int] = keys_of(layout, first)
        # The keys' numbers in `layout.variables`, sorted as gtsam.Values iterates: by key.
        self._zeros = values_of(layout, self.keys, np.zeros(layout.size), charts=charts)

    def values(self, x: FloatArray) -> gtsam.Values:
        """The flat vector `x` as gtsam.Values."""
        return values_of(self.problem.layout, self.keys, x, charts=self._charts)

    def vector(self, values: gtsam.Values) -> FloatArray:
        """The flat vector of gtsam.Values."""
        x = np.empty(self.problem.layout.size)
        for key, variable in zip(self.keys, self.problem.layout.variables, strict=True):
            read = kind_of(variable, charts=self._charts).read
            x[variable.column : variable.column + variable.size] = read(values, key)
        return x

    def graph(self, frozen: Frozen, *, batched: bool = False) -> gtsam.NonlinearFactorGraph:
        """All rows as factors, with `frozen` held by the range factors.

        With `batched` the first factor has all rows evaluated at once wherever an optimiser asks
        for the graph's error (`gtsam_batch`).
        """
        graph = gtsam.NonlinearFactorGraph()
        batch = None
        if batched and not self._charts:
            batch = Batch(self.problem.layout, self.keys)
            graph.add(batch.herald())
        for block, held in zip(self.problem.blocks, frozen, strict=True):
            if isinstance(block, PoseMotion) and self.problem.layout.node == "pose3":
                self._add_pose_motion(graph, block)
            elif block.linear and not self._touches_poses(block):
                self.add_linear(graph, block)
            else:
                self._add_custom(graph, block, held, batch)
        return graph

    def ordering(self) -> gtsam.Ordering:
        """Elimination along the chain, what nodes share last."""
        ordering = gtsam.Ordering()
        for key in self.keys:
            ordering.push_back(key)
        return ordering

    def add_linear(self, graph: gtsam.NonlinearFactorGraph, block: Block) -> None:
        """Add a linear block's rows to a graph."""
        zero = np.zeros(self.problem.layout.size)
        residual, jacobian = block.evaluate(zero)
        assert jacobian is not None
        noise = gtsam.noiseModel.Unit.Create(residual.shape[1])
        for r, matrix, columns in zip(residual, jacobian, block.columns, strict=True):
            numbers, groups = self._group(columns)
            keys = [self.keys[n] for n in numbers]
            blocks: list[FloatArray] = []
            for n, group in zip(numbers, groups, strict=True):
                variable = self.problem.layout.variables[n]
                whole = np.zeros((len(r), variable.size), order="F")
                # A row may touch part of a variable (depth: the up of a position).
                whole[:, columns[group] - variable.column] = matrix[:, group]
                blocks.append(whole)
            factor = jacobian_factor(keys, blocks, -r, noise)
            graph.add(gtsam.LinearContainerFactor(factor, self._zeros))

    def _touches_poses(self, block: Block) -> bool:
        if self._charts:
            return False
        numbers, _ = self._group(block.columns.ravel())
        return any(self.problem.layout.variables[n].name in ("pose", "twist") for n in numbers)

    def _add_pose_motion(self, graph: gtsam.NonlinearFactorGraph, block: PoseMotion) -> None:
        """GTSAM's own factor of white noise on the twist's change, the same residual.

        Its planar sister is off by up to 7e-6 m/s where a vehicle turns by 1e-5 rad, too much for
        an answer that two solvers are to agree on.
        """
        for columns, dt, psd in zip(block.columns, block.dt, block.psd, strict=True):
            numbers, _ = self._group(columns)
            first, rate, second, next_rate = (self.keys[n] for n in numbers)
            one = gtsam.StateData(first, rate, 0.0)
            two = gtsam.StateData(second, next_rate, dt)
            graph.add(gtsam.WnoaMotionFactorPose3(one, two, psd[ABOUT_FIRST]))

    def _add_custom(
        self,
        graph: gtsam.NonlinearFactorGraph,
        block: Block,
        held: FloatArray | None,
        batch: Batch | None,
    ) -> None:
        # One flat vector serves all callbacks: each writes its own columns before it evaluates.
        scratch = np.zeros(self.problem.layout.size)
        size = 1
        if not block.robust:
            size = block.evaluate(scratch, held, slice(0, 1), jacobian=False)[0].shape[1]
        noise = gtsam.noiseModel.Unit.Create(size)
        loss = self.problem.loss if block.robust else RobustLoss("none")
        number = 0 if batch is None else batch.add(block, held, loss)
        for i, columns in enumerate(block.columns):
            alone = partial(self._callback, block, held, i, scratch)
            if batch is None:
                keys = [self.keys[n] for n in self._group(columns)[0]]
                callback = alone()
            else:
                keys, callback = batch.row(number, i, alone)
            factor = gtsam.CustomFactor(noise, keys, callback)
            graph.add(wrapped(factor, keys))

    def _group(self, columns: IntArray) -> tuple[list[int], list[IntArray]]:
        """Variables that a row touches, and where each one's columns stand in the row."""
        owner = np.where(columns >= 0, self.problem.layout.variable_of_column[columns], -1)
        numbers = [int(n) for n in np.unique(owner) if n >= 0]
        return numbers, [np.flatnonzero(owner == n) for n in numbers]

    def _callback(
        self,
        block: Block,
        held: FloatArray | None,
        row: int,
        scratch: FloatArray,
    ) -> Callback:
        numbers, groups = self._group(block.columns[row])
        variables = [self.problem.layout.variables[n] for n in numbers]
        keys = [self.keys[n] for n in numbers]
        rows = slice(row, row + 1)
        loss = self.problem.loss if block.robust else RobustLoss("none")
        kinds = [kind_of(v, charts=self._charts) for v in variables]
        access = [
            (kind.read, key, slice(v.column, v.column + v.size))
            for kind, v, key in zip(kinds, variables, keys, strict=True)
        ]
        # A row may touch a variable several times (legs that meet it, which add up) or in part.
        parts: list[tuple[IntArray, FloatArray, Slope | None]] = []
        for group, v, kind in zip(groups, variables, kinds, strict=True):
            place = np.zeros((len(group), v.size))
            place[np.arange(len(group)), block.columns[row, group] - v.column] = 1.0
            parts.append((group, place, kind.slope))

        own = np.concatenate([np.arange(v.column, v.column + v.size) for v in variables])
        # The optimiser asks for the error at a trial point and, if it takes it, for the Jacobians
        # at the same point: what was computed last is kept.
        last: list[FloatArray] = []

        def evaluate(
            _: Any, values: gtsam.Values, jacobians: list[FloatArray] | None
        ) -> FloatArray:
            for read, key, where in access:
                scratch[where] = read(values, key)
            at = scratch[own]
            if not last or not (last[0] == at).all():
                r, jacobian = block.evaluate(scratch, held, rows)
                assert jacobian is not None
                last[:] = at, r, jacobian[0]
            _, r, lines = last
            if jacobians is None:
                return loss.shaped(r)[0]
            if block.robust:
                lines = np.sqrt(loss.weights(r)).T * lines
                r = np.sqrt(loss.weights(r)) * r
            for j, (group, place, slope) in enumerate(parts):
                by_columns = lines[:, group] @ place
                if slope is not None:
                    by_columns = by_columns @ slope(values, keys[j])
                jacobians[j] = by_columns
            return r[0]

        return evaluate


def keys_of(layout: Columns, first: int = 0) -> list[int]:
    """GTSAM keys of all variables, in the layout's order; nodes are counted from `first`."""
    beacons, shared = 0, dict(layout.shared)
    keys: list[int] = []
    for variable in layout.variables:
        if variable.name in LETTERS:
            node = 0 if variable.name in shared else first
            keys.append(gtsam.symbol(LETTERS[variable.name], node + variable.index))
        else:
            keys.append(gtsam.symbol("b", beacons))
            beacons += 1
    return keys


def values_of(
    layout: Columns, keys: Sequence[int], x: FloatArray, *, charts: bool = False
) -> gtsam.Values:
    """gtsam.Values of the flat vector `x`; with `charts` poses are plain vectors."""
    values = gtsam.Values()
    for key, variable in zip(keys, layout.variables, strict=True):
        columns = x[variable.column : variable.column + variable.size]
        values.insert(key, kind_of(variable, charts=charts).write(columns))
    return values


#: Derivative of a variable's columns by GTSAM's local coordinates, (size, size).
Slope = Callable[[gtsam.Values, int], FloatArray]


class Kind(NamedTuple):
    """How GTSAM holds a variable: to and from its columns, and how these change with it."""

    read: Callable[[gtsam.Values, int], FloatArray]
    write: Callable[[FloatArray], Any]
    slope: Slope | None


def kind_of(variable: Variable, *, charts: bool = False) -> Kind:
    """How GTSAM holds a variable; with `charts` poses are plain vectors."""
    if charts:
        return _VECTORS[variable.size]
    if variable.name == "pose":
        return _KINDS[variable.name, variable.size]
    if variable.name == "twist" and variable.size == 6:
        return _KINDS[variable.name, variable.size]
    return _VECTORS[variable.size]


def _read_pose3(values: gtsam.Values, key: int) -> FloatArray:
    pose = values.atPose3(key)
    return np.concatenate([pose.translation(), gtsam.Rot3.Logmap(pose.rotation())])


def _write_pose3(columns: FloatArray) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.Expmap(columns[3:]), columns[:3])


def _slope_pose3(values: gtsam.Values, key: int) -> FloatArray:
    rotation = values.atPose3(key).rotation()
    slope = np.zeros((6, 6))
    slope[:3, 3:] = rotation.matrix()
    slope[3:, :3] = gtsam.Rot3.LogmapDerivative(gtsam.Rot3.Logmap(rotation))
    return slope


def _read_pose2(values: gtsam.Values, key: int) -> FloatArray:
    pose = values.atPose2(key)
    return np.array([pose.x(), pose.y(), pose.theta()])


def _slope_pose2(values: gtsam.Values, key: int) -> FloatArray:
    slope = np.eye(3)
    slope[:2, :2] = values.atPose2(key).rotation().matrix()
    return slope


def _write_pose2(columns: FloatArray) -> gtsam.Pose2:
    return gtsam.Pose2(*columns)


def _read_twist3(values: gtsam.Values, key: int) -> FloatArray:
    return values.atVector(key)[ABOUT_FIRST]


def _write_twist3(columns: FloatArray) -> FloatArray:
    return columns[ABOUT_FIRST]


def _slope_twist3(values: gtsam.Values, key: int) -> FloatArray:  # noqa: ARG001 - the same anywhere
    return np.eye(6)[:, ABOUT_FIRST]


def _read_vector(values: gtsam.Values, key: int) -> FloatArray:
    return values.atVector(key)


def _read_point2(values: gtsam.Values, key: int) -> FloatArray:
    return values.atPoint2(key)


def _read_point3(values: gtsam.Values, key: int) -> FloatArray:
    return values.atPoint3(key)


def _as_it_is(columns: FloatArray) -> FloatArray:
    return columns


_KINDS: dict[tuple[str, int], Kind] = {
    ("pose", 6): Kind(_read_pose3, _write_pose3, _slope_pose3),
    ("pose", 3): Kind(_read_pose2, _write_pose2, _slope_pose2),
    ("twist", 6): Kind(_read_twist3, _write_twist3, _slope_twist3),
}
_VECTORS: dict[int, Kind] = {
    1: Kind(_read_vector, _as_it_is, None),
    2: Kind(_read_point2, _as_it_is, None),
    3: Kind(_read_point3, _as_it_is, None),
    6: Kind(_read_vector, _as_it_is, None),
}


def wrapped(factor: gtsam.CustomFactor, keys: Sequence[int]) -> gtsam.WnoaInterpFactorPoint3:
    """The custom factor in the wrapper that hands its callback its own keys only."""
    states = {
        gtsam.StateData(keys[0], keys[0], 0.0),
        gtsam.StateData(keys[-1], keys[-1], 1.0),
    }
    return gtsam.WnoaInterpFactorPoint3(factor, states, set(), np.ones(3), True)


def jacobian_factor(
    keys: Sequence[int], blocks: Sequence[FloatArray], b: FloatArray, noise: Any
) -> gtsam.GaussianFactor:
    """JacobianFactor over any number of keys.

    The binding takes three at the most. Further ones go through helper variables: each row
    `helper - (two terms)` has unit noise, and so has the last row, the sum. Eliminating n helpers
    leaves the sum with variance n + 1, so all is scaled by sqrt(n + 1) beforehand; elimination
    by QR keeps it a JacobianFactor, exact to rounding.
    """
    keys, blocks = list(keys), list(blocks)
    rows = len(b)
    graph = gtsam.GaussianFactorGraph()
    helpers: list[int] = []
    eye = np.eye(rows)
    scale = np.sqrt(max(len(keys) - 2, 1))
    blocks = [scale * block for block in blocks]
    while len(keys) > 3:
        helper = gtsam.symbol("h", len(helpers))
        helpers.append(helper)
        graph.add(helper, -eye, keys[0], blocks[0], keys[1], blocks[1], np.zeros(rows), noise)
        keys, blocks = [*keys[2:], helper], [*blocks[2:], eye]
    terms = [item for pair in zip(keys, blocks, strict=True) for item in pair]
    add: Any = graph.add  # the stub lists one overload per number of keys
    add(*terms, scale * b, noise)
    if not helpers:
        return graph.at(0)
    _, rest = graph.eliminatePartialSequential(helpers, gtsam.EliminateQR)
    return rest.at(0)
