"""Marginal covariances of an estimate."""

from __future__ import annotations

import gtsam
import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.gtsam_view import GraphView
from ubl_graph.problem import Problem
from ubl_graph.solve.lm import Solution


class Marginals:
    """Covariances of the unknowns at a solution, by GTSAM.

    Parameters
    ----------
    problem : Problem
        What was solved.
    solution : Solution
        Where it ended.
    """

    def __init__(self, problem: Problem, solution: Solution) -> None:
        self._layout = problem.layout
        view = GraphView(problem)
        self._keys = view.keys
        self._marginals = gtsam.Marginals(view.graph(solution.frozen), view.values(solution.x))

    def of(self, name: str) -> FloatArray:
        """Covariance of a quantity: (N, size, size) per node, (size, size) if shared."""
        unit = self._layout.unit(name) ** 2
        blocks = [
            unit * self._marginals.marginalCovariance(key)
            for key, variable in zip(self._keys, self._layout.variables, strict=True)
            if variable.name == name
        ]
        shared = name in dict(self._layout.shared)
        return blocks[0] if shared else np.stack(blocks)
