"""Levenberg-Marquardt by GTSAM over a Problem, and what came of it.

The schedule is Cao's (2017, Table 1): lambda starts at 1e-3 and changes by a factor of ten.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.errors import SolverError
from ubl_graph.gtsam_view import GraphView
from ubl_graph.problem import Frozen, Problem

INITIAL_LAMBDA, LAMBDA_FACTOR, LARGEST_LAMBDA = 1e-3, 10.0, 1e10
#: A solve is done when an iteration lowers the cost by less than this share of it,
RELATIVE_DECREASE = 1e-10
#: or by less than this: a step of a hundred-thousandth of a standard deviation.
ABSOLUTE_DECREASE = 1e-9
#: Rounds in which the interpolation's variance is taken anew at the last estimate.
FREEZE_ROUNDS = 5
#: They end when no standard deviation changes by more than this share.
FREEZE_TOLERANCE = 1e-4

#: Called with the iteration's number and cost.
Progress = Callable[[int, float], None]


@dataclass(frozen=True, eq=False)
class Solution:
    """Where a solver ended.

    Attributes
    ----------
    x : array
        The flat vector of all unknowns.
    frozen : tuple
        What was held fixed in the last round; the covariance belongs to it.
    cost : float
        Sum of the losses at `x`.
    iterations : int
        Of all rounds.
    converged : bool
        Whether the cost came to rest within the iterations allowed.
    """

    x: FloatArray
    frozen: Frozen
    cost: float
    iterations: int
    converged: bool


def solve(
    problem: Problem, x: FloatArray, max_iterations: int = 100, progress: Progress | None = None
) -> Solution:
    """Minimise a problem's cost from the start `x` with GTSAM's Levenberg-Marquardt.

    Parameters
    ----------
    problem : Problem
        What to solve.
    x : array
        Start, flat vector.
    max_iterations : int
        For all rounds together.
    progress : callable, optional
        Called after each iteration.

    Raises
    ------
    SolverError
        Where the start or the solver's answer is not finite.
    """
    if not np.isfinite(x).all():
        raise SolverError("the start of the solver holds values that are not finite")
    view = GraphView(problem)
    used = 0
    frozen = problem.frozen(x)
    while True:
        x, cost, iterations, converged = _round(
            view, x, frozen, max_iterations - used, used, progress
        )
        used += iterations
        anew = problem.frozen(x)
        settled = _change(frozen, anew) < FREEZE_TOLERANCE
        if settled or not converged or used >= max_iterations * FREEZE_ROUNDS:
            return Solution(x, frozen, cost, used, converged)
        frozen = anew


def _round(
    view: GraphView,
    x: FloatArray,
    frozen: Frozen,
    budget: int,
    before: int,
    progress: Progress | None,
) -> tuple[FloatArray, float, int, bool]:
    """One run of the optimiser: estimate, cost, iterations, converged."""
    graph = view.graph(frozen)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, view.values(x), _parameters(view))
    cost = optimizer.error()
    for done in range(1, max(budget, 1) + 1):
        optimizer.iterate()
        previous, cost = cost, optimizer.error()
        if progress is not None:
            progress(before + done, cost)
        if previous - cost <= ABSOLUTE_DECREASE + RELATIVE_DECREASE * cost:
            answer = view.vector(optimizer.values())
            if not np.isfinite(answer).all() or not np.isfinite(cost):
                raise SolverError("Levenberg-Marquardt ended in values that are not finite")
            return answer, cost, done, bool(optimizer.lambda_() < LARGEST_LAMBDA)
    return view.vector(optimizer.values()), cost, max(budget, 1), False


def _parameters(view: GraphView) -> gtsam.LevenbergMarquardtParams:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setlambdaInitial(INITIAL_LAMBDA)
    parameters.setlambdaFactor(LAMBDA_FACTOR)
    parameters.setlambdaUpperBound(LARGEST_LAMBDA)
    parameters.setOrdering(view.ordering())
    parameters.setLinearSolverType("SEQUENTIAL_CHOLESKY")
    return parameters


def _change(before: Frozen, after: Frozen) -> float:
    """Largest relative change of what is held fixed."""
    changes = [
        float(np.max(np.abs(b / a - 1.0), initial=0.0))
        for a, b in zip(before, after, strict=True)
        if a is not None and b is not None
    ]
    return max(changes, default=0.0)
