"""Levenberg-Marquardt over banded normal equations: the fast path.

The steps are GTSAM's, one by one: damping lambda I, lambda divided by ten after a step that lowers
the cost and multiplied by ten after one that does not. What differs is how a step is found: LAPACK
factorises the band, Schur's complement takes in what all nodes share.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
from scipy.linalg import get_lapack_funcs

from ubl_graph.arrays import FloatArray
from ubl_graph.errors import SolverError
from ubl_graph.factors.loss import RobustLoss
from ubl_graph.problem import Frozen, LeastSquares
from ubl_graph.solve.normal import NormalEquations, dot
from ubl_graph.solve.rounds import (
    INITIAL_LAMBDA,
    LAMBDA_FACTOR,
    LARGEST_LAMBDA,
    LEAST_FIDELITY,
    RELATIVE_DECREASE,
    best_gain,
)

_pbtrf, _pbtrs, _tbtrs, _potrf, _potrs = get_lapack_funcs(
    ("pbtrf", "pbtrs", "tbtrs", "potrf", "potrs"), dtype=np.float64
)

#: An iteration that lowers the cost by less than this ends a descent (a twentieth of a standard
#: deviation): likelihoods are compared to a tenth or so.
AT_REST = 1e-3
#: Iterations of a descent, at most: whoever begins that far off is no good answer.
MOST_ITERATIONS = 40


class BandedFactor:
    """Cholesky factor of a banded matrix with a border.

    Parameters
    ----------
    band : array, shape (reach, inner)
        Lower band storage in Fortran order: band[i - j, j] = A[i, j]. Overwritten.
    coupling : array, shape (inner, border)
        Columns of the border.
    corner : array, shape (border, border)
        Its own block; the lower triangle is read.

    Attributes
    ----------
    band : array, shape (reach, inner)
        L of the band, A = L L', in the memory that `band` came in.
    coupling : array, shape (inner, border)
        L^-1 C.
    corner : array, shape (border, border)
        Lower Cholesky factor of what Schur's complement leaves.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where the matrix is not positive definite.
    """

    def __init__(self, band: FloatArray, coupling: FloatArray, corner: FloatArray) -> None:
        self.band, info = _pbtrf(band, lower=1, overwrite_ab=1)
        if info:
            raise np.linalg.LinAlgError("the band is not positive definite")
        self.coupling, self.corner = coupling, corner
        if len(corner):
            self.coupling = self._half(coupling)
            rest = np.tril(corner) - np.tril(self.coupling.T @ self.coupling)
            self.corner, info = _potrf(rest, lower=1, clean=1)
            if info:
                raise np.linalg.LinAlgError("the border is not positive definite")

    def inverse_corner(self) -> FloatArray:
        """Inverse of what Schur's complement leaves: what is not known of the border."""
        return _potrs(self.corner, np.eye(len(self.corner)), lower=1)[0]

    def solve(self, right: FloatArray) -> FloatArray:
        """Solution of A x = `right`, shape (inner + border,)."""
        if not len(self.corner):
            return _pbtrs(self.band, right, lower=1)[0]
        inner = self.band.shape[1]
        half = self._half(right[:inner])
        shared = _potrs(self.corner, right[inner:] - self.coupling.T @ half, lower=1)[0]
        half -= self.coupling @ shared
        return np.concatenate([self.solve_transposed(half), shared])

    def solve_transposed(self, right: FloatArray) -> FloatArray:
        """Solution of L' x = `right` over the band alone, (inner,) or (inner, m)."""
        return _tbtrs(self.band, right, uplo="L", trans="T")[0]

    def _half(self, right: FloatArray) -> FloatArray:
        """Solution of L x = `right` over the band alone."""
        return _tbtrs(self.band, right, uplo="L")[0]


class BandedEngine:
    """Minimises over banded normal equations.

    Parameters
    ----------
    problem : LeastSquares
        What to minimise.
    """

    name = "banded"

    def __init__(self, problem: LeastSquares) -> None:
        self.problem = problem
        self._equations = NormalEquations(problem)

    def with_loss(self, loss: RobustLoss) -> BandedEngine:
        """An engine for the same problem under another loss, over the same memory."""
        other = copy(self)
        other.problem = replace(self.problem, loss=loss)
        other._equations = self._equations.of(other.problem)
        return other

    def begin(self, x: FloatArray, frozen: Frozen) -> BandedDescent:
        """Start a run at the flat vector `x`."""
        return BandedDescent(self._equations, x, frozen)


class BandedDescent:
    """A run over banded normal equations.

    Parameters
    ----------
    equations : NormalEquations
        Of the problem.
    x : array
        Start, flat vector.
    frozen : tuple
        What is held fixed.
    """

    def __init__(self, equations: NormalEquations, x: FloatArray, frozen: Frozen) -> None:
        self._equations, self._frozen = equations, frozen
        self._point = equations.evaluate(x.copy(), frozen)
        self.damping = INITIAL_LAMBDA

    @property
    def cost(self) -> float:
        """Sum of the losses where it is."""
        return self._point.cost

    def gain(self) -> float:
        """What the best move of a single unknown would lower the cost by, linearised."""
        band, _, corner = self._equations.matrix(self._point)
        curvature = np.concatenate([band[0], corner.diagonal()])
        return best_gain(self._equations.gradient(self._point), curvature)

    def vector(self) -> FloatArray:
        """The flat vector where it is."""
        return self._point.x

    def iterate(self) -> None:
        """Take one step, or none where no lambda lowers the cost."""
        gradient = self._equations.gradient(self._point)
        while not self._try(gradient):
            self.damping *= LAMBDA_FACTOR
            if self.damping >= LARGEST_LAMBDA:
                return

    def _try(self, gradient: FloatArray) -> bool:
        """Try one lambda; whether the iteration is over."""
        step = self._step(gradient)
        if step is None:
            return False
        now = self._point
        predicted = 0.5 * (self.damping * dot(step, step) - dot(gradient, step))
        if not predicted >= 0.0:
            return False
        trial = self._equations.evaluate(now.x + step, self._frozen)
        lowered = now.cost - trial.cost
        told = predicted > np.finfo(float).eps * now.quadratic
        if told and lowered > LEAST_FIDELITY * predicted:
            self._point = trial
            self.damping /= LAMBDA_FACTOR
            return True
        return abs(lowered) < RELATIVE_DECREASE * now.cost

    def _step(self, gradient: FloatArray) -> FloatArray | None:
        """Solution of (J'J + lambda I) step = -J'r, or None where that is singular to rounding."""
        band, coupling, corner = self._equations.matrix(self._point)
        band[0] += self.damping
        corner[np.diag_indices_from(corner)] += self.damping
        try:
            return BandedFactor(band, coupling, corner).solve(-gradient)
        except np.linalg.LinAlgError:
            return None


def descended(equations: NormalEquations, x: FloatArray, frozen: Frozen) -> FloatArray:
    """The minimum near `x`, flat vector, to a small part of a standard deviation.

    Raises
    ------
    SolverError
        Where the cost there is not finite.
    """
    descent = BandedDescent(equations, x, frozen)
    if not np.isfinite(descent.cost):
        raise SolverError("a descent begins at a cost that is not finite")
    for _ in range(MOST_ITERATIONS):
        before = descent.cost
        descent.iterate()
        if before - descent.cost < AT_REST:
            break
    return descent.vector()
