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
RELATIVE_DECREASE = 1e-8
#: or by less than this: a step of a ten-thousandth of a standard deviation.
ABSOLUTE_DECREASE = 1e-9
#: Rounds, at most, in which the interpolation's variance is taken anew at the last estimate.
FREEZE_ROUNDS = 5
#: They end when no standard deviation changes by more than this share.
FREEZE_TOLERANCE = 1e-4

#: Widths by which `graduated` multiplies the robust rows' standard deviations, one after another,
GRADUATION = (30.0, 10.0, 3.0)
#: and iterations for each: the next width begins somewhere near in any case.
GRADUATION_ITERATIONS = 10

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
    trouble : str
        Why it did not come to rest; empty where it did.
    """

    x: FloatArray
    frozen: Frozen
    cost: float
    iterations: int
    trouble: str

    @property
    def converged(self) -> bool:
        """Whether the cost came to rest."""
        return not self.trouble


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
        Of each round; between rounds the interpolation's variance is taken anew, and most
        problems, whose pings begin and end at nodes, need one round.
    progress : callable, optional
        Called after each iteration.

    Raises
    ------
    SolverError
        Where the start or the solver's answer is not finite, or GTSAM gives up.
    """
    if not np.isfinite(x).all():
        raise SolverError("the start of the solver holds values that are not finite")
    view = GraphView(problem)
    frozen = problem.frozen(x)
    used, cost = 0, np.inf
    for _ in range(FREEZE_ROUNDS):
        x, cost, iterations, trouble = _round(view, x, frozen, max_iterations, used, progress)
        used += iterations
        anew = problem.frozen(x)
        if trouble or _change(frozen, anew) < FREEZE_TOLERANCE:
            return Solution(x, frozen, cost, used, trouble)
        frozen = anew
    trouble = f"the interpolation's variance did not settle in {FREEZE_ROUNDS} rounds"
    return Solution(x, frozen, cost, used, trouble)


def graduated(problem: Problem, x: FloatArray) -> FloatArray:
    """Approach a robust problem from its convex side: a start for `solve`.

    The standard deviations of the robust rows begin 30 times too wide, where no ping is an
    outlier, and shrink in steps; each step starts where the last one ended. It finds the good
    minimum where a direct solve, begun near a wrong one, lets the true pings be the outliers.

    Parameters
    ----------
    problem : Problem
        What to solve.
    x : array
        Start, flat vector.

    Returns
    -------
    array
        Flat vector after the last step but one; `solve` does the last.

    Raises
    ------
    SolverError
        As `solve` does.
    """
    view = GraphView(problem)
    for width in GRADUATION:
        wide = tuple(None if held is None else width * held for held in problem.frozen(x))
        x, *_ = _round(view, x, wide, GRADUATION_ITERATIONS, 0, None)
    return x


def _round(
    view: GraphView,
    x: FloatArray,
    frozen: Frozen,
    most: int,
    before: int,
    progress: Progress | None,
) -> tuple[FloatArray, float, int, str]:
    """One run of the optimiser: estimate, cost, iterations, and what went wrong."""
    try:
        graph = view.graph(frozen)
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, view.values(x), _parameters(view))
        cost, done, trouble = _iterate(optimizer, most, before, progress)
        answer = view.vector(optimizer.values())
    except RuntimeError as error:
        text = " ".join(str(error).split())[:200]
        raise SolverError(f"GTSAM gave up: {text}") from error
    if not np.isfinite(answer).all():
        raise SolverError("Levenberg-Marquardt ended in values that are not finite")
    return answer, cost, done, trouble


def _iterate(
    optimizer: gtsam.LevenbergMarquardtOptimizer,
    most: int,
    before: int,
    progress: Progress | None,
) -> tuple[float, int, str]:
    """Iterate until the cost comes to rest: cost, iterations, and what went wrong."""
    cost = optimizer.error()
    for done in range(1, most + 1):
        optimizer.iterate()
        previous, cost = cost, optimizer.error()
        if not np.isfinite(cost):
            raise SolverError("Levenberg-Marquardt met a cost that is not finite")
        if progress is not None:
            progress(before + done, cost)
        if previous - cost <= ABSOLUTE_DECREASE + RELATIVE_DECREASE * cost:
            exhausted = optimizer.lambda_() >= LARGEST_LAMBDA
            return cost, done, "no step lowers the cost, however damped" if exhausted else ""
    return cost, most, f"the cost did not come to rest in {most} iterations (max_iterations)"


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
