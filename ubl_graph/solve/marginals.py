"""Marginal covariances of an estimate, by block recursion on the banded normal equations.

GTSAM's own `Marginals` takes a system for indeterminate as soon as two diagonal entries of a
clique's factor differ by more than 2^12, which a clock known to a second that wanders by 1e-7 s
does; it is also slower. Here the columns are scaled to unit diagonal first, so that only what is
singular indeed fails. The tests hold both together where GTSAM can.

With A the nodes' banded part of the normal matrix, A = L L', the blocks of A^-1 within the band
follow backwards from the last node (Takahashi et al. 1973; Barfoot, State Estimation for
Robotics, ch. 3.2). What nodes share is a border: Schur's complement adds its part.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.linalg import cho_solve_banded, cholesky_banded

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.errors import SolverError
from ubl_graph.problem import Problem
from ubl_graph.solve.lm import Solution

#: Shares of the diagonal added where the normal equations are singular to rounding.
RIDGES = (0.0, 1e-14, 1e-13, 1e-12, 1e-11)


class Marginals:
    """Covariances of the unknowns at a solution.

    Parameters
    ----------
    problem : Problem
        What was solved.
    solution : Solution
        Where it ended.

    Raises
    ------
    SolverError
        Where the normal equations are singular or not finite.
    """

    def __init__(self, problem: Problem, solution: Solution) -> None:
        self._layout = layout = problem.layout
        _, jacobian = problem.linearize(solution.x, solution.frozen)
        normal = sparse.csr_array(jacobian.T @ jacobian)
        diagonal = normal.diagonal()
        if not np.isfinite(diagonal).all() or (diagonal <= 0.0).any():
            raise SolverError("the covariances cannot be computed: an unknown enters no residual")
        self._scale: FloatArray = 1.0 / np.sqrt(diagonal)
        scaling = sparse.dia_array((self._scale[None], [0]), shape=normal.shape)
        normal = sparse.coo_array(scaling @ normal @ scaling)
        inner = layout.node_count * layout.node_width
        self._nodes, self._shared = _selected_inverse(normal, inner, layout.node_width)

    def of(self, name: str) -> FloatArray:
        """Covariance of a quantity, SI: (N, size, size) per node, (size, size) if shared."""
        layout = self._layout
        if name in dict(layout.shared):
            columns = layout.shared_columns(name)
            local = columns - layout.node_count * layout.node_width
            block = self._shared[np.ix_(local, local)]
        else:
            columns = layout.node_columns(name, np.arange(layout.node_count))
            local = columns[0]
            block = self._nodes[:, local[:, None], local[None, :]]
        scale = self._scale[columns] * layout.unit(name)
        return scale[..., :, None] * block * scale[..., None, :]


def _selected_inverse(
    normal: sparse.coo_array, inner: int, width: int
) -> tuple[FloatArray, FloatArray]:
    """Diagonal blocks of the inverse of a banded matrix with a border.

    Parameters
    ----------
    normal : sparse array, shape (n, n)
        Symmetric; its first `inner` columns are banded, the others are the border.
    inner, width : int
        Columns of all nodes; columns of one node.

    Returns
    -------
    array, shape (inner / width, width, width), and array, shape (n - inner, n - inner)
    """
    row, column = (np.asarray(i, dtype=np.int64) for i in normal.coords)
    data = np.asarray(normal.data, dtype=np.float64)
    border = int(column.max()) + 1 - inner
    banded = _banded(row, column, data, inner)
    factor = _factor(banded)
    blocks = _takahashi(factor, width)
    if border == 0:
        return blocks, np.empty((0, 0))
    coupling = np.zeros((inner, border))
    edge = (row < inner) & (column >= inner)
    coupling[row[edge], column[edge] - inner] = data[edge]
    corner = np.zeros((border, border))
    corners = (row >= inner) & (column >= inner)
    corner[row[corners] - inner, column[corners] - inner] = data[corners]
    solved = cho_solve_banded((factor, True), coupling)
    shared = np.linalg.inv(corner - coupling.T @ solved)
    per_node = solved.reshape(-1, width, border)
    return blocks + per_node @ shared @ np.swapaxes(per_node, 1, 2), shared


def _factor(banded: FloatArray) -> FloatArray:
    """Banded Cholesky factor of a matrix of unit diagonal.

    What only a prior of 1e5 m holds beside a sensor of centimetres is at the edge of what double
    precision resolves. A ridge of rounding's size then lets the factorisation pass; it cuts
    standard deviations that only say "not observed" anyway.
    """
    for ridge in RIDGES:
        matrix = banded.copy()
        matrix[0] += ridge
        try:
            return cholesky_banded(matrix, lower=True, overwrite_ab=True, check_finite=False)
        except np.linalg.LinAlgError:
            continue
    raise SolverError("the covariances cannot be computed: the normal equations are singular")


def _banded(row: IntArray, column: IntArray, data: FloatArray, inner: int) -> FloatArray:
    """Lower band storage of the first `inner` columns: band[i - j, j] = A[i, j]."""
    keep = (row >= column) & (row < inner)
    row, column, data = row[keep], column[keep], data[keep]
    band = np.zeros((int((row - column).max(initial=0)) + 1, inner))
    band[row - column, column] = data
    return band


def _takahashi(factor: FloatArray, width: int) -> FloatArray:
    """Diagonal blocks of (L L')^-1 from L in lower band storage, `width` columns a block.

    For block column k of L, [L_kk; F_k] with F_k the rows below, and S the inverse's block over
    those rows (already known):  X = -S F_k L_kk^-1,  inverse_kk = L_kk^-T L_kk^-1 - X' ... X.
    """
    reach, n = factor.shape
    nodes = n // width
    span = -(-(reach - 1) // width)  # blocks below the diagonal that a column may reach
    size = span * width
    out = np.empty((nodes, width, width))
    known = np.zeros((size, size))  # the inverse over the `span` blocks below the current one
    eye = np.eye(width)
    lag = np.arange(width + size)[:, None] - np.arange(width)[None, :]
    inside = (lag >= 0) & (lag < reach)
    lag = np.where(inside, lag, 0)
    padded = np.concatenate([factor, np.zeros((reach, width))], axis=1)
    for k in range(nodes - 1, -1, -1):
        first = k * width
        block = np.where(inside, padded[lag, first + np.arange(width)], 0.0)
        inverse = np.linalg.solve(block[:width], eye)
        below = block[width:] @ inverse
        cross = -known @ below
        here = inverse.T @ inverse - below.T @ cross
        out[k] = 0.5 * (here + here.T)
        if size:
            grown = np.empty((width + size, width + size))
            grown[:width, :width] = out[k]
            grown[width:, :width] = cross
            grown[:width, width:] = cross.T
            grown[width:, width:] = known
            known = grown[:size, :size]
    return out
