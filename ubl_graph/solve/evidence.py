"""How likely the data are under a problem's noise: Laplace's marginal likelihood.

With the cost C at its minimum, H = J'J there, and W what whitens the rows,

    log p(data) = -C - 1/2 log det H + sum over rows of log det W + constant

The constant depends on the data alone, so that two problems on the same data can be compared:
other motion noise, other nodes, another order of the prior. For linear rows and normal noise it is
exact (MacKay 1992, Bayesian interpolation; for Gaussian processes Rasmussen and Williams 2006,
sect. 5.4). H comes from the banded solver, as the covariances do.

A robust loss stands for no normal density. Its rows count log sigma by the share that makes the
answer right for normal noise (Huber's proposal 2): without it every sigma would come out too small.
"""

from __future__ import annotations

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.errors import SolverError
from ubl_graph.factors.block import LinearBlock
from ubl_graph.factors.loss import RobustLoss
from ubl_graph.problem import Frozen, Problem
from ubl_graph.solve.banded import BandedDescent, BandedFactor
from ubl_graph.solve.normal import NormalEquations, Point

#: An iteration that lowers the cost by less than this ends the descent: likelihoods are compared
#: to a tenth or so.
AT_REST = 1e-3
#: Iterations of a descent, at most: whoever begins that far off is no good answer.
MOST_ITERATIONS = 40
#: The interpolation's variance is taken anew so often.
ROUNDS = 2
#: Nodes of the Gauss-Hermite rule for the robust rows' share.
QUADRATURE = 64


def log_evidence(problem: Problem, x: FloatArray) -> tuple[float, FloatArray]:
    """Logarithm of the marginal likelihood, but for a constant of the data.

    Parameters
    ----------
    problem : Problem
        With the noise in question.
    x : array
        Where the descent to the minimum begins, flat vector.

    Returns
    -------
    float
        -inf where the normal equations are singular.
    array
        The minimum, flat vector.

    Raises
    ------
    SolverError
        Where the start or the cost is not finite.
    """
    equations = NormalEquations(problem)
    frozen = problem.frozen(x)
    for _ in range(ROUNDS):
        x = _minimum(equations, x, frozen)
        before, frozen = frozen, problem.frozen(x)
        if all(b is None or np.allclose(a, b, 1e-3, 0.0) for a, b in _pairs(frozen, before)):
            break
    point = equations.evaluate(x, frozen)
    half_log_det = _half_log_det(equations, point)
    if half_log_det is None:
        return -np.inf, x
    return _log_whitening(problem, frozen) - point.cost - half_log_det, x


def _pairs(after: Frozen, before: Frozen) -> list[tuple[FloatArray, FloatArray | None]]:
    return [(a, b) for a, b in zip(after, before, strict=True) if a is not None]


def _minimum(equations: NormalEquations, x: FloatArray, frozen: Frozen) -> FloatArray:
    descent = BandedDescent(equations, x, frozen)
    if not np.isfinite(descent.cost):
        raise SolverError("the likelihood's descent begins at a cost that is not finite")
    for _ in range(MOST_ITERATIONS):
        before = descent.cost
        descent.iterate()
        if before - descent.cost < AT_REST:
            break
    return descent.vector()


def _half_log_det(equations: NormalEquations, point: Point) -> float | None:
    """Half the logarithm of H's determinant; None where it is singular to rounding."""
    band, coupling, corner = equations.matrix(point)
    try:
        factor = BandedFactor(band, coupling, corner)
    except np.linalg.LinAlgError:
        return None
    pivots = np.concatenate([factor.band[0], factor.corner.diagonal()])
    return float(np.log(pivots).sum())


def _log_whitening(problem: Problem, frozen: Frozen) -> float:
    """Sum over the rows of log det W, robust rows by their share."""
    total, share = 0.0, robust_share(problem.loss)
    for block, held in zip(problem.blocks, frozen, strict=True):
        if isinstance(block, LinearBlock):
            total += 0.0 if block.log_det is None else block.log_det()
        elif held is not None:
            total -= (share if block.robust else 1.0) * float(np.log(held).sum())
    return total


def robust_share(loss: RobustLoss) -> float:
    """What a row of standard normal noise adds to the derivative of its cost by log sigma.

    E[rho'(r) r], 1 for the quadratic loss: with it, the most likely sigma of normal noise is the
    true one.
    """
    r, weight = np.polynomial.hermite_e.hermegauss(QUADRATURE)
    return float(weight @ (loss.weights(r) * r * r) / weight.sum())
