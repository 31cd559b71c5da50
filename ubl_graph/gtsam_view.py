"""A Problem as GTSAM sees it: a factor graph over keys, each factor a view on one row.

Linear rows become native factors (`LinearContainerFactor`); range rows become `CustomFactor`s
whose callback evaluates the one row of the vectorised residual. A plain CustomFactor makes every
C++ optimiser quadratic, since all values are copied at each callback; inside a
`WnoaInterpFactorPoint3` with nothing to interpolate the callback sees only its own keys, and the
time is linear. The robust loss sits in the callback: a GTSAM Robust model in there crashes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gtsam
import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.factors.block import Block
from ubl_graph.factors.loss import RobustLoss
from ubl_graph.layout import Layout, Variable
from ubl_graph.problem import Frozen, Problem

#: GTSAM symbol of each kind of variable; beacons are b(j).
LETTERS = {
    "position": "x",
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
}


class GraphView:
    """Keys, values and graph of a problem.

    Parameters
    ----------
    problem : Problem
        What to look at.
    first : int
        Number of the first node under GTSAM's keys.
    """

    def __init__(self, problem: Problem, first: int = 0) -> None:
        self.problem = problem
        layout = problem.layout
        self.keys: list[int] = keys_of(layout, first)
        # The keys' numbers in `layout.variables`, sorted as gtsam.Values iterates: by key.
        self._zeros = values_of(layout, self.keys, np.zeros(layout.size))

    def values(self, x: FloatArray) -> gtsam.Values:
        """The flat vector `x` as gtsam.Values."""
        return values_of(self.problem.layout, self.keys, x)

    def vector(self, values: gtsam.Values) -> FloatArray:
        """The flat vector of gtsam.Values."""
        x = np.empty(self.problem.layout.size)
        for key, variable in zip(self.keys, self.problem.layout.variables, strict=True):
            x[variable.column : variable.column + variable.size] = _READ[variable.size](values, key)
        return x

    def graph(self, frozen: Frozen) -> gtsam.NonlinearFactorGraph:
        """All rows as factors, with `frozen` held by the range factors."""
        graph = gtsam.NonlinearFactorGraph()
        for block, held in zip(self.problem.blocks, frozen, strict=True):
            if block.linear:
                self.add_linear(graph, block)
            else:
                self._add_custom(graph, block, held)
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

    def _add_custom(
        self, graph: gtsam.NonlinearFactorGraph, block: Block, held: FloatArray | None
    ) -> None:
        # One flat vector serves all callbacks: each writes its own columns before it evaluates.
        scratch = np.zeros(self.problem.layout.size)
        noise = gtsam.noiseModel.Unit.Create(1)
        for i, columns in enumerate(block.columns):
            numbers, groups = self._group(columns)
            variables = [self.problem.layout.variables[n] for n in numbers]
            keys = [self.keys[n] for n in numbers]
            callback = self._callback(block, held, i, keys, variables, groups, scratch)
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
        keys: list[int],
        variables: list[Variable],
        groups: list[IntArray],
        scratch: FloatArray,
    ) -> Callable[[Any, gtsam.Values, list[FloatArray] | None], FloatArray]:
        rows = slice(row, row + 1)
        loss = self.problem.loss if block.robust else RobustLoss("none")
        access = [
            (_READ[v.size], key, slice(v.column, v.column + v.size))
            for v, key in zip(variables, keys, strict=True)
        ]
        # Range rows touch whole variables, once for each leg that meets them: legs add up.
        legs = [group.reshape(-1, v.size) for group, v in zip(groups, variables, strict=True)]

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
                last[:] = at, r, jacobian[0, 0]
            _, r, line = last
            if jacobians is None:
                return loss.shaped(r)[0]
            root = np.sqrt(loss.weights(r))
            line = root[0, 0] * line
            for j, leg in enumerate(legs):
                jacobians[j] = line[leg].sum(axis=0, keepdims=True)
            return (root * r)[0]

        return evaluate


def keys_of(layout: Layout, first: int = 0) -> list[int]:
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


def values_of(layout: Layout, keys: Sequence[int], x: FloatArray) -> gtsam.Values:
    """gtsam.Values of the flat vector `x`."""
    values = gtsam.Values()
    for key, variable in zip(keys, layout.variables, strict=True):
        values.insert(key, x[variable.column : variable.column + variable.size])
    return values


_READ: dict[int, Callable[[gtsam.Values, int], FloatArray]] = {
    1: lambda values, key: values.atVector(key),
    2: lambda values, key: values.atPoint2(key),
    3: lambda values, key: values.atPoint3(key),
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
