"""A position from a window of ranges to virtual beacons: Cao 2017's three solvers.

Instead of the vehicle the beacon is moved: the virtual beacon of a ping is the real one shifted by
the way from there to the window's end, so that all ranges of a window meet in one point, the
vehicle at its end. East and north are solved for; the depth is known. (It must be: on a straight
level track every range has the same ratio of its derivatives by north and by depth.)

All solvers take many windows at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ubl_graph.arrays import BoolArray, FloatArray, IntArray, frozen
from ubl_graph.errors import ConfigurationError, DataError, UnobservableError

#: Unknowns of a window: east and north.
UNKNOWNS = 2
#: Normal matrices with a determinant under this share of their squared trace count as singular.
SINGULAR = 1e-14
#: A position farther out than this has run away, m.
ASTRAY = 1e6
#: Virtual beacons closer to one line than this share of their length have no linear solution.
STRAIGHT = 1e-6


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows of n ranges each to virtual beacons.

    Parameters
    ----------
    beacons : array, shape (W, n, 3)
        Virtual beacons, east-north-up, m.
    ranges : array, shape (W, n)
        Slant ranges, m.
    up : array, shape (W,)
        Height of the vehicle at each window's end, m (up = -depth).

    Raises
    ------
    DataError
        If the shapes do not fit, or a number is not finite.
    """

    beacons: FloatArray
    ranges: FloatArray
    up: FloatArray

    def __post_init__(self) -> None:
        for name in ("beacons", "ranges", "up"):
            values = np.asarray(getattr(self, name), dtype=np.float64)
            if not np.isfinite(values).all():
                raise DataError("not all numbers are finite", record="windows", field=name)
            object.__setattr__(self, name, frozen(values))
        w = len(self.up) if self.up.ndim == 1 else -1
        shapes = (self.beacons.shape, self.ranges.shape, self.up.shape)
        if self.ranges.ndim != 2 or shapes != ((*self.ranges.shape, 3), (w, shapes[1][1]), (w,)):
            raise DataError(
                f"beacons, ranges and up have shapes {', '.join(map(str, shapes))}",
                "give (W, n, 3), (W, n) and (W,)",
                record="windows",
            )

    def __len__(self) -> int:
        return len(self.up)

    def __getitem__(self, rows: BoolArray | IntArray | slice) -> Windows:
        """Some of the windows."""
        return Windows(self.beacons[rows], self.ranges[rows], self.up[rows])

    @staticmethod
    def joined(parts: list[Windows]) -> Windows:
        """All windows of several sets of equal window length, in order."""
        names = Windows.__dataclass_fields__
        return Windows(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))


@dataclass(frozen=True, eq=False)
class WindowSolutions:
    """What a solver makes of W windows.

    Attributes
    ----------
    position : array, shape (W, 2)
        East, north, m; nan where there is no solution.
    solved : array of bool, shape (W,)
        Which windows have one.
    iterations : array of int, shape (W,)
        Gauss-Newton steps, or Levenberg-Marquardt trials, rejected ones among them; 0 for the
        linear solution.
    """

    position: FloatArray
    solved: BoolArray
    iterations: IntArray


def gauss_newton(
    windows: Windows, start: FloatArray, *, max_iterations: int = 100, tolerance: float = 1e-4
) -> WindowSolutions:
    """Solve by Gauss-Newton steps, Cao 2017's equation (7).

    Parameters
    ----------
    windows : Windows
        W windows of two or more ranges.
    start : array, shape (W, 2)
        Where to begin, east and north, m.
    max_iterations : int
        Steps after which a window counts as not solved.
    tolerance : float
        Length of the step that ends it, m.

    Returns
    -------
    WindowSolutions
        Not solved are windows with a singular normal matrix (a track through the beacon), with a
        position that runs away, and those that do not converge.

    Raises
    ------
    DataError
        Where a window has fewer ranges than unknowns, or `start` does not fit.
    ConfigurationError
        Where an option is not positive.

    Examples
    --------
    A track that passes a beacon 30 m off; the last of its five points is (20, 30):

    >>> import numpy as np
    >>> way = np.array([-40.0, -30.0, -20.0, -10.0, 0.0])
    >>> beacons = np.stack([-way, 0.0 * way, 0.0 * way], axis=1)[None]
    >>> ranges = np.hypot(20.0 + way, 30.0)[None]
    >>> found = gauss_newton(Windows(beacons, ranges, np.zeros(1)), np.array([[15.0, 20.0]]))
    >>> found.position.round(6).tolist(), found.solved.tolist()
    ([[20.0, 30.0]], [True])
    """
    x = _checked_start(windows, start)
    _check_options(max_iterations, tolerance)
    active = np.ones(len(windows), dtype=np.bool_)
    solved = np.zeros(len(windows), dtype=np.bool_)
    iterations = np.zeros(len(windows), dtype=np.int64)
    for _ in range(max_iterations):
        rows = np.flatnonzero(active)
        if not len(rows):
            break
        normal = _linearised(windows, rows, x[rows])
        singular = normal.determinant() <= SINGULAR * normal.trace() ** 2
        active[rows[singular]] = False
        rows = rows[~singular]
        step = normal[~singular].step()
        x[rows] += step
        iterations[rows] += 1
        done = _length(step) < tolerance
        solved[rows[done]] = True
        lost = ~(np.abs(x[rows]) <= ASTRAY).all(axis=1)
        solved[rows[lost]] = False
        active[rows[done | lost]] = False
    x[~solved] = np.nan
    return WindowSolutions(x, solved, iterations)


def levenberg_marquardt(
    windows: Windows,
    start: FloatArray,
    *,
    max_iterations: int = 3,
    tolerance: float | None = None,
    damping: float = 1e-3,
    factor: float = 10.0,
) -> WindowSolutions:
    """Solve by Cao 2017's Table 1: Levenberg-Marquardt with the identity as damping.

    Parameters
    ----------
    windows : Windows
        W windows of two or more ranges.
    start : array, shape (W, 2)
        Where to begin, east and north, m.
    max_iterations : int
        Trials, rejected ones among them. Three from the true position are what reproduces the
        paper's figures; some hundred converge, to Gauss-Newton's answer wherever it has one.
    tolerance : float, optional
        Length of the step that ends it, m. Left out, all trials are made.
    damping : float
        Multiple of the identity at the first trial.
    factor : float
        What the damping is divided by where a trial lowers the cost, and multiplied by where not.

    Returns
    -------
    WindowSolutions
        Every window is solved, converged or not: that is the method.

    Raises
    ------
    DataError
        Where a window has fewer ranges than unknowns, or `start` does not fit.
    ConfigurationError
        Where an option is not positive, or `factor` is not above 1.

    Notes
    -----
    Step 5(2) of the table returns to step 1, which would reset the damping; it is taken as step 3.
    Step 6 asks for the length of the step where it was accepted only. At the minimum rounding
    rejects every step, so that a rejected one shorter than the tolerance ends it here too.

    Examples
    --------
    On the line through the beacon, where Gauss-Newton has no solution:

    >>> import numpy as np
    >>> way = np.array([-40.0, -30.0, -20.0, -10.0, 0.0])
    >>> beacons = np.stack([-way, 0.0 * way, 0.0 * way], axis=1)[None]
    >>> windows = Windows(beacons, np.abs(70.0 + way)[None], np.zeros(1))
    >>> gauss_newton(windows, np.array([[60.0, 0.0]])).solved.tolist()
    [False]
    >>> levenberg_marquardt(windows, np.array([[60.0, 0.0]])).position.round(3).tolist()
    [[70.0, 0.0]]
    """
    x = _checked_start(windows, start)
    _check_options(max_iterations, tolerance)
    if not (np.isfinite(damping) and damping > 0.0 and np.isfinite(factor) and factor > 1.0):
        raise ConfigurationError(
            f"a damping of {damping} and a factor of {factor}",
            "give a damping above 0 and a factor above 1",
        )
    w = len(windows)
    damped = np.full(w, damping)
    iterations = np.zeros(w, dtype=np.int64)
    rows = np.arange(w)
    normal = _linearised(windows, rows, x)
    for _ in range(max_iterations):
        if not len(rows):
            break
        step = normal[rows].step(damped[rows])
        trial = x[rows] + step
        at_trial = _linearised(windows, rows, trial)
        lower = at_trial.cost < normal.cost[rows]
        better = rows[lower]
        x[better] = trial[lower]
        normal.put(better, at_trial[lower])
        # A damping of 1e300 allows no step at all, and one of 1e-300 is none.
        change = np.where(lower, 1.0 / factor, factor)
        damped[rows] = np.clip(damped[rows] * change, 1e-300, 1e300)
        iterations[rows] += 1
        if tolerance is not None:
            rows = rows[_length(step) >= tolerance]
    return WindowSolutions(x, np.ones(w, dtype=np.bool_), iterations)


def linear_difference(windows: Windows) -> WindowSolutions:
    """Solve the differences of neighbouring squared ranges, Cao 2017's equation (5).

    The squared unknowns cancel: what is left is linear. With the depth known it has two unknowns.

    Parameters
    ----------
    windows : Windows
        W windows of three or more ranges.

    Returns
    -------
    WindowSolutions
        Not solved are windows whose virtual beacons lie on one line.

    Raises
    ------
    DataError
        Where a window has fewer differences than unknowns.
    UnobservableError
        Where no window has a solution: the whole track is straight.

    Examples
    --------
    >>> import numpy as np
    >>> beacons = np.array([[[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [100.0, 100.0, 0.0]]])
    >>> ranges = np.array([[50.0, 80.62257748, 92.19544457]])
    >>> linear_difference(Windows(beacons, ranges, np.zeros(1))).position.round(3).tolist()
    [[30.0, 40.0]]
    """
    _check_pings(windows, UNKNOWNS + 1)
    beacons, up = windows.beacons, windows.up[:, None]
    differences = np.diff(beacons, axis=1)
    slope, rise = differences[:, :, :UNKNOWNS], differences[:, :, 2]
    squared = np.sum(beacons**2, axis=2)
    target = 0.5 * (np.diff(squared, axis=1) - np.diff(windows.ranges**2, axis=1)) - rise * up
    u, s, vt = np.linalg.svd(slope, full_matrices=False)
    solved = s[:, 1] > STRAIGHT * s[:, 0]
    if len(windows) and not solved.any():
        raise UnobservableError(
            "all tracks are straight: differences of squared ranges leave the direction across "
            "open; use Gauss-Newton, or give a track that turns"
        )
    inverse = np.divide(1.0, s, out=np.zeros_like(s), where=solved[:, None])
    along = inverse * np.einsum("wki,wk->wi", u, target)
    position = np.einsum("wij,wi->wj", vt, along)
    position[~solved] = np.nan
    return WindowSolutions(position, solved, np.zeros(len(windows), dtype=np.int64))


def _checked_start(windows: Windows, start: FloatArray) -> FloatArray:
    """A copy of the start positions, once windows and they are fit to be solved."""
    _check_pings(windows, UNKNOWNS)
    x = np.array(start, dtype=np.float64)
    if x.shape != (len(windows), UNKNOWNS) or not np.isfinite(x).all():
        raise DataError(
            f"start positions of shape {x.shape} for {len(windows)} windows",
            f"give finite numbers, ({len(windows)}, {UNKNOWNS}): east and north of each",
        )
    return x


def _check_pings(windows: Windows, least: int) -> None:
    n = windows.ranges.shape[1]
    if n < least:
        raise DataError(
            f"windows of {n} ranges do not determine {UNKNOWNS} unknowns",
            f"give {least} ranges or more",
        )


def _check_options(max_iterations: int, tolerance: float | None) -> None:
    if type(max_iterations) is not int or max_iterations < 1:
        raise ConfigurationError(f"{max_iterations!r} is no number of iterations", "give 1 or more")
    if tolerance is not None and not (np.isfinite(tolerance) and tolerance > 0.0):
        raise ConfigurationError(f"a tolerance of {tolerance} m", "give metres, more than zero")


class _Normal:
    """Normal equations and costs of R windows, one row of numbers each.

    Six columns: squares of the slopes by east, their products, squares by north, right-hand sides
    by east and north, cost. In one array they are picked and put at once.
    """

    def __init__(self, numbers: FloatArray) -> None:
        self._numbers = numbers

    def __getitem__(self, rows: BoolArray | IntArray) -> _Normal:
        return _Normal(self._numbers[:, rows])

    def put(self, rows: IntArray, other: _Normal) -> None:
        """Take over some windows' equations."""
        self._numbers[:, rows] = other._numbers

    @property
    def cost(self) -> FloatArray:
        """Sums of squared residuals (R,), m^2."""
        return self._numbers[5]

    def trace(self) -> FloatArray:
        """Of the normal matrices, (R,)."""
        return self._numbers[0] + self._numbers[2]

    def determinant(self) -> FloatArray:
        """Of the normal matrices, (R,)."""
        a, b, d = self._numbers[:3]
        return a * d - b * b

    def step(self, damping: FloatArray | float = 0.0) -> FloatArray:
        """Steps (R, 2), m, with multiples of the identity added to the normal matrices."""
        a, b, d, u, v, _ = self._numbers
        a, d = a + damping, d + damping
        return np.stack([d * u - b * v, a * v - b * u], axis=1) / (a * d - b * b)[:, None]


def _linearised(windows: Windows, rows: IntArray, x: FloatArray) -> _Normal:
    """Normal equations of some windows at positions (R, 2), m."""
    beacons = windows.beacons[rows]
    east, north = x[:, :1] - beacons[:, :, 0], x[:, 1:] - beacons[:, :, 1]
    height = windows.up[rows, None] - beacons[:, :, 2]
    computed = np.sqrt(east**2 + north**2 + height**2)
    # On a beacon a range has no direction: 0 / 1e-300 makes it zero.
    inverse = 1.0 / np.maximum(computed, 1e-300)
    east, north = east * inverse, north * inverse
    residual = windows.ranges[rows] - computed
    pairs = (
        (east, east),
        (east, north),
        (north, north),
        (east, residual),
        (north, residual),
        (residual, residual),
    )
    return _Normal(np.array([np.einsum("rn,rn->r", p, q) for p, q in pairs]))


def _length(step: FloatArray) -> FloatArray:
    return np.hypot(step[:, 0], step[:, 1])
