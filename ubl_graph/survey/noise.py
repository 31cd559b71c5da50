"""The noise under which a survey's data are likeliest: of its ranges, and of the water.

At the solution a survey is linear to well under a millimetre, so the likelihood is that of the
linearised problem, whose rows need no ray any more: a search takes a second where solving anew for
each trial would take minutes. No reference is looked at, and no covariance.

Gradients are left out of the search. A track that errs for minutes and a gradient that comes and
goes look alike, and the likelihood blames gradients for all that is neither white nor common.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from ubl_graph.arrays import BoolArray, FloatArray
from ubl_graph.factors.block import ALL_ROWS, Block
from ubl_graph.factors.loss import RobustLoss
from ubl_graph.factors.ranges import RangeBlock
from ubl_graph.problem import Problem
from ubl_graph.solve.banded import BandedFactor
from ubl_graph.solve.normal import NormalEquations, dot
from ubl_graph.solve.rounds import Solution
from ubl_graph.survey.model import Noise, SurveyModel

#: What is known beforehand, in decades about the stated value: ranges' sigmas are right within a
#: factor of three, the walk within ten (as `ubl_graph.noise_search` has it).
SPREADS = np.array([0.5, 1.0])
#: Each number is searched within so many decades either way, and found to this share of one.
FARTHEST, TOLERANCE = 3.0, 0.1
#: Trials, at most.
MOST_TRIALS = 40
#: Robust standard deviations beyond which a range is an outlier and says nothing of the noise.
OUTLIER = 4.0
#: Ranges that each number wants.
RANGES_A_NUMBER = 20
#: Blocks that no noise changes.
KNOWN = ("beacon prior", "range bias prior")
#: The standard deviation of normal noise by the median of its absolute values.
MEDIAN_TO_SIGMA = 1.4826


class LinearRanges:
    """The ranges of a block, linearised, with sigmas that can be scaled.

    Parameters
    ----------
    block : RangeBlock
        Whose rows.
    x : array
        Where, flat vector.
    used : array of bool, shape (M,)
        Rows that count.
    """

    linear = False
    robust = False
    log_det = None
    name = "linearised ranges"

    def __init__(self, block: RangeBlock, x: FloatArray, used: BoolArray) -> None:
        unit = np.ones(len(block))
        residual, jacobian = block.evaluate(x, unit)
        assert jacobian is not None
        self._x, self._residual, self._jacobian = x, residual[used], jacobian[used]
        self.columns = block.columns[used]
        # Padded columns have zero weight, wherever they point.
        self._stated, total = block.sigma[used] ** 2, block.frozen(x)[used] ** 2
        self._further = total - self._stated
        self.factor = 1.0

    def frozen(self, x: FloatArray) -> FloatArray:  # noqa: ARG002 - the protocol's form
        """Standard deviation of each row under the factor, s."""
        return np.sqrt(self.factor**2 * self._stated + self._further)

    def evaluate(
        self,
        x: FloatArray,
        frozen: FloatArray | None = None,
        rows: slice = ALL_ROWS,
        jacobian: bool = True,
    ) -> tuple[FloatArray, FloatArray | None]:
        """Whitened residuals (m, 1) and Jacobians (m, 1, C)."""
        assert frozen is not None
        inverse = 1.0 / frozen[rows, None]
        moved = (x - self._x)[self.columns[rows]]
        step = np.einsum("mrc,mc->mr", self._jacobian[rows], moved)
        residual = (self._residual[rows] + step) * inverse
        return residual, (self._jacobian[rows] * inverse[:, :, None] if jacobian else None)


def likeliest_noise(model: SurveyModel, problem: Problem, solution: Solution) -> tuple[Noise, str]:
    """Search the likeliest noise at a solution.

    Parameters
    ----------
    model : SurveyModel
        Builds the walks.
    problem : Problem
        Solved under `model.noise`.
    solution : Solution
        Of it.

    Returns
    -------
    Noise
        As stated where there are too few ranges for two numbers.
    str
        Why it is the stated one; empty where it was searched.
    """
    stated, x = model.noise, solution.x
    ranges = [b for b in problem.blocks if isinstance(b, RangeBlock)]
    whitened = [
        b.evaluate(x, held, jacobian=False)[0][:, 0]
        for b, held in zip(problem.blocks, solution.frozen, strict=True)
        if isinstance(b, RangeBlock)
    ]
    scale = robust_scale(np.concatenate(whitened))
    used = [np.abs(r) <= OUTLIER * scale for r in whitened]
    count, wanted = sum(int(u.sum()) for u in used), RANGES_A_NUMBER * len(SPREADS)
    if count < wanted + model.layout.size - model.layout.inner:
        return (
            stated,
            f"too few ranges ({count} without outliers) to find the noise; the stated one stands",
        )
    rows = [LinearRanges(b, x, u) for b, u in zip(ranges, used, strict=True)]
    known = [b for b in problem.blocks if b.name in KNOWN]
    likelihood = _Likelihood(model, problem, rows, known, x)

    def noise_at(u: FloatArray) -> Noise:
        factor, walk = 10.0 ** np.clip(u, -FARTHEST, FARTHEST)
        return Noise(float(factor), float(walk * stated.walk))

    def cost(u: FloatArray) -> float:
        return -likelihood.of(noise_at(u)) + 0.5 * float(np.sum((u / SPREADS) ** 2))

    corners = np.array([[0.0, 0.0], [-0.3, 0.0], [0.0, -0.3]])
    found = minimize(
        cost,
        np.zeros(2),
        method="Nelder-Mead",
        options={
            "initial_simplex": corners,
            "xatol": TOLERANCE,
            "fatol": TOLERANCE,
            "maxfev": MOST_TRIALS,
        },
    )
    return noise_at(found.x), ""


class _Likelihood:
    """The marginal likelihood of a survey that is linear, under any noise.

    It is that of `ubl_graph.solve.evidence`; for linear rows a single step leads to the minimum.
    Which columns a row touches is the same whatever the noise, and worked out once.
    """

    def __init__(
        self,
        model: SurveyModel,
        problem: Problem,
        rows: list[LinearRanges],
        known: list[Block],
        x: FloatArray,
    ) -> None:
        self._model, self._rows, self._known, self._x = model, rows, known, x
        self._problem = problem
        self._equations = NormalEquations(self._posed(model.noise))

    def _posed(self, noise: Noise) -> Problem:
        for block in self._rows:
            block.factor = noise.range_factor
        # They change from trial to trial, so they must not count as rows that never do.
        slow = [replace(block, linear=False) for block in self._model.slow_blocks(noise)]
        return replace(
            self._problem, blocks=(*self._known, *self._rows, *slow), loss=RobustLoss("none")
        )

    def of(self, noise: Noise) -> float:
        """Its logarithm, but for a constant of the data; -inf where the equations are singular."""
        problem, equations = self._posed(noise), self._equations
        equations.problem = problem
        frozen = problem.frozen(self._x)
        point = equations.evaluate(self._x, frozen)
        gradient = equations.gradient(point)
        try:
            factor = BandedFactor(*equations.matrix(point))
        except np.linalg.LinAlgError:
            return -np.inf
        least = point.cost - 0.5 * dot(gradient, factor.solve(gradient))
        pivots = np.concatenate([factor.band[0], factor.corner.diagonal()])
        widths = sum(float(np.log(held).sum()) for held in frozen if held is not None)
        walks = sum(b.log_det() for b in problem.blocks if b.log_det is not None)
        return walks - widths - least - float(np.log(pivots).sum())


def robust_scale(whitened: FloatArray) -> float:
    """Standard deviation of residuals (M,) that outliers have no part in."""
    return float(MEDIAN_TO_SIGMA * np.median(np.abs(whitened))) if len(whitened) else 1.0
