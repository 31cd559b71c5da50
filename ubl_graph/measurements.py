"""Frozen measurement records, one class per kind, columnar inside.

A record class holds M measurements of one kind as arrays of length M; single numbers are taken
as M = 1 and broadcast against arrays. All quantities are SI and radians, times are float64
seconds since the mission's epoch. Whatever enters is checked here, at the door: a value that is
not finite, negative where it must not be, or absurd raises a `DataError` that names the
record, or the file, row and field it came from.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Literal, Self

import numpy as np

from ubl_graph.arrays import ArrayLike, BoolArray, FloatArray, IntArray, frozen
from ubl_graph.errors import DataError

#: A two-way ping that took longer than this did not happen (45 km at 1500 m/s), s.
MAX_TRAVEL_TIME = 60.0
#: A travel time may exceed receive minus transmit time by so much (clock granularity), s.
STAMP_TOLERANCE = 0.1
#: Times beyond this are not seconds since an epoch (they may be nanoseconds), s.
MAX_TIME = 1e11

# One standard deviation of each kind where neither a column nor an option gives it.
TRAVEL_TIME_SIGMA = 1e-4  #: s; modems and seafloor transponders reach 0.05 to 0.2 ms
VELOCITY_SIGMA = 0.01  #: m/s; a 600 kHz DVL's single-ping noise
ATTITUDE_SIGMA = float(np.deg2rad(0.2))  #: rad; a fibre-optic gyrocompass
DEPTH_SIGMA = 0.1  #: m; a pressure sensor of 0.01 % of 1 000 m
POSITION_SIGMA = 2.0  #: m; GNSS without corrections


@dataclass(frozen=True)
class Source:
    """Where records came from, so that an error found later can still name the place.

    Attributes
    ----------
    file : str
        File name as the user gave it.
    row : array, shape (M,)
        Data row of each record, counted from 1.
    line : array, shape (M,)
        Line of the file of each record, counted from 1.
    """

    file: str
    row: IntArray
    line: IntArray

    def __getitem__(self, index: Any) -> Source:
        return Source(self.file, self.row[index], self.line[index])

    def error(self, index: int, field: str, problem: str, remedy: str = "") -> DataError:
        """Build the error that names the file, row and line of record `index`."""
        return DataError(
            problem,
            remedy,
            file=self.file,
            row=int(self.row[index]),
            line=int(self.line[index]),
            field=field,
        )


@dataclass(frozen=True, eq=False)
class Records:
    """Base of the record classes: broadcasting, checks, selection."""

    #: Legal range of each numeric column; others need only be finite.
    LIMITS: ClassVar[dict[str, tuple[float, float, str]]] = {}
    #: Columns that hold words.
    TEXT: ClassVar[frozenset[str]] = frozenset({"beacon", "reference"})

    def __post_init__(self) -> None:
        columns = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "source"}
        arrays = {n: np.atleast_1d(np.asarray(v)) for n, v in columns.items() if v is not None}
        lengths = {len(a) for a in arrays.values()} - {1}
        if len(lengths) > 1:
            sizes = ", ".join(f"{n}: {len(a)}" for n, a in arrays.items())
            raise DataError(
                f"{type(self).__name__} columns of different length ({sizes})",
                "give one value per record, or one for all",
            )
        size = lengths.pop() if lengths else 1
        for name, array in arrays.items():
            full = np.broadcast_to(array, (size, *array.shape[1:]))
            object.__setattr__(self, name, self._column(name, full))
        self._check()

    def _column(self, name: str, values: Any) -> Any:
        if name in self.TEXT:
            return frozen(values, np.str_)
        try:
            if values.dtype.kind in "US":
                raise TypeError("numbers written as text")
            column = frozen(values)
        except (TypeError, ValueError) as error:
            raise DataError(
                f"{type(self).__name__} takes numbers here", "give floats", field=name
            ) from error
        if column.ndim != (3 if name == "covariance" else 1):
            raise DataError(
                f"{type(self).__name__} takes one value per record here, not shape {column.shape}",
                field=name,
            )
        broken: Any = ~np.isfinite(column)
        self._forbid(
            broken if column.ndim == 1 else broken.any(axis=(1, 2)),
            name,
            column,
            " is not a finite number",
            "drop or mend it",
        )
        if name == "t" or name.startswith("t_"):
            self._forbid(np.abs(column) > MAX_TIME, name, column, " s is no time in seconds")
        if name in self.LIMITS:
            low, high, unit = self.LIMITS[name]
            self._forbid(
                (column < low) | (column > high),
                name,
                column,
                f" {unit} is outside {low:g} to {high:g} {unit}",
                "check the unit",
            )
        return column

    def _forbid(
        self, bad: BoolArray, name: str, values: Any, problem: str, remedy: str = "check the unit"
    ) -> None:
        if bad.any():
            i = int(np.argmax(bad))
            value = values[i] if np.ndim(values[i]) == 0 else values[i].tolist()
            raise self.error(i, name, f"{value}{problem}", remedy)

    def _check(self) -> None:
        """Check across columns; overridden where a kind has such rules."""

    @property
    def _source(self) -> Source | None:
        return getattr(self, "source", None)

    def error(self, index: int, field: str, problem: str, remedy: str = "") -> DataError:
        """Build the error that names record `index`, by file and row where these are known."""
        return _record_error(type(self), self._source, index, field, problem, remedy)

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def __getitem__(self, index: Any) -> Self:
        """Select by integer, slice, mask or index array; the result is again a record object."""
        if isinstance(index, (int, np.integer)):
            index = np.atleast_1d(np.arange(len(self))[index])
        chosen: dict[str, Any] = {}
        for f in fields(self):
            value = getattr(self, f.name)
            chosen[f.name] = None if value is None else value[index]
        return replace(self, **chosen)

    def duplicates(self, *columns: str) -> int | None:
        """Index of the first record that repeats an earlier one in `columns`, or None."""
        keys = np.rec.fromarrays([getattr(self, c) for c in columns])
        _, first = np.unique(keys, return_index=True)
        if len(first) == len(self):
            return None
        return int(np.setdiff1d(np.arange(len(self)), first)[0])


def _record_error(
    kind: type[Records], source: Source | None, index: int, field: str, problem: str, remedy: str
) -> DataError:
    if source is not None:
        return source.error(index, field, problem, remedy)
    return DataError(problem, remedy, record=f"{kind.__name__}[{index}]", field=field)


@dataclass(frozen=True, eq=False)
class TwoWayRange(Records):
    """Interrogation of a beacon and its reply.

    Parameters
    ----------
    beacon : str or array of str, shape (M,)
        Name of the beacon that answered.
    t_transmit, t_receive : float or array, shape (M,)
        When the vehicle sent the ping and when the reply arrived, s, by the vehicle's clock.
    travel_time : float or array, shape (M,)
        Acoustic travel time out and back, s, with the beacon's turnaround taken out.
    sigma : float or array, shape (M,), default 1e-4
        Standard deviation of `travel_time`, s.
    source : Source, optional
        File and rows the records came from.

    Raises
    ------
    DataError
        Where a value is not finite, a travel time is negative or over 60 s, a reply arrives
        before its ping, or the travel time is longer than the time between the two.
    """

    beacon: Any
    t_transmit: Any
    t_receive: Any
    travel_time: Any
    sigma: Any = TRAVEL_TIME_SIGMA
    source: Source | None = None

    LIMITS: ClassVar = {
        "travel_time": (0.0, MAX_TRAVEL_TIME, "s"),
        "sigma": (1e-9, 1.0, "s"),
    }

    def _check(self) -> None:
        span = self.t_receive - self.t_transmit
        self._forbid(
            span < 0.0,
            "t_receive",
            self.t_receive,
            " s is before the transmit time",
            "check that the columns are not swapped",
        )
        self._forbid(
            self.travel_time > span + STAMP_TOLERANCE,
            "travel_time",
            self.travel_time,
            " s is longer than the time between transmit and receive",
            "both in seconds? the turnaround is part of neither",
        )

    @classmethod
    def from_turnaround(
        cls,
        beacon: ArrayLike,
        t_transmit: ArrayLike,
        t_receive: ArrayLike,
        turnaround: ArrayLike,
        sigma: ArrayLike = TRAVEL_TIME_SIGMA,
        source: Source | None = None,
    ) -> TwoWayRange:
        """Pings stamped by transmit and receive time only; `turnaround` (s) is subtracted."""
        sent, heard, waited = (
            np.asarray(a, dtype=np.float64) for a in (t_transmit, t_receive, turnaround)
        )
        travel = np.atleast_1d(heard - sent - waited)
        early = travel < 0.0
        if early.any():
            i = int(np.argmax(early))
            wait, arrival = (np.broadcast_to(a, travel.shape)[i] for a in (waited, heard))
            raise _record_error(
                cls,
                source,
                i,
                "t_receive",
                f"{arrival} s is before the reply was sent ({wait} s turnaround after the ping)",
                "check the turnaround, and that the columns are not swapped",
            )
        return cls(beacon, t_transmit, t_receive, travel, sigma, source)

    @classmethod
    def from_slant_range(
        cls,
        beacon: ArrayLike,
        t_transmit: ArrayLike,
        t_receive: ArrayLike,
        slant_range: ArrayLike,
        sound_speed: ArrayLike,
        sigma: ArrayLike = TRAVEL_TIME_SIGMA,
        source: Source | None = None,
    ) -> TwoWayRange:
        """Pings reported as slant range (m) at the speed that the modem assumed (m/s)."""
        slant, speed = np.broadcast_arrays(
            np.atleast_1d(np.asarray(slant_range, dtype=np.float64)),
            np.atleast_1d(np.asarray(sound_speed, dtype=np.float64)),
        )
        rules = {
            "slant_range": (
                slant,
                (slant >= 0.0) & np.isfinite(slant),
                "m is no slant range",
                "drop the ping",
            ),
            "sound_speed": (
                speed,
                (speed >= 1300.0) & (speed <= 1700.0),
                "m/s is no speed of sound in water",
                "give the speed that the modem assumed, m/s",
            ),
        }
        for name, (values, sound, problem, remedy) in rules.items():
            if not sound.all():
                i = int(np.argmin(sound))
                raise _record_error(cls, source, i, name, f"{values[i]} {problem}", remedy)
        return cls(beacon, t_transmit, t_receive, 2.0 * slant / speed, sigma, source)


@dataclass(frozen=True, eq=False)
class OneWayRange(Records):
    """A beacon's broadcast as the vehicle hears it.

    Parameters
    ----------
    beacon : str or array of str, shape (M,)
        Name of the beacon.
    t_transmit : float or array, shape (M,)
        When it was sent, s, by the beacon's clock.
    t_receive : float or array, shape (M,)
        When it was heard, s, by the vehicle's clock. The travel time as stamped is
        t_receive - t_transmit; it includes the clock offset (vehicle - beacon).
    sigma : float or array, shape (M,), default 1e-4
        Standard deviation of the stamped travel time, s.
    source : Source, optional
        File and rows the records came from.

    Raises
    ------
    DataError
        Where a value is not finite, or the stamped travel time exceeds 60 s either way.
    """

    beacon: Any
    t_transmit: Any
    t_receive: Any
    sigma: Any = TRAVEL_TIME_SIGMA
    source: Source | None = None

    LIMITS: ClassVar = {"sigma": (1e-9, 1.0, "s")}

    def _check(self) -> None:
        # A negative stamped time is legal here: the clocks may differ by more than the flight.
        self._forbid(
            np.abs(self.travel_time) > MAX_TRAVEL_TIME,
            "t_receive",
            self.t_receive,
            f" s is more than {MAX_TRAVEL_TIME:g} s from the transmit time",
            "clock offsets of up to a minute can be estimated",
        )

    @property
    def travel_time(self) -> FloatArray:
        """Stamped travel time t_receive - t_transmit, s, clock offset included, shape (M,)."""
        return self.t_receive - self.t_transmit


@dataclass(frozen=True, eq=False)
class Velocity(Records):
    """Velocity through the DVL's eyes, in the vehicle's axes.

    Parameters
    ----------
    t : float or array, shape (M,)
        Seconds.
    forward, right, down : float or array, shape (M,)
        m/s.
    sigma : float or array, shape (M,), default 0.01
        Standard deviation of each component, m/s, white from sample to sample.
    reference : "bottom" or "water", or array of these, default "bottom"
        What the velocity is relative to. Water-track needs the current as a state.
    source : Source, optional
        File and rows the records came from.
    """

    t: Any
    forward: Any
    right: Any
    down: Any
    sigma: Any = VELOCITY_SIGMA
    reference: Any = "bottom"
    source: Source | None = None

    LIMITS: ClassVar = {
        "forward": (-50.0, 50.0, "m/s"),
        "right": (-50.0, 50.0, "m/s"),
        "down": (-50.0, 50.0, "m/s"),
        "sigma": (1e-6, 10.0, "m/s"),
    }

    def _check(self) -> None:
        self._forbid(
            ~np.isin(self.reference, ("bottom", "water")),
            "reference",
            self.reference,
            " is neither 'bottom' nor 'water'",
            "say which of the two",
        )


@dataclass(frozen=True, eq=False)
class Attitude(Records):
    """Attitude from a heading reference, mariner's angles.

    Parameters
    ----------
    t : float or array, shape (M,)
        Seconds.
    heading, pitch, roll : float or array, shape (M,)
        Radians; heading clockwise from true north, pitch bow up, roll starboard down.
    sigma : float or array, shape (M,), default 0.0035 (0.2 degrees)
        Standard deviation, radians, of an error that lasts (a heading reference's error does).
    source : Source, optional
        File and rows the records came from.
    """

    t: Any
    heading: Any
    pitch: Any = 0.0
    roll: Any = 0.0
    sigma: Any = ATTITUDE_SIGMA
    source: Source | None = None

    LIMITS: ClassVar = {
        "heading": (-4.0 * np.pi, 4.0 * np.pi, "rad"),
        "pitch": (-np.pi, np.pi, "rad"),
        "roll": (-np.pi, np.pi, "rad"),
        "sigma": (1e-6, np.pi, "rad"),
    }


@dataclass(frozen=True, eq=False)
class Depth(Records):
    """Depth below the origin's level, from pressure.

    Parameters
    ----------
    t : float or array, shape (M,)
        Seconds.
    depth : float or array, shape (M,)
        Metres, positive down; up = -depth.
    sigma : float or array, shape (M,), default 0.1
        Standard deviation, m.
    source : Source, optional
        File and rows the records came from.
    """

    t: Any
    depth: Any
    sigma: Any = DEPTH_SIGMA
    source: Source | None = None

    LIMITS: ClassVar = {
        "depth": (-1000.0, 12000.0, "m"),
        "sigma": (1e-6, 1000.0, "m"),
    }


@dataclass(frozen=True, eq=False)
class PositionFix(Records):
    """A position from elsewhere: GNSS at the surface, a USBL fix, a survey mark.

    Parameters
    ----------
    t : float or array, shape (M,)
        Seconds.
    east, north : float or array, shape (M,)
        Metres.
    up : float or array, shape (M,), optional
        Metres; left out for a horizontal fix.
    sigma : float or array, shape (M,), default 2.0
        Standard deviation of each component, m. Ignored where `covariance` is given.
    covariance : array, shape (2, 2), (3, 3), (M, 2, 2) or (M, 3, 3), optional
        Covariance over east, north (and up), m^2.
    source : Source, optional
        File and rows the records came from.

    Raises
    ------
    DataError
        Where a value is not finite, or a covariance is not symmetric and positive definite or
        not of the size that the components ask for.
    """

    t: Any
    east: Any
    north: Any
    up: Any = None
    sigma: Any = POSITION_SIGMA
    covariance: Any = None
    source: Source | None = None

    LIMITS: ClassVar = {"sigma": (1e-6, 1e6, "m")}

    def __post_init__(self) -> None:
        if self.covariance is not None:
            matrices = np.asarray(self.covariance, dtype=np.float64)
            object.__setattr__(
                self, "covariance", matrices[None] if matrices.ndim == 2 else matrices
            )
        super().__post_init__()

    def _check(self) -> None:
        if self.covariance is None:
            return
        d = 2 if self.up is None else 3
        if self.covariance.shape[1:] != (d, d):
            raise self.error(
                0,
                "covariance",
                f"shape {self.covariance.shape[1:]} for a fix of {d} components",
                f"give {d} x {d}",
            )
        asymmetric = np.abs(self.covariance - np.swapaxes(self.covariance, 1, 2)) > 1e-9 * np.abs(
            self.covariance
        ).max(axis=(1, 2), keepdims=True)
        wrong = asymmetric.any(axis=(1, 2)) | (np.linalg.eigvalsh(self.covariance)[:, 0] <= 0.0)
        if wrong.any():
            raise self.error(
                int(np.argmax(wrong)),
                "covariance",
                "the covariance is not symmetric and positive definite",
                "give variances in m^2 on the diagonal",
            )

    @property
    def dimension(self) -> Literal[2, 3]:
        """2 for horizontal fixes, 3 where `up` is given."""
        return 2 if self.up is None else 3

    @property
    def position(self) -> FloatArray:
        """East, north (and up), m, shape (M, 2) or (M, 3)."""
        parts = [self.east, self.north] + ([] if self.up is None else [self.up])
        return np.stack(parts, axis=1)

    @property
    def covariances(self) -> FloatArray:
        """Covariance of each fix, m^2, shape (M, 2, 2) or (M, 3, 3)."""
        if self.covariance is not None:
            return self.covariance
        return np.eye(self.dimension) * self.sigma[:, None, None] ** 2


@dataclass(frozen=True, eq=False)
class Beacon:
    """An acoustic beacon at a fixed position.

    Parameters
    ----------
    name : str
        The name that range records use.
    position : array, shape (3,)
        East, north, up, m.
    sigma : float or array, shape (3,), default 0
        Standard deviation of the position, m; used only where beacons are estimated, where
        0 means that nothing is known beforehand.
    turnaround : float, optional
        Time from hearing a ping to answering it, s; needed where pings come without a travel
        time.
    """

    name: str
    position: Any
    sigma: Any = 0.0
    turnaround: float | None = None

    def __post_init__(self) -> None:
        position = _numbers(self.position)
        if position is None or position.shape != (3,):
            raise self._error(
                "position",
                f"{self.position} is no east, north, up in metres",
                "give three finite numbers",
            )
        sigma = _numbers(self.sigma)
        if sigma is None or sigma.shape not in ((), (1,), (3,)) or (sigma < 0).any():
            raise self._error(
                "sigma",
                f"{self.sigma} is no standard deviation in metres",
                "give one or three numbers, zero or more",
            )
        wait = _numbers(0.0 if self.turnaround is None else self.turnaround)
        if wait is None or wait.shape != () or not 0.0 <= wait <= MAX_TRAVEL_TIME:
            raise self._error(
                "turnaround", f"a turnaround of {self.turnaround} s", "give seconds, zero or more"
            )
        object.__setattr__(self, "position", frozen(position))
        object.__setattr__(self, "sigma", frozen(np.broadcast_to(sigma, (3,))))

    def _error(self, field: str, problem: str, remedy: str) -> DataError:
        one_line = " ".join(problem.split())
        return DataError(one_line, remedy, record=f"beacon '{self.name}'", field=field)


def _numbers(values: ArrayLike) -> FloatArray | None:
    """Finite numbers as an array, or None where `values` are anything else."""
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return array if np.isfinite(array).all() else None
