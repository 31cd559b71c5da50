"""What both ways of a survey solve with: a start far off, covariances, residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.assembly import direction
from ubl_graph.builder import RANGE_BIAS
from ubl_graph.factors.ranges import RangeBlock
from ubl_graph.measurements import SlantRange
from ubl_graph.nodes import NOMINAL_SPEED
from ubl_graph.pings import Pings, kind_of, leg_times, measured_times
from ubl_graph.problem import Frozen, LeastSquares, Problem
from ubl_graph.result import RangeResiduals, SlowState, Status
from ubl_graph.solve.banded import BandedEngine
from ubl_graph.solve.marginals import RIDGES, Covariances, scaled_factor, selected_inverse
from ubl_graph.solve.normal import NormalEquations
from ubl_graph.solve.rounds import Solution
from ubl_graph.survey.noise import robust_scale

#: Sigmas are widened to what a beacon's ranges scatter by, until that is no more than this.
NEAR = 3.0
#: Where a beacon is known worse than this share of the typical range, its place is bent along its
#: ranges by more than these err, and the linearised covariance means nothing.
UNOBSERVED_SHARE = 0.05
#: At each width so many steps are taken, and so many widths at the most.
STEPS, MOST_WIDTHS = 3, 12


def approach(engine: BandedEngine, x: FloatArray, beacons: Sequence[FloatArray]) -> FloatArray:
    """Bring beacons that begin far off near enough for a robust solve.

    Ranges of a beacon that is 30 m off are outliers all of them, and a robust loss lets them be.
    So the sigmas of each beacon's ranges begin as wide as these scatter, and shrink with it.

    Parameters
    ----------
    engine : BandedEngine
        Of the problem.
    x : array
        Start, flat vector.
    beacons : sequence of array of str
        Name of the beacon of each row, for each range block of the problem, in order.

    Returns
    -------
    array
        Flat vector.
    """
    problem = engine.problem
    names = np.concatenate(list(beacons))
    for _ in range(MOST_WIDTHS):
        frozen = problem.frozen(x)
        whitened = whitened_ranges(problem, x, frozen)
        all_rows = np.concatenate(whitened)
        width = np.ones(len(names))
        for name in np.unique(names):
            mine = names == name
            width[mine] = max(robust_scale(all_rows[mine]), 1.0)
        if width.max() <= NEAR:
            break
        each = iter(np.split(width, np.cumsum([len(r) for r in whitened])[:-1]))
        wide = tuple(
            held * next(each) if isinstance(block, RangeBlock) and held is not None else held
            for block, held in zip(problem.blocks, frozen, strict=True)
        )
        descent = engine.begin(x, wide)
        for _ in range(STEPS):
            descent.iterate()
        x = descent.vector()
    return x


def whitened_ranges(problem: LeastSquares, x: FloatArray, frozen: Frozen) -> list[FloatArray]:
    """Whitened residuals (M,) of each range block at `x`."""
    return [
        block.evaluate(x, held, jacobian=False)[0][:, 0]
        for block, held in zip(problem.blocks, frozen, strict=True)
        if isinstance(block, RangeBlock)
    ]


def typical_range(pings: Sequence[Pings]) -> float:
    """Median range of some records, m."""
    legs = [measured_times(rows)[0] / leg_times(rows).shape[1] for rows in pings]
    return NOMINAL_SPEED * float(np.median(np.abs(np.concatenate(legs))))


@dataclass(frozen=True, eq=False)
class Estimate:
    """A problem with its solution, and what is read off them.

    Attributes
    ----------
    problem : Problem
        Of knots or of nodes, with beacons among what is shared.
    solution : Solution
        Of it.
    """

    problem: Problem
    solution: Solution

    @property
    def cost(self) -> float:
        """Sum of the losses."""
        return self.solution.cost

    @cached_property
    def _parts(self) -> tuple[Covariances, FloatArray]:
        """Covariances of the nodes' states, and of all that is shared together, SI."""
        layout = self.problem.layout
        equations = NormalEquations(self.problem)
        point = equations.evaluate(self.solution.x, self.solution.frozen)
        factor, scale, _ = scaled_factor(equations, point, RIDGES)
        width = layout.node_width
        node, following = selected_inverse(factor.band, width)
        share = factor.solve_transposed(factor.coupling).reshape(-1, width, len(factor.corner))
        shared = factor.inverse_corner()
        taken = share @ shared
        node += taken @ np.swapaxes(share, 1, 2)
        following += taken[:-1] @ np.swapaxes(share[1:], 1, 2)
        unresolved = np.zeros(layout.node_count, dtype=np.bool_)
        found = Covariances(layout, node, following, shared, scale, unresolved)
        units = np.concatenate([np.full(size, layout.unit(name)) for name, size in layout.shared])
        outer = scale[layout.inner :] * units
        return found, outer[:, None] * shared * outer

    def slow(self, t: FloatArray) -> dict[str, SlowState]:
        """The slow states at the nodes, whose times are `t`."""
        layout, found = self.problem.layout, self._parts[0]
        return {
            name: SlowState(
                t,
                layout.get(self.solution.x, name),
                np.sqrt(np.einsum("nii->ni", found.of(name))),
            )
            for name, _ in layout.slow
        }

    def beacons(self, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
        """Positions (B, 3) and joint covariance (3 B, 3 B) of some beacons."""
        layout, x = self.problem.layout, self.solution.x
        each = [layout.shared_columns(f"beacon {name}") for name in names]
        columns = np.concatenate([np.empty(0, dtype=np.int64), *each])
        local = columns - layout.inner
        return x[columns].reshape(-1, 3), self._parts[1][np.ix_(local, local)]

    def range_bias(self, names: Sequence[str]) -> dict[str, tuple[float, float]]:
        """Range biases and their standard deviations, m, where they are unknowns."""
        layout = self.problem.layout
        found: dict[str, tuple[float, float]] = {}
        for name in names:
            if layout.has(f"{RANGE_BIAS}{name}"):
                at = int(layout.shared_columns(f"{RANGE_BIAS}{name}")[0])
                variance = self._parts[1][at - layout.inner, at - layout.inner]
                found[name] = float(self.solution.x[at]), float(np.sqrt(variance))
        return found

    def status(self, names: Sequence[str], pings: Sequence[Pings]) -> tuple[Status, str]:
        """Whether the solver came to rest and the data determine every beacon, and why not."""
        limit = UNOBSERVED_SHARE * typical_range(pings)
        covariance = self.beacons(names)[1]
        for i, name in enumerate(names):
            own = slice(3 * i, 3 * i + 3)
            values, vectors = np.linalg.eigh(covariance[own, own])
            if values[-1] > limit**2:
                return "unobservable", (
                    f"the ranges do not determine '{name}' {direction(vectors[:, -1])} (standard "
                    f"deviation {np.sqrt(values[-1]):.0f} m)"
                )
        if not self.solution.converged:
            return "not converged", self.solution.trouble
        return "converged", ""

    def residuals(self, pings: Sequence[Pings]) -> list[RangeResiduals]:
        """Residuals of each range block, whose records are `pings`, in order."""
        x, solution = self.solution.x, self.solution
        blocks = [
            (block, held)
            for block, held in zip(self.problem.blocks, solution.frozen, strict=True)
            if isinstance(block, RangeBlock)
        ]
        whitened = whitened_ranges(self.problem, x, solution.frozen)
        tables: list[RangeResiduals] = []
        for (block, held), r, rows in zip(blocks, whitened, pings, strict=True):
            assert held is not None
            at_once = isinstance(rows, SlantRange)
            tables.append(
                RangeResiduals(
                    np.full(len(rows), kind_of(rows).removesuffix("_range")),
                    rows.beacon,
                    rows.t if at_once else rows.t_transmit,
                    rows.t if at_once else rows.t_receive,
                    measured_times(rows)[0],
                    held,
                    r * held,
                    self.problem.loss.weights(r),
                    block.found(x),
                )
            )
        return tables
