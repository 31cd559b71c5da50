"""The inverse of a banded matrix within its band, against numpy's dense one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import cholesky_banded

from ubl_graph.solve.inverse import AT_ONCE, inverse_band, taken


def banded(n: int, reach: int, seed: int) -> np.ndarray:
    """A positive definite matrix whose diagonals from `reach` on vanish; scales that differ."""
    rng = np.random.default_rng(seed)
    # Larger entries beside the diagonal make triangular matrices all but singular.
    root = np.tril(rng.normal(size=(n, n))) * 0.5 / np.sqrt(reach)
    root[np.subtract.outer(np.arange(n), np.arange(n)) >= reach] = 0.0
    root[np.diag_indices(n)] = rng.uniform(0.5, 2.0, n)
    scale = 10.0 ** rng.uniform(-2.0, 2.0, n)
    return (scale[:, None] * root) @ (scale[:, None] * root).T


def factor_of(matrix: np.ndarray, reach: int) -> np.ndarray:
    """Its Cholesky factor in lower band storage; rows beyond the matrix are zero."""
    n = len(matrix)
    stored = np.zeros((reach, n))
    for lag in range(min(reach, n)):
        stored[lag, : n - lag] = matrix.diagonal(-lag)
    out = np.zeros_like(stored)
    high = min(reach, n)
    out[:high] = cholesky_banded(stored[:high], lower=True)
    return out


def assert_inverse(n: int, reach: int, seed: int = 0) -> None:
    matrix = banded(n, reach, seed)
    found = inverse_band(factor_of(matrix, reach))
    assert found.shape == (reach, n)
    inverse = np.linalg.inv(matrix)
    sigma = np.sqrt(inverse.diagonal())
    scale = 1.0 / np.sqrt(matrix.diagonal())
    condition = float(np.linalg.cond(matrix * np.outer(scale, scale)))
    for lag in range(min(reach, n)):
        gap = np.abs(found[lag, : n - lag] - inverse.diagonal(-lag))
        allowed = 1e-14 * condition * (n + 100) * sigma[lag:] * sigma[: n - lag]
        assert (gap <= allowed).all()


@given(n=st.integers(1, 150), reach=st.integers(1, 60), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=80)
def test_it_is_numpys_inverse_within_the_band(n: int, reach: int, seed: int):
    assert_inverse(n, reach, seed)


@pytest.mark.parametrize(
    ("n", "reach"),
    [
        (1, 1),
        (1, 7),
        (5, 1),
        (5, 5),
        (5, 12),
        (AT_ONCE - 1, AT_ONCE + 3),
        (AT_ONCE, 1),
        (AT_ONCE, AT_ONCE),
        (AT_ONCE + 1, 2),
        (AT_ONCE + 1, AT_ONCE + 1),
        (2 * AT_ONCE, 2),
        (2 * AT_ONCE + 5, 2 * AT_ONCE + 20),
        (3 * AT_ONCE, 2 * AT_ONCE + 1),
        (3 * AT_ONCE - 7, AT_ONCE - 1),
    ],
)
def test_borders_of_sizes(n: int, reach: int):
    assert_inverse(n, reach)


def test_what_is_taken_out_of_the_band_is_symmetric_and_unknown_beyond_it():
    matrix = banded(20, 4, 1)
    inverse = np.linalg.inv(matrix)
    band = inverse_band(factor_of(matrix, 4))
    i, j = np.meshgrid(np.arange(20), np.arange(20), indexing="ij")
    found = taken(band, i, j)
    near = np.abs(i - j) < 4
    np.testing.assert_allclose(found[near], inverse[near], rtol=1e-9, atol=1e-12)
    assert np.isnan(found[~near]).all()
    np.testing.assert_array_equal(found[near], found.T[near])
