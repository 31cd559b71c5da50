"""A master-slave formation: what its AUVs measure over many runs, and where they seem to be.

R, K, A, E, M are numbers of runs, steps, AUVs, ranging times and masters. Positions are east and
north, m; yaw is counter-clockwise from east, rad.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ubl_graph.arrays import ArrayLike, FloatArray, IntArray, frozen
from ubl_graph.errors import ConfigurationError, DataError

#: A time is a whole number of steps if it misses one by less than this share of a step.
SAME_TIME = 1e-6


@dataclass(frozen=True, eq=False)
class FormationData:
    """What a formation measures in R runs, the same tracks each time.

    Attributes
    ----------
    dt : float
        Length of a step, s.
    period : float
        Between ranging times, s: a whole number of steps. The first is one period after the start.
    masters : tuple of int
        AUVs whose track is known exactly.
    start : array, shape (A, 3)
        East, north, yaw of all AUVs at the beginning; m, rad.
    tracks : array, shape (K + 1, M, 3)
        The masters' states at all steps.
    speed, yaw_rate : array, shape (R, K, A)
        Measured over each step, m/s and rad/s (counter-clockwise); the masters' are not used.
    ranges : array, shape (R, E, A, A)
        Measured between AUVs at the ranging times, m; symmetric, the diagonal is not used.
    speed_sigma, yaw_rate_sigma, range_sigma : float
        Standard deviations of these, m/s, rad/s, m.

    Raises
    ------
    DataError
        Where a shape is wrong, a number not finite, or ranges are not symmetric.
    ConfigurationError
        Where times, masters or standard deviations make no sense.
    """

    dt: float
    period: float
    masters: tuple[int, ...]
    start: Any
    tracks: Any
    speed: Any
    yaw_rate: Any
    ranges: Any
    speed_sigma: float
    yaw_rate_sigma: float
    range_sigma: float

    def __post_init__(self) -> None:
        for name in ("dt", "period", "speed_sigma", "yaw_rate_sigma", "range_sigma"):
            check_number(name, getattr(self, name))
        stride = whole_steps(self.period, self.dt, "period")
        speed = np.shape(self.speed)
        if len(speed) != 3 or not all(speed):
            raise DataError(f"a shape of {speed}", "give one of (runs, steps, AUVs)", field="speed")
        runs, steps, vehicles = speed
        masters = self.masters
        proper = all(type(m) is int and 0 <= m < vehicles for m in masters)
        if not proper or not 0 < len(set(masters)) == len(masters) < vehicles:
            raise ConfigurationError(
                f"{masters} are no masters of {vehicles} AUVs",
                "name at least one by its number, and leave a follower",
                field="masters",
            )
        shapes = {
            "start": (vehicles, 3),
            "tracks": (steps + 1, len(masters), 3),
            "speed": speed,
            "yaw_rate": speed,
            "ranges": (runs, steps // stride, vehicles, vehicles),
        }
        for name, shape in shapes.items():
            object.__setattr__(self, name, checked(name, getattr(self, name), shape))
        if (np.abs(self.ranges - np.swapaxes(self.ranges, 2, 3)) > 0.0).any():
            raise DataError("is not symmetric", "a pair has one range", field="ranges")

    @property
    def runs(self) -> int:
        """Number of runs R."""
        return self.speed.shape[0]

    @property
    def steps(self) -> int:
        """Number of steps K."""
        return self.speed.shape[1]

    @property
    def vehicles(self) -> int:
        """Number of AUVs A."""
        return self.speed.shape[2]

    @cached_property
    def followers(self) -> tuple[int, ...]:
        """AUVs that are no masters."""
        return tuple(a for a in range(self.vehicles) if a not in self.masters)

    @cached_property
    def t(self) -> FloatArray:
        """Times of all states (K + 1,), s, from zero on."""
        return frozen(self.dt * np.arange(self.steps + 1))

    @cached_property
    def ranging_steps(self) -> IntArray:
        """Numbers (E,) of the steps after which AUVs range; `t[ranging_steps]` are the times."""
        stride = whole_steps(self.period, self.dt, "period")
        return frozen(np.arange(stride, self.steps + 1, stride), np.int64)


@dataclass(frozen=True, eq=False)
class FormationEstimate:
    """Where a formation's AUVs are thought to be, all runs and steps; masters are exact.

    Attributes
    ----------
    t : array, shape (K + 1,)
        s.
    state : array, shape (R, K + 1, A, 3)
        East, north, yaw; m, rad. At a ranging time with its range.
    covariance : array, shape (R, K + 1, A, 3, 3)
        Of these; m^2, m rad, rad^2.
    reference : array of int, shape (R, E)
        Which follower was the reference at each ranging time; -1 where there was none.
    partner : array of int, shape (R, E, A)
        Which AUV each follower ranged; -1 where none.
    """

    t: FloatArray
    state: FloatArray
    covariance: FloatArray
    reference: IntArray
    partner: IntArray


def own_rmse(estimate: FormationEstimate, truth: ArrayLike) -> FloatArray:
    """Root mean square over runs of each AUV's distance from its true place, (K + 1, A), m.

    Parameters
    ----------
    estimate : FormationEstimate
        Of R runs.
    truth : array, shape (K + 1, A, 2)
        East, north, m; the same in all runs. A third column, the yaw, may stand there and is not
        used.

    Raises
    ------
    DataError
        Where there are not so many steps and AUVs, or a number is not finite.
    """
    _, steps, vehicles, _ = estimate.state.shape
    columns = 3 if np.shape(truth)[-1:] == (3,) else 2
    true = checked("truth", truth, (steps, vehicles, columns))
    missed = estimate.state[..., :2] - true[..., :2]
    return np.sqrt((missed**2).sum(axis=-1).mean(axis=0))


def check_number(field: str, value: Any, *, may_vanish: bool = False) -> None:
    """Refuse what is no number, or not more than zero (`may_vanish`: less than zero).

    Raises
    ------
    ConfigurationError
        It names the field.
    """
    proper = isinstance(value, (int, float)) and not isinstance(value, bool) and np.isfinite(value)
    if not proper or value < 0.0 or (value == 0.0 and not may_vanish):
        kind = "non-negative" if may_vanish else "positive"
        raise ConfigurationError(f"{value!r} is not a {kind} number", field=field)


def whole_steps(span: float, dt: float, field: str) -> int:
    """How many steps a time takes.

    Raises
    ------
    ConfigurationError
        Where it is no whole number of steps, or none.
    """
    count = round(span / dt)
    if count < 1 or abs(span / dt - count) > SAME_TIME:
        raise ConfigurationError(
            f"{span} s is no whole number of steps of {dt} s", "give a multiple", field=field
        )
    return count


def checked(name: str, values: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """A read-only array of the given shape.

    Raises
    ------
    DataError
        Where it has another one, or holds what is not finite.
    """
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise DataError(
            "is no array of numbers", f"give one of shape {shape}", field=name
        ) from None
    if array.shape != shape:
        raise DataError(f"a shape of {array.shape}", f"give one of {shape}", field=name)
    if not np.isfinite(array).all():
        raise DataError("holds what is not finite", "give numbers alone", field=name)
    return frozen(array)
