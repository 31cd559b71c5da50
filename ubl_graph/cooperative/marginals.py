"""Covariances of a fleet's unknowns: of each vehicle's nodes, and of what belongs to none."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.cooperative.model import FleetProblem
from ubl_graph.layout import Layout
from ubl_graph.solve.inverse import inverse_band, taken
from ubl_graph.solve.marginals import DOUBTFUL_PIVOT, RIDGES, Covariances, scaled_factor
from ubl_graph.solve.normal import NormalEquations, Point
from ubl_graph.solve.rounds import Solution

#: A vehicle or target that a full step would move by less than this share of its standard deviation
#: is where it will stay, whatever the others still do.
SETTLED = 0.1


class FleetMarginals:
    """Covariances of the unknowns of a fleet at a solution.

    Parameters
    ----------
    problem : FleetProblem
        What was solved.
    solution : Solution
        Where it ended.

    Raises
    ------
    SolverError
        Where the normal equations are not finite or an unknown enters no residual.
    """

    def __init__(self, problem: FleetProblem, solution: Solution) -> None:
        self._layout = problem.layout
        equations = NormalEquations(problem)
        point = equations.evaluate(solution.x, solution.frozen)
        # No single residual need join all that two neighbouring nodes hold.
        spans = [self._span(i) for i in range(len(problem.layout.vehicles))]
        reach = max(equations.shape.reach, *spans)
        self._found = _Inverse(equations, point, RIDGES, reach)
        self._larger: _Inverse | None = None
        if self._found.doubtful:
            # What a larger ridge lowers, the ridge has made, or rounding has.
            ridge = max(10.0 * self._found.ridge, DOUBTFUL_PIVOT)
            self._larger = _Inverse(equations, point, [ridge], reach)
        self._step = self._found.step(equations.gradient(point))

    def settled(self, number: int) -> bool:
        """Whether a full step would leave one vehicle where it is, as far as it is known at all."""
        layout = self._layout.vehicles[number]
        own = layout.node_columns("position", np.zeros(1, dtype=np.int64))[0]
        columns = self._columns(number)[:, own]
        variance = np.diagonal(self._found.of(columns, columns), axis1=1, axis2=2)
        return bool((np.abs(self._step[columns]) <= SETTLED * np.sqrt(variance)).all())

    def common_settled(self, name: str) -> bool:
        """The same of what belongs to no vehicle."""
        columns = self._layout.common_columns(name)
        variance = np.diagonal(self._found.border(columns, columns))
        return bool((np.abs(self._step[columns]) <= SETTLED * np.sqrt(variance)).all())

    def vehicle(self, number: int) -> Covariances:
        """Those of one vehicle, by its own layout."""
        layout, place = self._layout.vehicles[number], self._layout.place[number]
        columns, border = self._columns(number), place[layout.inner :]
        found = self._found
        node = found.of(columns, columns)
        following = found.of(columns[:-1], columns[1:])
        unresolved = np.zeros(len(columns), dtype=np.bool_)
        if self._larger is not None:
            own = layout.node_columns("position", np.zeros(1, dtype=np.int64))[0]
            larger = self._larger.of(columns[:, own], columns[:, own])
            before = np.einsum("nii->n", node[:, own[:, None], own])
            unresolved = np.einsum("nii->n", larger) < 0.5 * before
        shared = found.border(border, border)
        return Covariances(layout, node, following, shared, found.scale[place], unresolved)

    def _columns(self, number: int) -> IntArray:
        """Columns of each node of a vehicle, (N, W)."""
        layout, place = self._layout.vehicles[number], self._layout.place[number]
        return place[: layout.inner].reshape(layout.node_count, layout.node_width)

    def _span(self, number: int) -> int:
        """Diagonals that neighbouring nodes of a vehicle need."""
        columns = self._columns(number)
        width = columns.shape[1]
        return int((columns[1:, -1] - columns[:-1, 0]).max(initial=width - 1)) + 1

    def common(self, names: Sequence[str]) -> FloatArray:
        """Joint covariance of some of what belongs to no vehicle, SI, in this order."""
        columns = [self._layout.common_columns(name) for name in names]
        whole = np.concatenate(columns)
        units = np.concatenate(
            [np.full(len(c), Layout.unit(n)) for c, n in zip(columns, names, strict=True)]
        )
        scale = self._found.scale[whole] * units
        return scale[:, None] * self._found.border(whole, whole) * scale


class _Inverse:
    """The scaled inverse where it is asked for, with the first ridge that lets it be computed."""

    def __init__(
        self, equations: NormalEquations, point: Point, ridges: Sequence[float], reach: int
    ) -> None:
        factor, self.scale, self.ridge = scaled_factor(equations, point, ridges)
        self._factor = factor
        pivots = factor.band[0]
        self._inner = factor.band.shape[1]
        self._corner = np.empty((0, 0))
        self._share = np.empty((self._inner, 0))
        if len(factor.corner):
            self._share = factor.solve_transposed(factor.coupling)
            self._corner = factor.inverse_corner()
            pivots = np.append(pivots, factor.corner.diagonal())
        self.doubtful = self.ridge > 0.0 or float(pivots.min()) ** 2 < DOUBTFUL_PIVOT
        rows = np.zeros((reach - len(factor.band), self._inner))
        self._band = inverse_band(np.concatenate([factor.band, rows]))

    def step(self, gradient: FloatArray) -> FloatArray:
        """Where a full Gauss-Newton step leads, in scaled columns."""
        return self._factor.solve(-self.scale * gradient)

    def of(self, rows: IntArray, columns: IntArray) -> FloatArray:
        """Blocks (N, R, C) between the nodes' columns `rows` (N, R) and `columns` (N, C)."""
        own = taken(self._band, rows[:, :, None], columns[:, None, :])
        if not len(self._corner):
            return own
        return own + self._share[rows] @ self._corner @ np.swapaxes(self._share[columns], 1, 2)

    def border(self, rows: IntArray, columns: IntArray) -> FloatArray:
        """Block (R, C) between columns of the border."""
        return self._corner[np.ix_(rows - self._inner, columns - self._inner)]
