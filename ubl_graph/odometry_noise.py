"""Noise of odometry records, and the nodes that they join."""

from __future__ import annotations

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.measurements import Odometry
from ubl_graph.options import Options

#: Components of a pose's residuals (along, about, and again for twists) that a plane has.
PLANAR = np.array([0, 1, 5])


#: Planar odometry says of up, roll and pitch, with so many times its noise, that they stay.
OUT_OF_PLANE = 30.0
#: Growing noise is never less than this, m and rad: a vehicle that stands has some, too.
LEAST_WAY, LEAST_TURN = 1e-4, 1e-6


def odometry_covariances(records: Odometry, options: Options) -> FloatArray:
    """Covariance of each change of pose, forward-left-up axes, along then about, m^2 and rad^2.

    Returns
    -------
    array, shape (M, 6, 6) or (M, 3, 3)
        The records' own, one that grows with way and time, or their sum, as the option
        `odometry_noise` says.
    """
    given = records.covariances_flu
    if given is not None and options.odometry_noise == "given":
        return given
    way = np.linalg.norm(records.translation, axis=1)
    dt = records.t_to - records.t_from
    along = options.odometry_way_noise**2 * way + options.odometry_time_noise**2 * dt
    by_way, by_time = (
        np.deg2rad(angle)
        for angle in (options.odometry_way_turn_noise_deg, options.odometry_time_turn_noise_deg)
    )
    about = by_way**2 * way + by_time**2 * dt
    along, about = np.maximum(along, LEAST_WAY**2), np.maximum(about, LEAST_TURN**2)
    planar = records.dimension == 2
    diagonal = [along, along, about] if planar else [along] * 3 + [about] * 3
    growing = np.stack(diagonal, axis=1)[:, :, None] * np.eye(len(diagonal))
    return growing if given is None or options.odometry_noise == "growing" else growing + given


def in_space(covariance: FloatArray) -> FloatArray:
    """Covariances (M, 6, 6) of planar changes of pose (M, 3, 3) for a vehicle in space.

    That it stays in its plane is all but unsaid; without any word its up, roll and pitch would be
    as free from pose to pose as nothing else is.
    """
    out = np.zeros((len(covariance), 6, 6))
    out[:, PLANAR[:, None], PLANAR[None, :]] = covariance
    out[:, 2, 2] = OUT_OF_PLANE**2 * 0.5 * (covariance[:, 0, 0] + covariance[:, 1, 1])
    out[:, 3, 3] = out[:, 4, 4] = OUT_OF_PLANE**2 * covariance[:, 2, 2]
    return out


def spanned(nodes: FloatArray, records: Odometry) -> IntArray:
    """Intervals between nodes (N,) that odometry records span."""
    first, last = node_of(nodes, records.t_from), node_of(nodes, records.t_to)
    spans = np.zeros(len(nodes), dtype=np.int64)
    np.add.at(spans, first, 1)
    np.add.at(spans, last, -1)
    return np.flatnonzero(np.cumsum(spans)[:-1] > 0)


def whitening_of(covariance: FloatArray) -> FloatArray:
    """W with W C W' = 1 for covariances C (M, R, R)."""
    lower = np.linalg.cholesky(covariance)
    return np.asarray(np.linalg.inv(lower), dtype=np.float64)


def node_of(nodes: FloatArray, t: FloatArray) -> IntArray:
    """Number of the node that stands at each time."""
    after = np.searchsorted(nodes, t).clip(1, max(len(nodes) - 1, 1))
    before = after - 1
    return np.where(np.abs(nodes[before] - t) <= np.abs(nodes[after] - t), before, after)
