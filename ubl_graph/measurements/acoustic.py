"""Ranges: two-way pings, one-way broadcasts, and distances that a device reports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ubl_graph.arrays import ArrayLike, FloatArray
from ubl_graph.records import Records, Source, record_error

#: A two-way ping that took longer than this did not happen (45 km at 1500 m/s), s.
MAX_TRAVEL_TIME = 60.0
#: A travel time may exceed receive minus transmit time by so much (clock granularity), s.
STAMP_TOLERANCE = 0.1
#: No modem and no radio on a vehicle measures a longer range, m.
MAX_RANGE = 1e5

# One standard deviation of each kind where neither a column nor an option gives it.
TRAVEL_TIME_SIGMA = 1e-4  #: s; modems and seafloor transponders reach 0.05 to 0.2 ms
SLANT_RANGE_SIGMA = 1.0  #: m; what devices that report metres round and smooth away


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
class SlantRange(Records):
    """Distance to a beacon at one instant, as a modem or radio reports it in metres.

    No travel time is known: the distance is taken as the length of the straight line between
    transducer and beacon at `t`. A modem that reports slant ranges together with the times of ping
    and reply says more; see `TwoWayRange.from_slant_range`.

    Parameters
    ----------
    t : float or array, shape (M,)
        Seconds.
    beacon : str or array of str, shape (M,)
        Name of the beacon.
    distance : float or array, shape (M,)
        Metres, more than zero.
    sigma : float or array, shape (M,), default 1.0
        Standard deviation of `distance`, m.
    source : Source, optional
        File and rows the records came from.

    Raises
    ------
    DataError
        Where a value is not finite, or a distance is not positive or over 100 km.
    """

    t: Any
    beacon: Any
    distance: Any
    sigma: Any = SLANT_RANGE_SIGMA
    source: Source | None = None

    LIMITS: ClassVar = {
        "distance": (0.0, MAX_RANGE, "m"),
        "sigma": (1e-6, 1e4, "m"),
    }

    def _check(self) -> None:
        self._forbid(
            self.distance == 0.0,
            "distance",
            self.distance,
            " m is no distance to a beacon",
            "drop ranges without a reply",
        )
