"""Multilateration of a target at a known depth: unweighted least squares on horizontal ranges.

As in Zhao's paper the slant ranges d of times of arrival are projected into the plane of the AUVs,
h = sqrt(d^2 - height^2), and Gauss-Newton fits |target - AUV| = h with the AUVs where they are
thought to be.
"""

from __future__ import annotations

import numpy as np

from ubl_graph.arrays import ArrayLike, FloatArray
from ubl_graph.baselines.formation import checked
from ubl_graph.baselines.zhao_ekf import distance
from ubl_graph.errors import ConfigurationError, DataError

#: Depth of the target below the AUVs, m, and iterations.
HEIGHT, ITERATIONS = 10.0, 8
#: Geometries whose normal equations are worse conditioned have no solution.
SINGULAR = 1e-12
#: Ranges that are worked on at once.
CHUNK = 2_000_000


def multilaterate(
    positions: ArrayLike,
    slant: ArrayLike,
    start: ArrayLike,
    *,
    height: float = HEIGHT,
    iterations: int = ITERATIONS,
) -> FloatArray:
    """Locate targets by their slant ranges from N known places.

    Several epochs count jointly where their places and ranges stand in one row of N.

    Parameters
    ----------
    positions : array, shape (..., N, 2)
        East, north of the places, m.
    slant : array, shape (..., N)
        Measured slant ranges, m. One that is less than `height` counts as `height`.
    start : array, shape (..., 2)
        Where Gauss-Newton begins, m.
    height : float
        Of the places above the target, m.
    iterations : int
        Steps of Gauss-Newton.

    Returns
    -------
    array, shape (..., 2)
        East, north of the targets, m; nan where the places lie in one line with the target, or
        Gauss-Newton runs away.

    Raises
    ------
    DataError
        Where shapes do not go together, a number is not finite, or there are less than two places.
    ConfigurationError
        Where the height is negative or not finite, or there is no iteration.

    Examples
    --------
    >>> places = [[0.0, 0.0], [1000.0, 0.0], [0.0, 1000.0]]
    >>> slant = np.hypot(np.hypot(*(np.array(places) - [300.0, 400.0]).T), 10.0)
    >>> multilaterate(places, slant, [0.0, 100.0]).round(6).tolist()
    [300.0, 400.0]
    """
    if not (np.isfinite(height) and height >= 0.0):
        raise ConfigurationError(f"{height} m is no height", "give 0 or more", field="height")
    if type(iterations) is not int or iterations < 1:
        raise ConfigurationError(
            f"{iterations!r} is no number of iterations", "give 1 or more", field="iterations"
        )
    arrays = {
        name: checked(name, values, np.shape(values))
        for name, values in (("positions", positions), ("slant", slant), ("start", start))
    }
    places, ranges, target = arrays["positions"], arrays["slant"], arrays["start"]
    proper = places.ndim >= 2 and places.shape[-1] == 2 and target.shape[-1:] == (2,)
    if not proper or ranges.shape[-1:] != places.shape[-2:-1] or places.shape[-2] < 2:
        raise DataError(
            f"places {places.shape}, ranges {ranges.shape} and starts {target.shape} do not go "
            "together",
            "give (..., N, 2), (..., N) and (..., 2) with N of 2 or more",
            field="slant",
        )
    try:
        lead = np.broadcast_shapes(places.shape[:-2], ranges.shape[:-1], target.shape[:-1])
    except ValueError as error:
        raise DataError(str(error), "make the leading axes agree", field="slant") from None
    flat = np.sqrt(np.maximum(ranges**2 - height**2, 0.0))
    target = np.broadcast_to(target, (*lead, 2)).copy()
    for _ in range(iterations):
        expected, row = distance(target[..., None, :], places)
        target = target - _least_squares(row, expected - flat)
    return target


def target_rmse(
    positions: ArrayLike,
    truth: ArrayLike,
    noise: ArrayLike,
    targets: ArrayLike,
    *,
    height: float = HEIGHT,
    iterations: int = ITERATIONS,
) -> FloatArray:
    """Root mean square over runs of targets' errors, one target at a time: the paper's maps.

    Gauss-Newton starts at the true target.

    Parameters
    ----------
    positions : array, shape (R, N, 2)
        Where the AUVs are thought to be in each run, m.
    truth : array, shape (N, 2)
        Where they are, m.
    noise : array, shape (R, N) or (T, R, N)
        Of the slant ranges, m; the same for all targets, or each target's own.
    targets : array, shape (T, 2)
        East, north, m.
    height, iterations
        As in `multilaterate`.

    Returns
    -------
    array, shape (T,)
        sqrt(mean |error|^2), m; nan where a run has no solution.

    Raises
    ------
    DataError, ConfigurationError
        As `multilaterate` does.
    """
    shape = np.shape(positions)
    if len(shape) != 3 or not shape[0]:
        raise DataError(f"a shape of {shape}", "give one of (runs, N, 2)", field="positions")
    runs, places, _ = shape
    true = checked("truth", truth, (places, 2))
    where = checked("targets", targets, (len(np.atleast_1d(np.asarray(targets))), 2))
    own = np.ndim(noise) == 3
    off = checked("noise", noise, (len(where), runs, places) if own else (runs, places))
    size = max(CHUNK // (runs * places), 1)
    out = np.empty(len(where))
    for first in range(0, len(where), size):
        chunk = where[first : first + size, None, :]
        flat, _ = distance(chunk, true)
        read_off = off[first : first + size] if own else off
        slant = np.hypot(flat, height)[:, None, :] + read_off
        found = multilaterate(positions, slant, chunk, height=height, iterations=iterations)
        missed = ((found - chunk) ** 2).sum(axis=-1)
        out[first : first + size] = np.sqrt(missed.mean(axis=1))
    return out


def _least_squares(row: FloatArray, residual: FloatArray) -> FloatArray:
    """Solution (..., 2) of row (..., N, 2) times it = residual (..., N); nan where singular."""
    east, north = row[..., 0], row[..., 1]
    ee, en, nn = (east**2).sum(-1), (east * north).sum(-1), (north**2).sum(-1)
    determinant = ee * nn - en**2
    regular = determinant > SINGULAR * (ee + nn) ** 2
    determinant = np.where(regular, determinant, np.nan)
    re, rn = (east * residual).sum(-1), (north * residual).sum(-1)
    step = np.stack([nn * re - en * rn, ee * rn - en * re], axis=-1)
    return step / determinant[..., None]
