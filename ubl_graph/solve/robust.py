"""Graduated non-convexity: a robust problem approached from where outliers make no minima.

A robust cost has a minimum wherever some pings agree, and Levenberg-Marquardt finds the one it
starts near. Graduated non-convexity begins with a loss so wide that the cost is close to convex and
narrows it, each step starting where the last one ended. Yang et al. leave the residuals' own
standard deviation as it is (Geman-McClure: c^2 becomes mu c^2). Here most unknowns are tied to each
other by motion alone: with the ranges as sharp as ever the widest loss bends the track through all
outliers, and it does not come back. So the ranges' standard deviations are widened too, which makes
the track stiff against them first, and soft at the end.

Source: Yang, Antonante, Tzoumas and Carlone 2020, Graduated non-convexity for robust spatial
perception. docs/decisions/016-graduated-non-convexity.md compares the schedules.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.errors import SolverError
from ubl_graph.problem import Frozen, LeastSquares
from ubl_graph.solve.rounds import GRADUATION, Engine, Solution, at_rest

#: Widths that the loss may begin with, and narrows through, in multiples of its own.
WIDTHS = (1e5, 3e4, 1e4, 3e3, 1e3, 300.0, 100.0, *GRADUATION)
#: Iterations for each width, at the most: the next one begins somewhere near in any case,
STEP_ITERATIONS = 10
#: and one that lowers the cost by less than this share ends it.
STEP_DECREASE = 1e-4
#: Stiffnesses that are tried, one solve each. Where odometry ties the nodes they lead to the same
#: answer; where the motion prior alone does, 1.5 most often leads to the better one, 1 to some
#: that 1.5 misses.
STIFFNESSES = (1.5, 1.0)
#: A ping that counts for less than this is far out: of normal noise one in a thousand is, or fewer.
FAR_OUT = 0.25
#: Where more pings than this share are, the answer is in doubt.
DOUBTFUL_SHARE = 0.01


def graduated(engine: Engine, x: FloatArray, stiffness: float = STIFFNESSES[0]) -> FloatArray:
    """Approach a robust problem from its convex side: a start for `solve`.

    At width w the loss bends at w times its own width, and the robust rows' standard deviations
    are w^stiffness times their own: they pull on the track with a weight of w^(-2 stiffness).
    Stiffness 0 would be the schedule of Yang et al., 1 that of annealing, where ranges and loss
    are widened alike.

    Parameters
    ----------
    engine : Engine
        What minimises, and what.
    x : array
        Start, flat vector. The widths begin with what its residuals ask for.
    stiffness : float
        Exponent of the standard deviations.

    Returns
    -------
    array
        Flat vector after the last width but one; `solve` does the last.

    Raises
    ------
    SolverError
        As `solve` does.
    """
    loss = engine.problem.loss
    for width in widths(engine.problem, x):
        sigmas = width**stiffness
        # In units of the widened standard deviations.
        narrowing = engine.with_loss(loss.widened(width / sigmas))
        held = engine.problem.frozen(x)
        wide = tuple(None if sigma is None else sigmas * sigma for sigma in held)
        x = _approach(narrowing, x, wide)
    return x


def widths(problem: LeastSquares, x: FloatArray) -> tuple[float, ...]:
    """Widths that a loss narrows through from `x`, in multiples of its own.

    The first holds all residuals, so that no ping is an outlier yet, or is the widest there is.
    """
    residuals = robust_residuals(problem, x, problem.frozen(x))
    reach = float(np.max(np.abs(residuals), initial=0.0)) / problem.loss.width
    count = max(sum(w < reach for w in WIDTHS) + 1, len(GRADUATION))
    return WIDTHS[-count:]


def robust_residuals(problem: LeastSquares, x: FloatArray, frozen: Frozen) -> FloatArray:
    """Whitened residuals of all rows that the loss applies to, (M,)."""
    rows = [
        block.evaluate(x, held, jacobian=False)[0][:, 0]
        for block, held in zip(problem.blocks, frozen, strict=True)
        if block.robust
    ]
    return np.concatenate(rows) if rows else np.empty(0)


def doubtful(problem: LeastSquares, solution: Solution) -> bool:
    """Whether more pings are far out than normal noise would have there.

    They are outliers then, or true pings that the solution takes for outliers.
    """
    residuals = robust_residuals(problem, solution.x, solution.frozen)
    far = problem.loss.weights(residuals) < FAR_OUT
    return bool(len(far)) and float(far.mean()) > DOUBTFUL_SHARE


def robustly(
    solve: Callable[[FloatArray], Solution], engine: Engine, x: FloatArray
) -> list[Solution]:
    """Solve from a start, and where the answer is in doubt by graduated non-convexity, too.

    Parameters
    ----------
    solve : callable
        Minimises the problem itself from a flat vector.
    engine : Engine
        That `solve` uses.
    x : array
        Start, flat vector.

    Returns
    -------
    list of Solution
        By the cost of the loss that was asked for, least first.

    Raises
    ------
    SolverError
        Where the solve from the start itself fails.
    """
    solutions = [solve(x)]
    if doubtful(engine.problem, solutions[0]):
        for stiffness in STIFFNESSES:
            # A way that fails is no answer, and spoils no other.
            with suppress(SolverError):
                solutions.append(solve(graduated(engine, x, stiffness)))
    return sorted(solutions, key=lambda s: s.cost)


def _approach(engine: Engine, x: FloatArray, frozen: Frozen) -> FloatArray:
    """Some iterations towards the minimum."""
    descent = engine.begin(x, frozen)
    for _ in range(STEP_ITERATIONS):
        before = descent.cost
        descent.iterate()
        after = descent.cost
        if at_rest(before, after) or before - after < STEP_DECREASE * after:
            break
    answer = descent.vector()
    if not np.isfinite(answer).all():
        raise SolverError("graduated non-convexity met values that are not finite")
    return answer
