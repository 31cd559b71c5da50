"""Frozen measurement records, one class per kind, columnar inside.

A record class holds M measurements of one kind as arrays of length M; single numbers are taken
as M = 1 and broadcast against arrays. All quantities are SI and radians, times are float64
seconds since the mission's epoch. Whatever enters is checked here, at the door: a value that is
not finite, negative where it must not be, or absurd raises a `DataError` that names the
record, or the file, row and field it came from.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from ubl_graph.arrays import ArrayLike, FloatArray
from ubl_graph.records import Records, Source, record_error

#: A two-way ping that took longer than this did not happen (45 km at 1500 m/s), s.
MAX_TRAVEL_TIME = 60.0
#: A travel time may exceed receive minus transmit time by so much (clock granularity), s.
STAMP_TOLERANCE = 0.1
#: Positions farther from the origin than this are not local, m.
MAX_DISTANCE = 1e7

# One standard deviation of each kind where neither a column nor an option gives it.
TRAVEL_TIME_SIGMA = 1e-4  #: s; modems and seafloor transponders reach 0.05 to 0.2 ms
VELOCITY_SIGMA = 0.01  #: m/s; a 600 kHz DVL's single-ping noise
ATTITUDE_SIGMA = float(np.deg2rad(0.2))  #: rad; a fibre-optic gyrocompass
DEPTH_SIGMA = 0.1  #: m; a pressure sensor of 0.01 % of 1 000 m
POSITION_SIGMA = 2.0  #: m; GNSS without corrections


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
        self._forbid(
            self.travel_time < 1e-5,
            "travel_time",
            self.travel_time,
            " s: sound goes no way in that time",
            "drop pings without a reply",
        )
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
        self._forbid(
            span > self.travel_time + MAX_TRAVEL_TIME,
            "t_receive",
            self.t_receive,
            f" s is over {MAX_TRAVEL_TIME:g} s later than ping and travel time explain",
            "is it the reply to this ping?",
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
            raise record_error(
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
                raise record_error(cls, source, i, name, f"{values[i]} {problem}", remedy)
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

    LIMITS: ClassVar = {
        "east": (-MAX_DISTANCE, MAX_DISTANCE, "m"),
        "north": (-MAX_DISTANCE, MAX_DISTANCE, "m"),
        "up": (-MAX_DISTANCE, MAX_DISTANCE, "m"),
        "sigma": (1e-6, 1e6, "m"),
    }

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
