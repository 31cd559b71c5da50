"""Dilution of precision: by how much a geometry dilutes range errors.

TRDOP and its parts for the papers' windows (Xue 2024, eq. 10 and 11), and the same numbers of any
graph.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ubl_graph.arrays import ArrayLike, FloatArray
from ubl_graph.errors import ConfigurationError, DataError
from ubl_graph.mission import Mission, Segment
from ubl_graph.result import SegmentResult

#: Singular values below this share of the largest, of a matrix whose columns have unit length,
#: count as zero: a range would have to be good to a ten-thousandth of a micrometre to matter.
SINGULAR = 1e-10
#: The quantities that TRDOP adds up, in order of the polynomial's powers.
PARTS = ("position", "velocity", "acceleration")


@dataclass(frozen=True, eq=False)
class Dops:
    """Dilutions of precision: standard deviation of an estimate over that of a range.

    A range is what was measured, as a length: for a two-way ping the whole way out and back. Each
    is a number, or an array where many windows or nodes are asked for at once; inf where the
    geometry leaves the quantity open.

    Attributes
    ----------
    position : array
        PDOP, m/m.
    velocity : array
        VDOP, (m/s)/m; 0 where velocity is no unknown.
    acceleration : array
        ADOP of half the acceleration, (m/s^2)/m, which is the parameter of the papers' windows;
        0 where acceleration is no unknown.
    """

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray

    @property
    def total(self) -> FloatArray:
        """TRDOP: sqrt(PDOP^2 + VDOP^2 + ADOP^2), as numbers, whatever their units (Xue, eq. 11)."""
        return np.sqrt(self.position**2 + self.velocity**2 + self.acceleration**2)


def dops(design: ArrayLike, blocks: Mapping[str, Sequence[int]]) -> Dops:
    """Dilutions of precision of a least-squares problem with equal weights.

    sqrt(trace((A'A)^-1)) over the columns of each block (Xue 2024, eq. 9 to 11, W = I).

    Parameters
    ----------
    design : array, shape (..., M, K)
        Derivatives A of M ranges (m) by K parameters (SI). Leading axes are many windows at once.
    blocks : mapping of str to sequence of int
        Columns of "position", "velocity" and "acceleration" (half of it, see `Dops`). Columns
        that belong to none are unknowns all the same, but are not summed.

    Returns
    -------
    Dops
        Of the leading axes' shape; inf where a column of the block lies in a direction that the
        ranges do not tell.

    Raises
    ------
    DataError
        Where the design is no matrix of finite numbers.
    ConfigurationError
        Where a block's name is unknown, or it has a column that is not there.

    Examples
    --------
    Four ranges along the axes to a point in the middle of a square:

    >>> square = [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]]
    >>> round(float(dops(square, {"position": [0, 1]}).total), 9)
    1.0
    """
    matrix = np.asarray(design, dtype=np.float64)
    if matrix.ndim < 2 or not np.isfinite(matrix).all():
        raise DataError("the design matrix is no matrix of finite numbers", "give (..., M, K)")
    for name, columns in blocks.items():
        if name not in PARTS or not all(0 <= c < matrix.shape[-1] for c in columns):
            raise ConfigurationError(
                f"columns {list(columns)} of '{name}'",
                f"the design has {matrix.shape[-1]} columns, a block is {' or '.join(PARTS)}",
                field="blocks",
            )
    variance = _cofactors(matrix)
    parts = [np.sqrt(variance[..., list(blocks.get(name, ()))].sum(axis=-1)) for name in PARTS]
    return Dops(*parts)


def window_design(
    offset: ArrayLike, elapsed: ArrayLike, order: int, *, vertical: bool = False
) -> tuple[FloatArray, dict[str, list[int]]]:
    """Design matrix of a polynomial window, and which of its columns are what (Xue, eq. 13 to 17).

    The position is sum_i C_i elapsed^i; a row is the derivative of a ping's length, all its legs
    together, along straight lines.

    Parameters
    ----------
    offset : array, shape (..., M, L, 3)
        Vehicle minus beacon at each of the L legs of M pings, east-north-up, m. A two-way ping has
        two, at transmit and receive time.
    elapsed : array, shape (..., M, L)
        Times of the legs since the window's reference time, s.
    order : int
        0: standing still. 1: constant velocity. 2: constant acceleration.
    vertical : bool
        Whether up is unknown too; else the depth is known, as in the paper.

    Returns
    -------
    array, shape (..., M, (order + 1) * axes)
        Columns are C_0 (east, north, ...), C_1, ...; C_2 is half the acceleration.
    dict of str to list of int
        The columns by name, as `dops` takes them.
    """
    _check_order(order)
    offset, elapsed = (np.asarray(a, dtype=np.float64) for a in (offset, elapsed))
    axes = 3 if vertical else 2
    cosines = (offset / np.linalg.norm(offset, axis=-1, keepdims=True))[..., :axes]
    powers = elapsed[..., None] ** np.arange(order + 1)
    design = np.einsum("...lp,...la->...pa", powers, cosines)
    design = design.reshape(*design.shape[:-2], (order + 1) * axes)
    blocks = {
        name: list(range(i * axes, (i + 1) * axes)) for i, name in enumerate(PARTS[: order + 1])
    }
    return design, blocks


def window_dops(
    mission: Mission,
    segment: Segment,
    track: Callable[[FloatArray], FloatArray],
    *,
    pings: int = 8,
    order: int = 1,
    vertical: bool = False,
) -> tuple[FloatArray, Dops]:
    """Dilutions of precision of a segment's windows of pings along a known or planned track.

    They are taken at the polynomial of the window's order that fits the track there.

    Parameters
    ----------
    mission : Mission
        Its beacons.
    segment : Segment
        Its two-way ranges say when was pinged and which beacon answered.
    track : callable
        Positions (M, 3), east-north-up, m, at times (M,): `Truth.position`, for one.
    pings : int
        In a window; there is a window for each ping that has so many up to itself.
    order, vertical
        As for `window_design`. With order 0 the vehicle stands still and a range is half the way
        out and back (space intersection; Xue 2024, section 1).

    Returns
    -------
    array, shape (W,)
        The windows' reference times: midway between first emission and last reception, s.
    Dops
        Of each window.

    Raises
    ------
    DataError
        Where the segment has fewer two-way ranges than a window.
    """
    _check_order(order)
    if pings < 1:
        raise ConfigurationError(f"a window of {pings!r} pings", "give 1 or more", field="pings")
    rows = segment.two_way_range
    if rows is None or len(rows) < pings:
        raise DataError(
            f"segment '{segment.name}' has {0 if rows is None else len(rows)} two-way ranges, "
            f"less than a window of {pings}",
            "take a shorter window",
        )
    rows = rows[np.argsort(rows.t_transmit, kind="stable")]
    times = np.stack([rows.t_transmit, rows.t_receive], axis=1)
    where = np.stack([b.position for b in mission.beacons])[mission.beacon_numbers(rows.beacon)]
    place = track(times.ravel()).reshape(*times.shape, 3)
    index = np.arange(len(rows) - pings + 1)[:, None] + np.arange(pings)
    epoch = 0.5 * (times[index[:, 0], 0] + times[index, 1].max(axis=1))
    elapsed = times[index] - epoch[:, None, None]
    offset = _along(place[index], elapsed, order) - where[index][:, :, None]
    design, blocks = window_design(offset, elapsed, order, vertical=vertical)
    return epoch, dops(design if order else 0.5 * design, blocks)


def _check_order(order: int) -> None:
    if order not in (0, 1, 2):
        raise ConfigurationError(
            f"a polynomial of order {order!r}",
            "give 0, 1 or 2: TRDOP has a position, a velocity and an acceleration",
            field="order",
        )


def _along(place: FloatArray, elapsed: FloatArray, order: int) -> FloatArray:
    """Positions (W, M, L, 3) on the polynomials that fit the track best, window by window."""
    windows = len(place)
    scale = np.abs(elapsed).max(axis=(1, 2), keepdims=True)
    rows = (elapsed / scale)[..., None] ** np.arange(order + 1)
    rows = rows.reshape(windows, -1, order + 1)
    fitted = rows @ (np.linalg.pinv(rows) @ place.reshape(windows, -1, 3))
    return fitted.reshape(place.shape)


def graph_dops(mission: Mission, segment: SegmentResult, *, vertical: bool = False) -> Dops:
    """Dilutions of precision of a graph at its nodes: what its covariance is of its ranges' sigma.

    sqrt(trace(cov)) / (c sigma), with the median standard deviation of the segment's travel times
    and the harmonic mean c of the sound speed between vehicle and beacons. Where the graph is the
    same least-squares problem as a window (no other sensor, no motion noise) it is the window's.

    Parameters
    ----------
    mission : Mission
        What was smoothed.
    segment : SegmentResult
        One of its segments.
    vertical : bool
        Whether up counts too.

    Returns
    -------
    Dops
        At `segment.trajectory.t`.

    Raises
    ------
    DataError
        Where the segment has no ranges, or no joint covariances.
    """
    joint = segment.trajectory.joint
    if segment.residuals is None or joint is None:
        raise DataError(
            f"segment '{segment.name}' has no ranges or no covariances of its velocities",
            "dilution is of ranges, in what `smooth` gives",
        )
    depth = -float(np.median(segment.trajectory.position[:, 2]))
    beacons = -float(np.mean([b.position[2] for b in mission.beacons]))
    speed = float(mission.sound_speed.harmonic_mean(depth, beacons))
    sigma = speed * float(np.median(segment.residuals.sigma))
    variance = np.einsum("nii->ni", joint.node).reshape(len(joint.node), -1, 3) / sigma**2
    sums = variance[:, :, : 3 if vertical else 2].sum(axis=2)
    sums[:, 2:] /= 4.0  # half the acceleration
    sums = np.pad(sums, ((0, 0), (0, 3 - sums.shape[1])))
    return Dops(*np.sqrt(sums.T))


def _cofactors(design: FloatArray) -> FloatArray:
    """Diagonal of (A'A)^-1, inf where it is open: (..., K)."""
    length = np.sqrt((design**2).sum(axis=-2))
    seen = length > 0.0
    scale = np.where(seen, length, 1.0)
    *_, values, rows = np.linalg.svd(design / scale[..., None, :], full_matrices=True)
    missing = rows.shape[-1] - values.shape[-1]
    values = np.concatenate([values, np.zeros((*values.shape[:-1], missing))], axis=-1)
    open_ = values <= SINGULAR * values[..., :1]
    share = np.swapaxes(rows, -1, -2) ** 2  # of each direction in each parameter
    told = share / np.where(open_, np.inf, values)[..., None, :] ** 2
    lost = (share > SINGULAR) & open_[..., None, :]
    return np.where(lost.any(axis=-1) | ~seen, np.inf, told.sum(axis=-1) / scale**2)
