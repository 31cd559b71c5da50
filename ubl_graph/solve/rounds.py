"""Levenberg-Marquardt's schedule and rounds, the same for every engine, and what came of them.

The schedule is Cao's (2017, Table 1): lambda starts at 1e-3 and changes by a factor of ten. It is
GTSAM's in all else, so that two engines walk the same steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.errors import SolverError
from ubl_graph.factors.loss import RobustLoss
from ubl_graph.problem import Frozen, LeastSquares

INITIAL_LAMBDA, LAMBDA_FACTOR, LARGEST_LAMBDA = 1e-3, 10.0, 1e10
#: A step is taken where it lowers the cost by more than this share of what was predicted.
LEAST_FIDELITY = 1e-3
#: A solve is done when an iteration lowers the cost by less than this share of it,
RELATIVE_DECREASE = 1e-10
#: or by less than this: a step of a hundred-thousandth of a standard deviation. Where a step raises
#: the cost by no more than that share, no other lambda is tried. (GTSAM's own 1e-5 there takes a
#: refused step in a curved valley for the valley's end.)
ABSOLUTE_DECREASE = 1e-10
#: Rounds, at most, in which the interpolation's variance is taken anew at the last estimate.
FREEZE_ROUNDS = 5
#: They end when no standard deviation changes by more than this share.
FREEZE_TOLERANCE = 1e-4

#: Further iterations of poses once the cost is at rest. It is flat within a ten-thousandth of a
#: standard deviation; the last steps shrink quadratically, and bring poses in the plane and in
#: space to the same place.
POLISH = 2

#: Multiples of a loss's width, one after another, that lead from a start which is not far off.
GRADUATION = (30.0, 10.0, 3.0)

#: Called with the iteration's number and cost.
Progress = Callable[[int, float], None]


class Descent(Protocol):
    """A run of Levenberg-Marquardt that is under way."""

    @property
    def cost(self) -> float:
        """Sum of the losses where it is."""
        ...

    @property
    def damping(self) -> float:
        """Lambda of the next step."""
        ...

    def iterate(self) -> None:
        """Take one step, or none where no lambda lowers the cost."""
        ...

    def gain(self) -> float:
        """What the best move of a single unknown would lower the cost by, linearised."""
        ...

    def vector(self) -> FloatArray:
        """The flat vector where it is."""
        ...


class Engine(Protocol):
    """What minimises a problem's cost."""

    @property
    def name(self) -> str:
        """As the option `solver` names it."""
        ...

    @property
    def problem(self) -> LeastSquares:
        """What it minimises."""
        ...

    def begin(self, x: FloatArray, frozen: Frozen) -> Descent:
        """Start a run at `x`."""
        ...

    def with_loss(self, loss: RobustLoss) -> Engine:
        """An engine for the same problem under another loss."""
        ...


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
    engine: Engine, x: FloatArray, max_iterations: int = 100, progress: Progress | None = None
) -> Solution:
    """Minimise a problem's cost from the start `x` by Levenberg-Marquardt.

    Parameters
    ----------
    engine : Engine
        What minimises, and what.
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
        Where the start or the solver's answer is not finite, or the engine gives up.
    """
    if not np.isfinite(x).all():
        raise SolverError("the start of the solver holds values that are not finite")
    frozen = engine.problem.frozen(x)
    used, cost = 0, np.inf
    for _ in range(FREEZE_ROUNDS):
        x, cost, iterations, trouble = _round(engine, x, frozen, max_iterations, used, progress)
        used += iterations
        anew = engine.problem.frozen(x)
        if trouble or _change(frozen, anew) < FREEZE_TOLERANCE:
            return Solution(x, frozen, cost, used, trouble)
        frozen = anew
    trouble = f"the interpolation's variance did not settle in {FREEZE_ROUNDS} rounds"
    return Solution(x, frozen, cost, used, trouble)


def at_rest(before: float, after: float) -> bool:
    """Whether a cost that went from `before` to `after` is where it will stay."""
    return before - after <= ABSOLUTE_DECREASE + RELATIVE_DECREASE * after


def confirms(engine: Engine, solution: Solution) -> bool:
    """Whether an engine, begun at another's solution, sees the same cost and finds nothing better.

    It takes one iteration; what the other engine says of its cost is checked, not believed.

    Parameters
    ----------
    engine : Engine
        Of the same problem.
    solution : Solution
        Of the other engine.

    Raises
    ------
    SolverError
        Where the engine gives up.
    """
    descent = engine.begin(solution.x, solution.frozen)
    cost = descent.cost
    descent.iterate()
    same = at_rest(max(cost, solution.cost), min(cost, solution.cost))
    return same and at_rest(cost, descent.cost) and not _exhausted(descent)


def _round(
    engine: Engine,
    x: FloatArray,
    frozen: Frozen,
    most: int,
    before: int,
    progress: Progress | None,
) -> tuple[FloatArray, float, int, str]:
    """One run of the engine: estimate, cost, iterations, and what went wrong."""
    descent = engine.begin(x, frozen)
    cost, done, trouble = _descend(descent, most, before, progress)
    if not trouble and engine.problem.layout.node != "point":
        for _ in range(POLISH):
            descent.iterate()
        cost, done = descent.cost, done + POLISH
    answer = descent.vector()
    if not np.isfinite(answer).all():
        raise SolverError("Levenberg-Marquardt ended in values that are not finite")
    return answer, cost, done, trouble


def _descend(
    descent: Descent, most: int, before: int, progress: Progress | None
) -> tuple[float, int, str]:
    """Iterate until the cost comes to rest: cost, iterations, and what went wrong."""
    cost = descent.cost
    for done in range(1, most + 1):
        descent.iterate()
        previous, cost = cost, descent.cost
        if not np.isfinite(cost):
            raise SolverError("Levenberg-Marquardt met a cost that is not finite")
        if progress is not None:
            progress(before + done, cost)
        if at_rest(previous, cost):
            trouble = "no step lowers the cost, however damped" if _exhausted(descent) else ""
            return cost, done, trouble
    return cost, most, f"the cost did not come to rest in {most} iterations (max_iterations)"


def best_gain(slope: FloatArray, curvature: FloatArray) -> float:
    """`Descent.gain` from the cost's gradient and the diagonal of its Hessian."""
    return 0.5 * float(np.max(slope**2 / np.maximum(curvature, np.finfo(float).tiny)))


def _exhausted(descent: Descent) -> bool:
    """Whether no lambda helped although there is something to gain.

    At a minimum to rounding no lambda helps either, and nothing is amiss.
    """
    if descent.damping < LARGEST_LAMBDA:
        return False
    return not at_rest(descent.cost, descent.cost - descent.gain())


def _change(before: Frozen, after: Frozen) -> float:
    """Largest relative change of what is held fixed."""
    changes = [
        float(np.max(np.abs(b / a - 1.0), initial=0.0))
        for a, b in zip(before, after, strict=True)
        if a is not None and b is not None
    ]
    return max(changes, default=0.0)
