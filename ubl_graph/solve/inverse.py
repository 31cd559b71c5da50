"""The inverse of a banded matrix, as far as its own band reaches."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_triangular

from ubl_graph.arrays import FloatArray, IntArray

#: Columns taken at a time: enough for BLAS to be worth calling.
AT_ONCE = 48


def inverse_band(factor: FloatArray) -> FloatArray:
    """The band of (L L')^-1, by block recursion from the last column to the first.

    With J some columns and R those in reach behind them, x_J = G x_R + e with G = -(F L_JJ^-1)'
    of the rows F of L below L_JJ, and e of covariance (L_JJ L_JJ')^-1 (Takahashi et al. 1973), so

        S_JR = G S_RR,  S_JJ = G S_RR G' + (L_JJ L_JJ')^-1.

    Parameters
    ----------
    factor : array, shape (reach, n)
        L in lower band storage: factor[i - j, j] = L[i, j].

    Returns
    -------
    array, shape (reach, n)
        The inverse in the same storage.
    """
    reach, n = factor.shape
    out = np.zeros_like(factor)
    beyond = np.zeros((0, 0))
    for last in range(n, 0, -AT_ONCE):
        first = max(0, last - AT_ONCE)
        width, rows = last - first, min(n - first, last - first + reach - 1)
        block = np.zeros((rows, width))
        for column in range(width):
            high = min(reach, rows - column)
            block[column : column + high, column] = factor[:high, first + column]
        inverse = solve_triangular(block[:width], np.eye(width), lower=True)
        gain = -(block[width:] @ inverse).T
        cross = gain @ beyond[: rows - width, : rows - width]
        own = cross @ gain.T + inverse.T @ inverse
        whole = np.empty((rows, rows))
        whole[:width, :width] = own
        whole[:width, width:], whole[width:, :width] = cross, cross.T
        whole[width:, width:] = beyond[: rows - width, : rows - width]
        for column in range(width):
            high = min(reach, rows - column)
            out[:high, first + column] = whole[column, column : column + high]
        keep = min(rows, reach - 1)
        beyond = whole[:keep, :keep]
    return out


def taken(band: FloatArray, rows: IntArray, columns: IntArray) -> FloatArray:
    """Entries of a symmetric matrix out of its band; those beyond its reach are not known: NaN.

    Parameters
    ----------
    band : array, shape (reach, n)
        In lower band storage.
    rows, columns : array of int
        Of the entries, of shapes that go together.
    """
    low, high = np.minimum(rows, columns), np.maximum(rows, columns)
    apart = high - low
    known = apart < len(band)
    return np.where(known, band[np.where(known, apart, 0), low], np.nan)
