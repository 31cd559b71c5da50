"""What a block of residuals is: rows of one kind, evaluated in one vectorised pass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray

ALL_ROWS = slice(None)


class Block(Protocol):
    """One kind of residual, M rows of R whitened components over C columns each."""

    @property
    def name(self) -> str:
        """What the block is, for reports."""
        ...

    @property
    def columns(self) -> IntArray:
        """Columns of the flat vector that each row touches, shape (M, C); -1 pads."""
        ...

    @property
    def linear(self) -> bool:
        """Whether the Jacobian is constant and no loss applies."""
        ...

    @property
    def robust(self) -> bool:
        """Whether the problem's robust loss applies (then R = 1)."""
        ...

    @property
    def log_det(self) -> Callable[[], float] | None:
        """Gives the sum over the rows of the logarithm of what whitens them (its determinant).

        None where that is constant, or `frozen` says it.
        """
        ...

    def frozen(self, x: FloatArray) -> FloatArray | None:
        """What is held fixed while a solve runs, taken at `x` (a standard deviation per row)."""
        ...

    def evaluate(
        self,
        x: FloatArray,
        frozen: FloatArray | None = None,
        rows: slice = ALL_ROWS,
        jacobian: bool = True,
    ) -> tuple[FloatArray, FloatArray | None]:
        """Whitened residuals (m, R) of `rows` at the flat vector `x`, and Jacobians (m, R, C)."""
        ...


class CurvedBlock:
    """What nonlinear blocks without a loss have in common: nothing is held while a solve runs."""

    linear = False
    robust = False

    def frozen(self, x: FloatArray) -> FloatArray | None:  # noqa: ARG002 - the protocol's form
        """Nothing is held."""
        return None


@dataclass(frozen=True, eq=False)
class LinearBlock:
    """Whitened residuals A x - b.

    Attributes
    ----------
    name : str
        What the block is.
    columns : array of int, shape (M, C)
        Columns that each row touches, -1 pads.
    matrix : array, shape (M, R, C)
        Whitened Jacobian; zero at padded columns.
    target : array, shape (M, R)
        Whitened right-hand side b.
    log_det : callable, optional
        Gives the sum over the rows of the logarithm of what whitened them (of its determinant): the
        densities' own factor, which a likelihood wants and no step does. Left out, it is constant.
    """

    name: str
    columns: IntArray
    matrix: FloatArray
    target: FloatArray
    linear: bool = True
    robust: bool = False
    log_det: Callable[[], float] | None = None

    def frozen(self, x: FloatArray) -> FloatArray | None:  # noqa: ARG002 - the protocol's form
        """Nothing changes with the state."""
        return None

    def evaluate(
        self,
        x: FloatArray,
        frozen: FloatArray | None = None,  # noqa: ARG002 - the protocol's form
        rows: slice = ALL_ROWS,
        jacobian: bool = True,
    ) -> tuple[FloatArray, FloatArray | None]:
        """Whitened residuals (m, R) and Jacobians (m, R, C)."""
        matrix = self.matrix[rows]
        residual = np.einsum("mrc,mc->mr", matrix, x[self.columns[rows]]) - self.target[rows]
        return residual, (matrix if jacobian else None)
