"""Simulated sensors: records of what a vehicle on a true track would measure.

Every function takes the track, the times and a seeded generator; `noise` multiplies the standard
deviation that the records state, so that 0 gives exact measurements with unchanged weights.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from ubl_graph.acoustics import SoundSpeedProfile, eigenray, straight
from ubl_graph.arrays import ArrayLike, FloatArray
from ubl_graph.beacon import Beacon
from ubl_graph.errors import SolverError
from ubl_graph.frames import LeverArm, body_vector
from ubl_graph.measurements import (
    ATTITUDE_SIGMA,
    DEPTH_SIGMA,
    POSITION_SIGMA,
    SLANT_RANGE_SIGMA,
    TRAVEL_TIME_SIGMA,
    VELOCITY_SIGMA,
    Attitude,
    Depth,
    OneWayRange,
    PositionFix,
    SlantRange,
    TwoWayRange,
    Velocity,
)
from ubl_graph.sim.tracks import Truth

#: A quantity that may change with time: a constant, or a function of times (M,).
Slow: TypeAlias = float | Callable[[FloatArray], FloatArray]

#: A reply's arrival is iterated until it moves by less than this, s; each iteration gains a
#: factor of the speed of sound over the vehicle's.
ARRIVAL_TOLERANCE = 1e-12
_MOST_ITERATIONS = 30


@dataclass(frozen=True, eq=False)
class Sea:
    """What sound travels through.

    Attributes
    ----------
    profile : SoundSpeedProfile
        Speed over depth.
    rays : {"straight", "eigenray"}
        How travel times are computed.
    log_scale : float or callable
        Travel times are multiplied by its exponential: an error of the profile.
    """

    profile: SoundSpeedProfile
    rays: Literal["straight", "eigenray"] = "straight"
    log_scale: Slow = 0.0

    def travel_time(self, antenna: FloatArray, beacon: FloatArray, t: FloatArray) -> FloatArray:
        """One-way times (M,), s, between points (M, 3) each, m, the antenna being there at t.

        Raises
        ------
        NoDirectRayError
            Where no direct ray joins two points.
        """
        travel = eigenray if self.rays == "eigenray" else straight
        return travel(self.profile, antenna, beacon).time * np.exp(_at(self.log_scale, t))


@dataclass(frozen=True)
class DvlErrors:
    """What a DVL gets wrong: v_true = (1 + scale) v + misalignment x v + bias (body axes).

    Attributes
    ----------
    scale : float
        Relative.
    misalignment : tuple of float
        About the forward, left and up axes, rad.
    bias : tuple of float
        Forward, left, up, m/s.
    """

    scale: float = 0.0
    misalignment: tuple[float, float, float] = (0.0, 0.0, 0.0)
    bias: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def measured(self, true: FloatArray) -> FloatArray:
        """What the DVL says of true velocities (M, 3), forward-left-up, m/s."""
        x, y, z = self.misalignment
        turn = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        matrix = (1.0 + self.scale) * np.eye(3) + turn
        return (true - np.array(self.bias)) @ np.linalg.inv(matrix).T


@dataclass(frozen=True)
class Clock:
    """Offset of the vehicle's clock against the beacons', vehicle minus beacon.

    Attributes
    ----------
    offset : float
        At the vehicle's time zero, s.
    drift : float
        s/s.
    """

    offset: float = 0.0
    drift: float = 0.0

    def at(self, t: FloatArray) -> FloatArray:
        """Offset at the vehicle's times (M,), s."""
        return self.offset + self.drift * t


def two_way_pings(
    truth: Truth,
    beacons: Sequence[Beacon],
    transmit: ArrayLike,
    sea: Sea,
    rng: np.random.Generator,
    *,
    arm: LeverArm | None = None,
    sigma: float = TRAVEL_TIME_SIGMA,
    noise: float = 1.0,
    outliers: float = 0.0,
    outlier_delay: tuple[float, float] = (2e-3, 2e-2),
) -> TwoWayRange:
    """Interrogate the beacons in turn and stamp their replies.

    Parameters
    ----------
    truth : Truth
        The vehicle.
    beacons : sequence of Beacon
        Asked in turn; each waits its turnaround.
    transmit : array, shape (M,)
        When the vehicle pings, s.
    sea : Sea
        Travel times.
    rng : numpy.random.Generator
        For noise and outliers.
    arm : LeverArm, optional
        Of the transducer.
    sigma : float
        Standard deviation that the records state, s.
    noise : float
        Multiplies it.
    outliers : float
        Share of replies that come by a detour.
    outlier_delay : tuple of float
        Their delay is uniform between these, s: 2 to 20 ms are 1.5 to 15 m.
    """
    t = np.atleast_1d(np.asarray(transmit, dtype=np.float64))
    arm = LeverArm() if arm is None else arm
    asked = [beacons[i % len(beacons)] for i in range(len(t))]
    place = np.array([b.position for b in asked]).reshape(-1, 3)
    wait = np.array([b.turnaround or 0.0 for b in asked])
    out = sea.travel_time(truth.sensor_position(arm, t), place, t)
    back = _arrival(truth, arm, place, t + out + wait, sea)
    measured = out + back + noise * sigma * rng.standard_normal(len(t))
    late = rng.random(len(t)) < outliers
    measured = measured + late * rng.uniform(*outlier_delay, len(t))
    names = np.array([b.name for b in asked])
    return TwoWayRange(names, t, t + measured + wait, measured, sigma)


def one_way_pings(
    truth: Truth,
    beacons: Sequence[Beacon],
    transmit: ArrayLike,
    sea: Sea,
    rng: np.random.Generator,
    *,
    clock: Clock | None = None,
    arm: LeverArm | None = None,
    sigma: float = TRAVEL_TIME_SIGMA,
    noise: float = 1.0,
) -> OneWayRange:
    """Hear the beacons' broadcasts.

    Parameters
    ----------
    truth : Truth
        The vehicle; its times are those of the vehicle's clock.
    beacons : sequence of Beacon
        Broadcast in turn.
    transmit : array, shape (M,)
        When they do, s by the beacons' clock (which agree with one another).
    sea, rng, arm, sigma, noise
        As for `two_way_pings`.
    clock : Clock, optional
        The vehicle's against the beacons'.

    Notes
    -----
    A flight lasts tau by the beacons' clock. By the vehicle's it would be tau (1 + drift): with
    10 ppm that is a sound speed off by 10 ppm, which no one knows.
    """
    stamped = np.atleast_1d(np.asarray(transmit, dtype=np.float64))
    arm = LeverArm() if arm is None else arm
    clock = Clock() if clock is None else clock
    heard = [beacons[i % len(beacons)] for i in range(len(stamped))]
    place = np.array([b.position for b in heard]).reshape(-1, 3)
    flight = _arrival(truth, arm, place, stamped, sea, clock)
    received = (stamped + flight + clock.offset) / (1.0 - clock.drift)
    received = received + noise * sigma * rng.standard_normal(len(stamped))
    return OneWayRange(np.array([b.name for b in heard]), stamped, received, sigma)


def dvl(
    truth: Truth,
    times: ArrayLike,
    rng: np.random.Generator,
    *,
    errors: DvlErrors | None = None,
    arm: LeverArm | None = None,
    reference: Literal["bottom", "water"] = "bottom",
    current: tuple[float, float] = (0.0, 0.0),
    sigma: float = VELOCITY_SIGMA,
    noise: float = 1.0,
) -> Velocity:
    """Velocity in the vehicle's axes, relative to the bottom or to the water.

    Parameters
    ----------
    truth : Truth
        The vehicle.
    times : array, shape (M,)
        s.
    rng : numpy.random.Generator
        For white noise.
    errors : DvlErrors, optional
        Scale, misalignment, bias.
    arm : LeverArm, optional
        Of the DVL.
    reference : {"bottom", "water"}
        What the velocity is relative to.
    current : tuple of float
        East and north velocity of the water, m/s; counts for "water" only.
    sigma, noise : float
        Standard deviation of each component, m/s, and what multiplies it.
    """
    t = np.atleast_1d(np.asarray(times, dtype=np.float64))
    world = truth.sensor_velocity(LeverArm() if arm is None else arm, t)
    if reference == "water":
        world = world - np.array([*current, 0.0])
    body = np.einsum("mji,mj->mi", truth.rotation(t), world)
    measured = (DvlErrors() if errors is None else errors).measured(body)
    measured = measured + noise * sigma * rng.standard_normal(measured.shape)
    forward, right, down = body_vector(*measured.T).T  # the flip is its own inverse
    return Velocity(t, forward, right, down, sigma, reference)


def ahrs(
    truth: Truth,
    times: ArrayLike,
    *,
    error: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sigma: float = ATTITUDE_SIGMA,
    rng: np.random.Generator | None = None,
    white: float = 0.0,
) -> Attitude:
    """Attitude with an error that lasts: the track's heading bias, and a constant one.

    Parameters
    ----------
    truth : Truth
        The vehicle.
    times : array, shape (M,)
        s.
    error : tuple of float
        Added to heading, pitch and roll, rad: a heading reference's error lasts.
    sigma : float
        Standard deviation of that error as the records state it, rad.
    rng : numpy.random.Generator, optional
        For white noise; left out, there is none.
    white : float
        Its standard deviation, rad, of each angle.
    """
    t = np.atleast_1d(np.asarray(times, dtype=np.float64))
    angles = np.stack([truth.heading(t) + truth.heading_bias(t), truth.pitch(t), truth.roll(t)])
    angles = angles + np.array(error)[:, None]
    if rng is not None:
        angles = angles + white * rng.standard_normal(angles.shape)
    heading, pitch, roll = angles
    return Attitude(t, heading, pitch, roll, sigma)


def pressure(
    truth: Truth,
    times: ArrayLike,
    rng: np.random.Generator,
    *,
    arm: LeverArm | None = None,
    sigma: float = DEPTH_SIGMA,
    noise: float = 1.0,
) -> Depth:
    """Depth at the sensor's lever arm at times (M,), s; `sigma` in metres."""
    t = np.atleast_1d(np.asarray(times, dtype=np.float64))
    up = truth.sensor_position(LeverArm() if arm is None else arm, t)[:, 2]
    return Depth(t, -up + noise * sigma * rng.standard_normal(len(t)), sigma)


def slant_ranges(
    truth: Truth,
    beacons: Sequence[Beacon],
    times: ArrayLike,
    rng: np.random.Generator,
    *,
    arm: LeverArm | None = None,
    sigma: float = SLANT_RANGE_SIGMA,
    noise: float = 1.0,
) -> SlantRange:
    """Distances to the beacons in turn, at times (M,), s; `sigma` in metres."""
    t = np.atleast_1d(np.asarray(times, dtype=np.float64))
    asked = [beacons[i % len(beacons)] for i in range(len(t))]
    place = np.array([b.position for b in asked]).reshape(-1, 3)
    antenna = truth.sensor_position(LeverArm() if arm is None else arm, t)
    distance = np.linalg.norm(antenna - place, axis=1)
    distance = distance + noise * sigma * rng.standard_normal(len(t))
    return SlantRange(t, np.array([b.name for b in asked]), distance, sigma)


def fixes(
    truth: Truth,
    times: ArrayLike,
    rng: np.random.Generator,
    *,
    arm: LeverArm | None = None,
    sigma: float = POSITION_SIGMA,
    noise: float = 1.0,
    horizontal: bool = True,
) -> PositionFix:
    """Positions of the antenna at times (M,), s; `sigma` in metres, `horizontal` without up."""
    t = np.atleast_1d(np.asarray(times, dtype=np.float64))
    seen = truth.sensor_position(LeverArm() if arm is None else arm, t)
    east, north, up = (seen + noise * sigma * rng.standard_normal(seen.shape)).T
    return PositionFix(t, east, north, None if horizontal else up, sigma)


def _arrival(
    truth: Truth,
    arm: LeverArm,
    beacon: FloatArray,
    sent: FloatArray,
    sea: Sea,
    clock: Clock | None = None,
) -> FloatArray:
    """Time (M,), s, that sound sent by the beacons at `sent` flies until it meets the vehicle.

    A fixed point of tau(p(arrival)); iterated on the flight time, whose rounding is finer than
    that of the clock's reading. With `clock`, times of flight and sending are the beacons'.
    """
    clock = Clock() if clock is None else clock
    flight = np.zeros(len(sent))
    for _ in range(_MOST_ITERATIONS):
        met = (sent + flight + clock.offset) / (1.0 - clock.drift)
        before, flight = flight, sea.travel_time(truth.sensor_position(arm, met), beacon, met)
        if np.max(np.abs(flight - before), initial=0.0) < ARRIVAL_TOLERANCE:
            return flight
    raise SolverError("a reply's arrival did not settle: is the vehicle as fast as sound?")


def _at(quantity: Slow, t: FloatArray) -> FloatArray:
    return quantity(t) if callable(quantity) else np.full(t.shape, float(quantity))
