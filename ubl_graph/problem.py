"""A least-squares problem: layout, blocks and loss, evaluated as a whole.

Solvers see nothing else of a mission. The GTSAM graph (`ubl_graph.gtsam_view`) and any solver
of our own are views on the same blocks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.factors.block import Block
from ubl_graph.factors.loss import RobustLoss
from ubl_graph.layout import Columns, Layout

#: What each block holds fixed while a solve runs, in the blocks' order.
Frozen = tuple[FloatArray | None, ...]


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """What solvers see of a problem: columns, blocks and loss.

    Attributes
    ----------
    layout : Columns
        The unknowns.
    blocks : tuple of Block
        The residuals.
    loss : RobustLoss
        Applies to the blocks that are `robust`.
    """

    layout: Columns
    blocks: tuple[Block, ...]
    loss: RobustLoss

    def frozen(self, x: FloatArray) -> Frozen:
        """What the blocks hold fixed during a solve that starts at `x`."""
        return tuple(block.frozen(x) for block in self.blocks)

    def cost(self, x: FloatArray, frozen: Frozen) -> float:
        """Sum of rho(r) over robust blocks and r^2/2 over the others (GTSAM's `error`)."""
        total = 0.0
        for block, held in zip(self.blocks, frozen, strict=True):
            r, _ = block.evaluate(x, held, jacobian=False)
            total += float(self.loss.cost(r).sum() if block.robust else 0.5 * np.vdot(r, r))
        return total

    def linearize(self, x: FloatArray, frozen: Frozen) -> tuple[FloatArray, sparse.csr_array]:
        """Weighted residuals (sum of M R,) and sparse Jacobian at `x`: one Gauss-Newton system."""
        residuals: list[FloatArray] = []
        data: list[FloatArray] = []
        rows: list[IntArray] = []
        columns: list[IntArray] = []
        first = 0
        for block, held in zip(self.blocks, frozen, strict=True):
            r, jacobian = block.evaluate(x, held)
            assert jacobian is not None
            if block.robust:
                root = np.sqrt(self.loss.weights(r))
                r, jacobian = root * r, root[:, :, None] * jacobian
            m, n_rows, width = jacobian.shape
            column = np.broadcast_to(block.columns[:, None, :], jacobian.shape)
            row = first + np.arange(m * n_rows).reshape(m, n_rows, 1)
            used = column >= 0
            residuals.append(r.ravel())
            data.append(jacobian[used])
            columns.append(column[used])
            rows.append(np.broadcast_to(row, (m, n_rows, width))[used])
            first += m * n_rows
        matrix = sparse.csr_array(
            (np.concatenate(data), (np.concatenate(rows), np.concatenate(columns))),
            shape=(first, self.layout.size),
        )
        return np.concatenate(residuals), matrix


@dataclass(frozen=True, eq=False)
class Problem(LeastSquares):
    """The problem of one vehicle.

    Attributes
    ----------
    layout : Layout
        The unknowns.
    psd : tuple of float
        Horizontal and vertical noise density of the motion prior, m^2/s^3 or m^2/s^5.
    """

    layout: Layout
    psd: tuple[float, float]
