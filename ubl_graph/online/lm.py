"""The engine `lm`: a window re-solved by Newton's method with Levenberg-Marquardt's guard.

A window is solved anew at every ping, from where it was: one undamped step most often suffices. Its
matrix weighs range rows by the loss' curvature, which converges fast where re-weighted least
squares crawl; where such a step does not lower the cost the classical ones take over, more and more
damped.
"""

from __future__ import annotations

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.errors import SolverError
from ubl_graph.online.equations import Point, WindowEquations
from ubl_graph.solve.banded import BandedFactor

#: Half the squared length, in standard deviations, of a step that is not worth taking.
LEAST_DECREMENT = 1e-13
#: Costs that differ by less than this share of them are equal to rounding.
SAME_COST = 1e-12
#: A factor is used again while each of its steps gains less than this share of the last one's.
WORTHWHILE = 0.01
#: Dampings tried, as shares of the diagonal, where the undamped steps fail.
DAMPINGS = (1e-4, 1e-2, 1.0, 1e2, 1e4, 1e6)


def minimise(
    equations: WindowEquations, x: FloatArray, most: int, start: Point | None = None
) -> Point:
    """Where the cost is least, searched from `x`.

    Parameters
    ----------
    equations : WindowEquations
        Of the window.
    x : array
        Start.
    most : int
        Steps at the most. Where they do not suffice the last point is good enough: the next solve
        goes on from there.
    start : Point, optional
        The equations evaluated at `x`, where that has been done.

    Returns
    -------
    Point

    Raises
    ------
    SolverError
        Where cost or equations are not finite, or singular however damped.
    """
    # A trial step may go far astray; what overflows there is refused by its cost.
    with np.errstate(over="ignore", invalid="ignore"):
        return _descended(equations, equations.evaluate(x) if start is None else start, most)


def _descended(equations: WindowEquations, point: Point, most: int) -> Point:
    for _ in range(most):
        if not np.isfinite(point.cost):
            raise SolverError("the window's cost is not finite")
        moved = _step(equations, point)
        if moved is None:
            return point
        point, factor, gain = moved
        # The same factor serves while it converges fast; a step costs a tenth of a new one.
        while factor is not None:
            gradient = equations.gradient(point)
            step = factor.solve(-gradient)
            decrement = -0.5 * float(np.einsum("i,i->", gradient, step))
            if decrement < LEAST_DECREMENT:
                return point
            if decrement > WORTHWHILE * gain:
                break
            trial = equations.evaluate(point.x + step)
            if trial.cost > point.cost + SAME_COST * point.cost:
                break
            point, gain = trial, decrement
    return point


def _step(
    equations: WindowEquations, point: Point
) -> tuple[Point, BandedFactor | None, float] | None:
    """The next point, the factor that led there if undamped, its gain foreseen; None at rest."""
    gradient = equations.gradient(point)
    tried = False
    for newton, damping in ((True, 0.0), (False, 0.0), *((False, d) for d in DAMPINGS)):
        try:
            factor = equations.factor(point, newton, damping)
        except np.linalg.LinAlgError:
            continue
        step = factor.solve(-gradient)
        if not np.isfinite(step).all():
            continue
        tried = True
        decrement = -0.5 * float(np.einsum("i,i->", gradient, step))
        if decrement < LEAST_DECREMENT:
            return None
        trial = equations.evaluate(point.x + step)
        if trial.cost < point.cost or decrement < SAME_COST * point.cost:
            return trial, factor if newton else None, decrement
    if not tried:
        raise SolverError("the window's equations are singular, however damped")
    return None
