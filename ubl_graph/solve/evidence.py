"""How likely the data are under a problem's noise: Laplace's marginal likelihood.

With the cost C at its minimum, H = J'J there, and W what whitens the rows,

    log p(data) = -C - 1/2 log det H + sum over rows of log det W + constant

The constant depends on the data alone, so that two problems on the same data can be compared:
other motion noise, other nodes, another order of the prior. For linear rows and normal noise it is
exact (MacKay 1992, Bayesian interpolation; for Gaussian processes Rasmussen and Williams 2006,
sect. 5.4). H comes from the banded solver, as the covariances do.

A robust loss is a good guide to the track and a poor density. Where the problem has one, a ping
either has normal noise or is an outlier that may lie anywhere within a tenth of a second, whichever
is likelier at the robust track (Torr and Zisserman 2000, MLESAC).
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from ubl_graph.arrays import BoolArray, FloatArray
from ubl_graph.factors.loss import RobustLoss
from ubl_graph.problem import Frozen, LeastSquares, Problem
from ubl_graph.solve.banded import BandedFactor, descended
from ubl_graph.solve.normal import NormalEquations, Point

#: The interpolation's variance, and which pings are outliers, are taken anew so often.
ROUNDS = 2
#: Outliers are one ping in twenty, to begin with; their share is then what it is found to be.
OUTLIERS = 0.05
#: They lie within so many seconds of the truth on either side.
FARTHEST = 0.1
#: Rounds of telling outliers and their share.
SHARE_ROUNDS = 5
#: By so much an outlier's standard deviation is multiplied: it counts for nothing.
IGNORED = 1e6


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
    found = evidence(problem, x)
    return found.log, found.x


@dataclass(frozen=True, eq=False)
class Evidence:
    """What `log_evidence` gives, and on what terms.

    Attributes
    ----------
    log : float
        Logarithm of the marginal likelihood.
    x : array
        The minimum, flat vector.
    used : tuple
        Standard deviations that outliers have no part in.
    log_outliers : float
        Log likelihood of the outliers.
    """

    log: float
    x: FloatArray
    used: Frozen
    log_outliers: float


def evidence(problem: Problem, x: FloatArray) -> Evidence:
    """As `log_evidence`, with the terms on which it was found.

    Raises
    ------
    SolverError
        Where the start or the cost is not finite.
    """
    equations = NormalEquations(problem)
    frozen = problem.frozen(x)
    for _ in range(ROUNDS):
        x = descended(equations, x, frozen)
        before, frozen = frozen, problem.frozen(x)
        if _same(before, frozen):
            break
    used, log_outliers = frozen, 0.0
    if problem.loss.name != "none":
        equations = _normal(equations)
        for _ in range(ROUNDS):
            used, log_outliers = _without_outliers(equations.problem, x, frozen)
            x = descended(equations, x, used)
    return _told(equations, x, used, log_outliers)


def on_same_terms(problem: Problem, found: Evidence, x: FloatArray) -> Evidence:
    """The evidence with further linear blocks behind those of `found`, with the same outliers.

    Parameters
    ----------
    problem : Problem
        Its blocks begin with those that `found` is of.
    found : Evidence
        Without the further blocks.
    x : array
        Where the descent begins, flat vector.

    Raises
    ------
    SolverError
        Where the cost is not finite.
    """
    equations = _normal(NormalEquations(problem))
    used = (*found.used, *(None for _ in problem.blocks[len(found.used) :]))
    return _told(equations, descended(equations, x, used), used, found.log_outliers)


def _told(equations: NormalEquations, x: FloatArray, used: Frozen, log_outliers: float) -> Evidence:
    point = equations.evaluate(x, used)
    half_log_det = _half_log_det(equations, point)
    log = -np.inf
    if half_log_det is not None:
        log = _log_whitening(equations.problem, used) + log_outliers - point.cost - half_log_det
    return Evidence(float(log), x, used, log_outliers)


def _same(before: Frozen, after: Frozen) -> bool:
    return all(
        a is None or b is None or np.allclose(a, b, 1e-3, 0.0)
        for a, b in zip(after, before, strict=True)
    )


def _normal(equations: NormalEquations) -> NormalEquations:
    """The same equations without the robust loss; what is worked out already is kept."""
    made = copy(equations)
    made.problem = replace(equations.problem, loss=RobustLoss("none"))
    return made


def _without_outliers(problem: LeastSquares, x: FloatArray, frozen: Frozen) -> tuple[Frozen, float]:
    """Standard deviations that outliers have no part in, and the log likelihood of those.

    The latter makes up for what their widened density would count.
    """
    used: list[FloatArray | None] = []
    total = 0.0
    for block, sigma in zip(problem.blocks, frozen, strict=True):
        if sigma is None or not block.robust:
            used.append(sigma)
            continue
        residual = block.evaluate(x, sigma, jacobian=False)[0][:, 0]
        outlier, share = _outliers(residual, sigma)
        used.append(np.where(outlier, IGNORED * sigma, sigma))
        constant = np.log(share * np.sqrt(2.0 * np.pi) / (2.0 * FARTHEST))
        total += float((constant + np.log(IGNORED * sigma[outlier])).sum())
        total += float((~outlier).sum() * np.log1p(-share))
    return tuple(used), total


def _outliers(residual: FloatArray, sigma: FloatArray) -> tuple[BoolArray, float]:
    """Which whitened residuals (M,) are likelier as outliers, and the share of those.

    None found counts as half a one, and they are at most half of all.
    """
    share, outlier = OUTLIERS, np.zeros(len(residual), dtype=np.bool_)
    for _ in range(SHARE_ROUNDS):
        normal = np.log((1.0 - share) / (np.sqrt(2.0 * np.pi) * sigma)) - 0.5 * residual**2
        outlier = normal < np.log(share / (2.0 * FARTHEST))
        share = min(max(float(outlier.sum()), 0.5) / len(residual), 0.5)
    return outlier, share


def _half_log_det(equations: NormalEquations, point: Point) -> float | None:
    """Half the logarithm of H's determinant; None where it is singular to rounding."""
    band, coupling, corner = equations.matrix(point)
    try:
        factor = BandedFactor(band, coupling, corner)
    except np.linalg.LinAlgError:
        return None
    pivots = np.concatenate([factor.band[0], factor.corner.diagonal()])
    return float(np.log(pivots).sum())


def _log_whitening(problem: LeastSquares, frozen: Frozen) -> float:
    """Sum over the rows of log det W."""
    total = 0.0
    for block, held in zip(problem.blocks, frozen, strict=True):
        if held is not None:
            total -= float(np.log(held).sum())
        elif block.log_det is not None:
            total += block.log_det()
    return total
