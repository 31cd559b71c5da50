"""The window's least squares: the dense normal equations of all vehicles' rows, and their solution.

Ranges join any vehicle with any other, so the equations have no band to speak of; some hundred
nodes make a few hundred columns, which LAPACK's Cholesky factors in milliseconds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import get_lapack_funcs

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.cooperative.fleet import Fleet
from ubl_graph.errors import SolverError
from ubl_graph.factors.loss import RobustLoss
from ubl_graph.layout import Chain, Layout
from ubl_graph.online.fleet_blocks import Blocks, Factor, Rows
from ubl_graph.online.fleet_line import Line, Node
from ubl_graph.online.fleet_prior import Prior

_potrf, _potrs, _trtrs = get_lapack_funcs(("potrf", "potrs", "trtrs"), dtype=np.float64)

#: Steps of a solve at the most.
MOST_STEPS = 12
#: Half the squared length, in standard deviations, of a step that is not worth taking: half a
#: hundredth of one; the next update goes on from there.
LEAST_DECREMENT = 1e-5
#: A factor is used again while each of its steps gains less than this share of the last one's.
WORTHWHILE = 0.25
#: Costs that differ by less than this share of them are equal to rounding.
SAME_COST = 1e-12
#: Dampings tried, as shares of the diagonal, where the undamped steps fail.
DAMPINGS = (1e-6, 1e-4, 1e-2, 1.0, 1e2, 1e4)


@dataclass(frozen=True, eq=False)
class Evaluated:
    """Whitened rows at a point."""

    rows: Rows
    residual: FloatArray  # (M, R)
    slope: FloatArray  # (M, R, C)
    weight: FloatArray  # (M,), the loss'
    curvature: FloatArray  # (M,)


@dataclass(frozen=True, eq=False)
class Point:
    """The system evaluated at `x`."""

    x: FloatArray
    cost: float
    parts: list[Evaluated]


class System:
    """The least squares of a window.

    Parameters
    ----------
    fleet : Fleet
        Beacons, water, options.
    lines : mapping of str to Line
        All vehicles; those without nodes have no part.
    factors : sequence of Factor
        Rows.
    prior : Prior
        What the past left.
    shared : mapping of str to array
        States that all nodes share, in the layout's units.
    epoch : float
        Time of clocks' offsets and of moving targets' positions, s.
    """

    def __init__(
        self,
        fleet: Fleet,
        lines: Mapping[str, Line],
        factors: Sequence[Factor],
        prior: Prior,
        shared: Mapping[str, FloatArray],
        epoch: float,
    ) -> None:
        self._prior = prior
        self.nodes: list[Node] = []
        chains: list[Chain] = []
        ups: list[FloatArray] = []
        for name, line in lines.items():
            if not line.nodes:
                continue
            times = np.array([node.t for node in line.nodes])
            chains.append(Chain(name, len(self.nodes), times))
            self.nodes += line.nodes
            if line.planar:
                ups.append(line.up_at(times))
        for number, node in enumerate(self.nodes):
            node.number = number
        first = next(iter(lines.values()))
        self.layout = Layout(
            tuple(chains),
            2,
            shared=tuple((name, len(values)) for name, values in shared.items()),
            node=first.options.node,
            still=True,
            held_up=np.concatenate(ups) if ups else None,
        )
        self.x = np.concatenate([*(node.x for node in self.nodes), *shared.values()])
        self._loss = RobustLoss(fleet.options.loss)
        self._prior_columns = prior.columns(self.layout)
        self._blocks = Blocks(fleet, lines, self.layout, epoch)
        self.set_factors(factors)

    @property
    def size(self) -> int:
        """Columns."""
        return self.layout.size

    def set_factors(self, factors: Sequence[Factor]) -> None:
        """Take other factors."""
        self.rows = self._blocks.rows(factors)
        self._places = [_places(r.block.columns, self.size) for r in self.rows]

    # -- equations --

    def evaluate(self, x: FloatArray) -> Point:
        """Residuals, derivatives and cost at `x`."""
        parts: list[Evaluated] = []
        off = self._prior.rows @ x[self._prior_columns] - self._prior.target
        cost = 0.5 * float(off @ off)
        for rows in self.rows:
            residual, slope = rows.block.evaluate(x)
            assert slope is not None
            if rows.block.robust:
                r = residual[:, 0]
                cost += float(self._loss.cost(r).sum())
                weight, curvature = self._loss.weights(r), self._loss.curvature(r)
            else:
                cost += 0.5 * float(np.einsum("mr,mr->", residual, residual))
                weight = curvature = np.ones(len(residual))
            parts.append(Evaluated(rows, residual, slope, weight, curvature))
        return Point(x, cost, parts)

    def gradient(self, point: Point) -> FloatArray:
        """Of the cost."""
        out = np.zeros(self.size + 1)
        columns = self._prior_columns
        off = self._prior.rows @ point.x[columns] - self._prior.target
        out[columns] += self._prior.rows.T @ off
        flat = [part.rows.block.columns.ravel() for part in point.parts]
        pulls = [
            np.einsum("mrc,mr->mc", p.slope, p.residual * p.weight[:, None]).ravel()
            for p in point.parts
        ]
        if flat:
            where = np.concatenate(flat)
            where = np.where(where < 0, self.size, where)
            out += np.bincount(where, np.concatenate(pulls), minlength=self.size + 1)
        return out[:-1]

    def normal(
        self, point: Point, newton: bool = True, unjudged: bool = False, damping: float = 0.0
    ) -> FloatArray:
        """Normal matrix; where `unjudged`, rows that have not been judged count in full."""
        n = self.size
        products: list[FloatArray] = []
        for part in point.parts:
            weight = part.curvature if newton else part.weight
            if unjudged:
                weight = np.where(part.rows.fresh, 1.0, weight)
            weighted = part.slope * weight[:, None, None]
            products.append((np.swapaxes(weighted, 1, 2) @ part.slope).ravel())
        if products:
            flat: Any = np.bincount(
                np.concatenate(self._places), np.concatenate(products), minlength=n * n + 1
            )
        else:
            flat = np.zeros(n * n + 1)
        out = flat[:-1].reshape(n, n)
        columns = self._prior_columns
        out[columns[:, None], columns[None, :]] += self._prior.information
        if damping:
            out[np.arange(n), np.arange(n)] *= 1.0 + damping
        return out

    def factored(self, matrix: FloatArray) -> FloatArray:
        """Lower Cholesky factor; the matrix is overwritten.

        Raises
        ------
        SolverError
            Where the matrix is not positive definite.
        """
        factor, info = _potrf(matrix.T, lower=1, clean=0, overwrite_a=1)
        if info != 0 or not np.isfinite(factor[-1, -1]):
            raise SolverError("the window's equations are singular")
        return factor

    def minimise(self, point: Point, factor: FloatArray | None = None) -> tuple[Point, FloatArray]:
        """Where the cost is least, and the factor of the normal matrix there.

        Parameters
        ----------
        point : Point
            Where to begin.
        factor : array, optional
            Of a normal matrix there, to begin with.

        Raises
        ------
        SolverError
            Where cost or equations are not finite, or singular however damped.
        """
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            for _ in range(MOST_STEPS):
                if not np.isfinite(point.cost):
                    raise SolverError("the window's cost is not finite")
                point, done = self._step(point, factor)
                factor = None
                if done:
                    break
        return point, self.factored(self.normal(point, newton=False))

    def _step(self, point: Point, first: FloatArray | None) -> tuple[Point, bool]:
        """One factor's steps: the next point, and whether the cost is at its least."""
        gradient = self.gradient(point)
        tried = False
        tries = [(True, 0.0), (False, 0.0), *((False, d) for d in DAMPINGS)]
        for newton, damping in [(True, 0.0), *tries] if first is not None else tries:
            try:
                factor = first
                if factor is None:
                    factor = self.factored(self.normal(point, newton, damping=damping))
            except SolverError:
                continue
            first, tried = None, True
            trial, gain = self._moved(point, gradient, factor)
            if gain < LEAST_DECREMENT:
                return point, damping == 0.0
            if trial is None:
                continue
            while damping == 0.0:
                # The same factor serves while it converges fast.
                pull = self.gradient(trial)
                again, next_gain = self._moved(trial, pull, factor)
                if next_gain < LEAST_DECREMENT:
                    return trial, True
                if again is None or next_gain > WORTHWHILE * gain:
                    break
                trial, gain = again, next_gain
            return trial, False
        if not tried:
            raise SolverError("the window's equations are singular, however damped")
        # No step lowers the cost: it is as low as rounding lets it be.
        return point, True

    def _moved(
        self, point: Point, gradient: FloatArray, factor: FloatArray
    ) -> tuple[Point | None, float]:
        """The point a step leads to, None where the cost does not fall, and the gain foreseen."""
        step = -solved(factor, gradient)
        gain = -0.5 * float(gradient @ step)
        if not np.isfinite(gain):
            return None, np.inf
        if gain < LEAST_DECREMENT:
            return None, gain
        trial = self.evaluate(point.x + step)
        lower = trial.cost < point.cost + SAME_COST * abs(point.cost)
        return (trial if lower else None), gain


@dataclass(frozen=True, eq=False)
class Solved:
    """A solved window: what gives means and covariances of its columns.

    Attributes
    ----------
    layout : Layout
        Of the columns.
    x : array
        Flat vector.
    factor : array
        Lower Cholesky factor of the normal matrix.
    nodes : frozenset of Node
        That it holds.
    epoch : float
        Of clocks and moving targets, s.
    """

    layout: Layout
    x: FloatArray
    factor: FloatArray
    nodes: frozenset[Node]
    epoch: float

    def covariance(self, columns: IntArray) -> FloatArray:
        """Joint covariance of some columns, in their units."""
        unit = np.zeros((len(self.x), len(columns)))
        unit[columns, np.arange(len(columns))] = 1.0
        half = lower_solved(self.factor, unit)
        return half.T @ half


def solved(factor: FloatArray, right: FloatArray) -> FloatArray:
    """Solution of the normal equations by their lower factor."""
    out, _ = _potrs(factor, right, lower=1)
    return out


def lower_solved(factor: FloatArray, right: FloatArray) -> FloatArray:
    """L^-1 right."""
    out, _ = _trtrs(factor, right, lower=1)
    return out


def _places(columns: IntArray, size: int) -> IntArray:
    """Where the products of rows' derivatives stand in the flat matrix; behind it for pads."""
    pad = columns < 0
    flat = columns[:, :, None] * size + columns[:, None, :]
    if pad.any():
        flat[pad[:, :, None] | pad[:, None, :]] = size * size
    return flat.ravel()
