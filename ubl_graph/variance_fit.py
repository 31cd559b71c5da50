"""How many times larger than stated noise is, by source, from the errors of held-out predictions.

The mean errors e_i of a block's pings have the covariance S_i = sum over sources of s_k V_ik, with
the V_ik as stated. The s_k are found by maximum likelihood, where the density is Student's t, so
that a block in which something else went wrong counts for little; with normal errors that takes
all s_k for too small by a common factor, which is known and taken back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import minimize, root_scalar
from scipy.stats import chi2

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.held_out import Prediction
from ubl_graph.noise_sources import SOURCES, STATED

#: Degrees of freedom of Student's t.
TAIL = 8.0
#: Sources whose noise is in question, by their place among `SOURCES`; others are priors, fixes and
#: depths, which count as stated.
SOUGHT = (0, 1, 2)
#: How far the logarithm of a source's variance spreads beforehand: a factor of 2, with long tails.
#: It holds a source at what is stated where no prediction depends on it.
SPREAD = np.log(2.0)
#: What predictions can tell at all: a factor of e^7 either way.
FARTHEST = 7.0
LARGEST = float(np.exp(FARTHEST))
#: Logarithm of a variance from which a source that is too loud is sought as well.
LOUD = 3.0
#: A fit ends where a step lowers the cost by less than this share of it.
ENOUGH = 1e-7
#: Lasting errors of the beacons, which nobody stated, are believed where they raise the log
#: likelihood by more than this: a likelihood ratio test at 97.5 %.
WORTH = 1.92
#: Groups of neighbouring predictions that are left out in turn, for the fit's own uncertainty.
GROUPS = 10


@dataclass(frozen=True, eq=False)
class _Errors:
    """Predictions of P components each, in units of one ping's sigma."""

    index: IntArray
    error: FloatArray
    parts: FloatArray


class VarianceFit:
    """Finds the factors.

    Parameters
    ----------
    predictions : sequence of Prediction
        At least one.
    """

    def __init__(self, predictions: Sequence[Prediction]) -> None:
        unit = float(np.median([p.unit for p in predictions]))
        sizes = np.array([len(p.error) for p in predictions])
        self._count = len(predictions)
        # Groups of all kinds of predictions are left out over the same times.
        self._order = np.array(sorted(range(self._count), key=lambda i: _when(predictions[i])))
        # A lasting error is in the unit of its own problem; one unit serves all.
        rescaled = np.ones(len(SOURCES))
        self._parts: list[_Errors] = []
        for size in np.unique(sizes):
            index = np.flatnonzero(sizes == size)
            some = [predictions[int(i)] for i in index]
            parts: list[FloatArray] = []
            for p in some:
                rescaled[STATED] = (unit / p.unit) ** 2
                parts.append(p.parts * rescaled[:, None, None] / unit**2)
            error = np.array([p.error for p in some]) / unit
            self._parts.append(_Errors(index, error, np.array(parts)))
        self._shrunk = _shrinkage(sizes)

    def best(self) -> FloatArray:
        """Factors on the variances, by source, (5,).

        The last is the variance of a lasting error of each beacon's travel times, in units of the
        median ping's.
        """
        return _factors(self._answer)

    @cached_property
    def lasting(self) -> bool:
        """Whether the predictions speak for lasting errors of the beacons."""
        return self._without[1] - self._with[1] > WORTH

    @property
    def _answer(self) -> FloatArray:
        return (self._with if self.lasting else self._without)[0]

    @cached_property
    def _without(self) -> tuple[FloatArray, float]:
        return self._of_all(0.0)

    @cached_property
    def _with(self) -> tuple[FloatArray, float]:
        return self._of_all(LARGEST)

    def _of_all(self, most: float) -> tuple[FloatArray, float]:
        """The least of the minima that are found from as stated, and from each source too loud."""
        every = np.ones(self._count)
        found = [self._minimum(every, start, most) for start in _starts()]
        return min(found, key=lambda pair: pair[1])

    def without_each(self) -> FloatArray:
        """The same with a tenth of the predictions left out in turn, (10, 5)."""
        out: list[FloatArray] = []
        for group in np.array_split(self._order, min(GROUPS, self._count)):
            weight = np.ones(self._count)
            weight[group] = 0.0
            most = LARGEST if self.lasting else 0.0
            out.append(_factors(self._minimum(weight, self._answer, most)[0]))
        return np.array(out)

    def _minimum(
        self, weight: FloatArray, start: FloatArray, most: float
    ) -> tuple[FloatArray, float]:
        """Where the cost is least with a lasting error's variance of at most `most`, and it."""
        bounds = [(-FARTHEST, FARTHEST)] * len(SOUGHT) + [(0.0, most)]
        start = np.minimum(start, [high for _, high in bounds])
        found = minimize(
            self._cost,
            start,
            args=(weight,),
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            options={"ftol": ENOUGH},
        )
        return found.x, float(found.fun)

    def _cost(self, at: FloatArray, weight: FloatArray) -> tuple[float, FloatArray]:
        """Negative logarithm of the posterior density, and its gradient."""
        factors = _factors(at)
        logs = at[: len(SOUGHT)]
        # An exponential density of one ping's variance for what nobody stated.
        cost = float(np.log1p(0.5 * logs**2 / SPREAD**2).sum()) + at[-1]
        slope = np.zeros(len(SOURCES))
        for some in self._parts:
            w, size = weight[some.index], some.error.shape[1]
            covariance = self._shrunk * np.einsum("k,mkij->mij", factors, some.parts)
            inverse = np.linalg.inv(covariance)
            solved = np.einsum("mij,mj->mi", inverse, some.error)
            squared = np.einsum("mi,mi->m", some.error, solved)
            log_det = np.linalg.slogdet(covariance)[1]
            cost += float(w @ (0.5 * log_det + 0.5 * (TAIL + size) * np.log1p(squared / TAIL)))
            share = (TAIL + size) / (TAIL + squared)
            outer = inverse - share[:, None, None] * solved[:, :, None] * solved[:, None, :]
            slope += 0.5 * self._shrunk * np.einsum("m,mij,mkij->k", w, outer, some.parts)
        sought = list(SOUGHT)
        pull = logs / (SPREAD**2 + 0.5 * logs**2)
        gradient = np.append(slope[sought] * factors[sought] + pull, slope[-1] + 1.0)
        return cost, gradient


def _starts() -> list[FloatArray]:
    """As stated, with a lasting error that is small; and the same with one source too loud."""
    plain = np.array([0.0] * len(SOUGHT) + [0.1])
    loud = [plain + LOUD * (np.arange(len(plain)) == k) for k in range(len(SOUGHT))]
    return [plain, *loud]


def _factors(at: FloatArray) -> FloatArray:
    factors = np.ones(len(SOURCES))
    factors[list(SOUGHT)] = np.exp(at[: len(SOUGHT)])
    factors[-1] = at[-1]
    return factors


def _when(prediction: Prediction) -> tuple[str, float]:
    return prediction.segment, prediction.t


def _shrinkage(sizes: IntArray) -> float:
    """Factor by which Student's t takes the variances of normal errors for too small.

    Where the derivative of the expected log density by a common factor vanishes.
    """
    each, counts = np.unique(sizes, return_counts=True)
    points = (np.arange(400) + 0.5) / 400.0
    squared = [chi2.ppf(points, int(size)) for size in each]

    def excess(factor: float) -> float:
        return float(
            sum(
                n * (np.mean((TAIL + p) * q / (TAIL * factor + q)) - p)
                for n, p, q in zip(counts, each, squared, strict=True)
            )
        )

    return root_scalar(excess, bracket=(0.1, 1.5)).root
