"""Residuals that are linear in the unknowns: motion, depth, fixes, slow states, priors.

Each function builds one `LinearBlock`, whitened. DVL odometry has its own file.
"""

from __future__ import annotations

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.factors.block import LinearBlock
from ubl_graph.layout import KINEMATIC, Chain, Interpolation, Layout
from ubl_graph.trajectory import transition, whitening


def motion(layout: Layout, chain: Chain, psd: FloatArray) -> LinearBlock:
    """Motion prior between neighbouring nodes: e = X1 - Phi(dt) X0, covariance psd Q(dt).

    Parameters
    ----------
    layout, chain
        Whose nodes.
    psd : array, shape (N - 1, 3)
        Noise density per interval and world axis, m^2/s^3 (WNOA) or m^2/s^5 (WNOJ).

    Returns
    -------
    LinearBlock
        3 * order rows an interval over the two nodes' kinematic states.
    """
    n = layout.order
    k = chain.first + np.arange(len(chain.t) - 1)
    dt = np.diff(chain.t)
    w = whitening(n, dt)
    ends = np.concatenate([-w @ transition(n, dt), w], axis=2)  # (M, n, 2n) of one axis
    matrix = np.zeros((len(dt), n, 3, 2 * n, 3))
    for axis in range(3):
        matrix[:, :, axis, :, axis] = ends / np.sqrt(psd[:, axis])[:, None, None]
    columns = [layout.node_columns(q, k + e) for e in (0, 1) for q in KINEMATIC[:n]]
    matrix = matrix.reshape(len(dt), 3 * n, 6 * n)
    return LinearBlock(
        "motion",
        np.concatenate(columns, axis=1),
        matrix,
        np.zeros((len(dt), 3 * n)),
        log_det=lambda: _log_det(matrix[:, :, 3 * n :]),
    )


def random_walk(layout: Layout, chain: Chain, name: str, walk: float) -> LinearBlock:
    """A slow state wanders: s1 - s0 ~ walk^2 dt, `walk` in its unit per sqrt(s)."""
    k = chain.first + np.arange(len(chain.t) - 1)
    before, after = layout.node_columns(name, k), layout.node_columns(name, k + 1)
    size = before.shape[1]
    inverse = layout.unit(name) / (walk * np.sqrt(np.diff(chain.t)))
    step = np.concatenate([-np.eye(size), np.eye(size)], axis=1)
    return LinearBlock(
        f"{name} walk",
        np.concatenate([before, after], axis=1),
        inverse[:, None, None] * step,
        np.zeros((len(inverse), size)),
        log_det=lambda: size * float(np.log(inverse).sum()),
    )


def clock_walk(layout: Layout, chain: Chain, offset_walk: float, drift_walk: float) -> LinearBlock:
    """Two-state clock: offset' = drift + white noise, drift' = white noise.

    Parameters
    ----------
    layout, chain
        Whose nodes.
    offset_walk : float
        s per sqrt(s).
    drift_walk : float
        s/s per sqrt(s).

    Notes
    -----
    Covariance over dt: [w^2 dt + d^2 dt^3/3, d^2 dt^2/2; d^2 dt^2/2, d^2 dt] (Brown and Hwang,
    Introduction to Random Signals, ch. 9: the GNSS receiver's clock).
    """
    k = chain.first + np.arange(len(chain.t) - 1)
    dt = np.diff(chain.t)
    q = np.empty((len(dt), 2, 2))
    q[:, 0, 0] = offset_walk**2 * dt + drift_walk**2 * dt**3 / 3.0
    q[:, 0, 1] = q[:, 1, 0] = drift_walk**2 * dt**2 / 2.0
    q[:, 1, 1] = drift_walk**2 * dt
    # Offset and drift differ by orders of magnitude: whiten scaled, not with the raw matrix.
    sd = np.sqrt(np.einsum("mii->mi", q))
    unit = np.linalg.inv(np.linalg.cholesky(q / (sd[:, :, None] * sd[:, None, :])))
    w = unit / sd[:, None, :]
    phi = transition(2, dt)
    states = ("clock_offset", "clock_drift")
    columns = [layout.node_columns(name, k + end) for end in (0, 1) for name in states]
    units = np.tile([layout.unit(name) for name in states], 2)
    matrix = np.concatenate([-w @ phi, w], axis=2) * units
    return LinearBlock(
        "clock walk",
        np.concatenate(columns, axis=1),
        matrix,
        np.zeros((len(dt), 2)),
        log_det=lambda: _log_det(matrix[:, :, 2:]),
    )


def depth(
    position: Interpolation, lever_up: FloatArray, measured: FloatArray, sigma: FloatArray
) -> LinearBlock:
    """up(t) + lever - (-depth).

    Parameters
    ----------
    position : Interpolation
        Of the reference point at the depths' times, M rows.
    lever_up : array, shape (M,)
        Sensor above the reference point, m.
    measured : array, shape (M,)
        Depth, m, positive down.
    sigma : array, shape (M,)
        Standard deviation, m, the interpolation's included.
    """
    inverse = 1.0 / sigma
    return LinearBlock(
        "depth",
        position.columns[:, :, 2],
        (position.weights * inverse[:, None])[:, None, :],
        (-(measured + lever_up) * inverse)[:, None],
        log_det=lambda: float(np.log(inverse).sum()),
    )


def position_fix(
    position: Interpolation, lever: FloatArray, measured: FloatArray, covariance: FloatArray
) -> LinearBlock:
    """p(t) + lever - fix, in the fix's 2 or 3 components.

    Parameters
    ----------
    position : Interpolation
        Of the reference point at the fixes' times, M rows.
    lever : array, shape (M, 3)
        Reference point to antenna, world axes, m.
    measured : array, shape (M, d)
        East, north (and up), m.
    covariance : array, shape (M, d, d)
        m^2, the interpolation's included.
    """
    m, d = measured.shape
    w = np.linalg.inv(np.linalg.cholesky(covariance))
    matrix = w[:, :, None, :] * position.weights[:, None, :, None]
    return LinearBlock(
        "position",
        position.columns[:, :, :d].reshape(m, -1),
        matrix.reshape(m, d, -1),
        np.einsum("mrc,mc->mr", w, measured - lever[:, :d]),
        log_det=lambda: -0.5 * _log_det(covariance),
    )


def prior(name: str, columns: IntArray, mean: FloatArray, sigma: FloatArray) -> LinearBlock:
    """Independent priors on `columns` (M, R): mean and standard deviation, (M, R) each.

    An infinite sigma leaves a component free.
    """
    inverse = 1.0 / np.broadcast_to(np.asarray(sigma, dtype=np.float64), columns.shape)
    matrix = inverse[:, :, None] * np.eye(columns.shape[1])
    known = inverse[inverse > 0.0]
    return LinearBlock(
        f"{name} prior",
        columns,
        matrix,
        inverse * mean,
        log_det=lambda: float(np.log(known).sum()),
    )


def _log_det(matrices: FloatArray) -> float:
    """Sum of the logarithms of the determinants of square matrices (M, R, R)."""
    return float(np.linalg.slogdet(matrices)[1].sum())
