"""Levenberg-Marquardt by GTSAM over a LeastSquares's factor graph."""

from __future__ import annotations

from dataclasses import replace

import gtsam
from scipy import sparse

from ubl_graph.arrays import FloatArray
from ubl_graph.errors import SolverError
from ubl_graph.factors.loss import RobustLoss
from ubl_graph.gtsam_view import GraphView
from ubl_graph.problem import Frozen, LeastSquares
from ubl_graph.solve.rounds import (
    INITIAL_LAMBDA,
    LAMBDA_FACTOR,
    LARGEST_LAMBDA,
    RELATIVE_DECREASE,
    best_gain,
)


class GtsamEngine:
    """Minimises by `gtsam.LevenbergMarquardtOptimizer`.

    Parameters
    ----------
    problem : LeastSquares
        What to minimise.
    """

    name = "gtsam"

    def __init__(self, problem: LeastSquares) -> None:
        self.problem = problem
        self._view = GraphView(problem)

    def with_loss(self, loss: RobustLoss) -> GtsamEngine:
        """An engine for the same problem under another loss."""
        return GtsamEngine(replace(self.problem, loss=loss))

    def begin(self, x: FloatArray, frozen: Frozen) -> GtsamDescent:
        """Start a run at the flat vector `x`.

        Raises
        ------
        SolverError
            Where GTSAM refuses the graph.
        """
        return GtsamDescent(self._view, x, frozen)


class GtsamDescent:
    """A run of GTSAM's optimiser.

    Parameters
    ----------
    view : GraphView
        Of the problem.
    x : array
        Start, flat vector.
    frozen : tuple
        What is held fixed.

    Raises
    ------
    SolverError
        Where GTSAM gives up.
    """

    def __init__(self, view: GraphView, x: FloatArray, frozen: Frozen) -> None:
        self._view = view
        self._graph = view.graph(frozen, batched=True)
        try:
            self._optimizer = gtsam.LevenbergMarquardtOptimizer(
                self._graph, view.values(x), parameters_of(view)
            )
        except RuntimeError as error:
            raise _gave_up(error) from error

    @property
    def cost(self) -> float:
        """Sum of the losses where it is."""
        return self._optimizer.error()

    @property
    def damping(self) -> float:
        """Lambda of the next step."""
        return self._optimizer.lambda_()

    def iterate(self) -> None:
        """Take one step, or none where no lambda lowers the cost."""
        try:
            self._optimizer.iterate()
        except RuntimeError as error:
            raise _gave_up(error) from error

    def gain(self) -> float:
        """What the best move of a single unknown would lower the cost by, linearised."""
        linear = self._graph.linearize(self._optimizer.values())
        row, column, value = linear.sparseJacobian_()
        # Counted from one; the last column is the right-hand side.
        system = sparse.csc_array((value, (row.astype(int) - 1, column.astype(int) - 1)))
        jacobian, right = system[:, :-1], system[:, [-1]].toarray()[:, 0]
        curvature = jacobian.power(2).sum(axis=0).ravel()
        return best_gain(jacobian.T @ right, curvature)

    def vector(self) -> FloatArray:
        """The flat vector where it is."""
        return self._view.vector(self._optimizer.values())


def _gave_up(error: RuntimeError) -> SolverError:
    return SolverError(f"GTSAM gave up: {' '.join(str(error).split())[:200]}")


def parameters_of(view: GraphView) -> gtsam.LevenbergMarquardtParams:
    """What the optimiser is run with: the common schedule, elimination along the chain."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setlambdaInitial(INITIAL_LAMBDA)
    parameters.setlambdaFactor(LAMBDA_FACTOR)
    parameters.setlambdaUpperBound(LARGEST_LAMBDA)
    parameters.setRelativeErrorTol(RELATIVE_DECREASE)
    parameters.setOrdering(view.ordering())
    parameters.setLinearSolverType("SEQUENTIAL_CHOLESKY")
    return parameters
