"""A Mission: records, beacons, vehicle, sound speed and options, checked as a whole."""

from __future__ import annotations

import hashlib
from dataclasses import astuple, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.beacon import Beacon
from ubl_graph.errors import DataError
from ubl_graph.frames import GeodeticOrigin, LeverArm
from ubl_graph.measurements import AngularRate, Heading, Odometry, Velocity
from ubl_graph.mission_checks import (
    RANGE_KINDS,
    check_attitude,
    check_beacons,
    check_current,
    check_duplicates,
    check_epochs,
    check_kinds,
    check_located,
    check_names,
    check_node,
    check_pose,
)
from ubl_graph.options import Options
from ubl_graph.segment import RECORD_KINDS, Reference, Segment, Start

__all__ = ["RECORD_KINDS", "Mission", "Reference", "Segment", "Setup", "Start", "Vehicle"]

#: Relative standard deviation of the sound speed at the start: a measured profile, a constant.
PROFILE_SIGMA, CONSTANT_SIGMA = 1e-3, 5e-3


@dataclass(frozen=True)
class Vehicle:
    """Lever arms of the sensors, from the vehicle's reference point, which is what is estimated.

    Attributes
    ----------
    transducer, dvl, depth_sensor, antenna : LeverArm
        Acoustic transducer, DVL, pressure sensor, antenna of the position fixes.
    """

    transducer: LeverArm = field(default_factory=LeverArm)
    dvl: LeverArm = field(default_factory=LeverArm)
    depth_sensor: LeverArm = field(default_factory=LeverArm)
    antenna: LeverArm = field(default_factory=LeverArm)


@dataclass(frozen=True, eq=False)
class Setup:
    """What is known before any measurement: beacons, water, vehicle, and what was chosen.

    Attributes
    ----------
    beacons : tuple of Beacon
        Names are unique.
    sound_speed : SoundSpeedProfile
        Speed over depth, or a constant.
    vehicle : Vehicle
        Lever arms.
    options : Options
        Everything that can be chosen.
    start : Start, optional
        Prior on the position at one time.
    name : str
        For titles and file headers.
    origin : GeodeticOrigin, optional
        Where the local frame sits on the Earth.

    Raises
    ------
    ConfigurationError
        Where two beacons have the same name.
    """

    beacons: tuple[Beacon, ...] = ()
    sound_speed: SoundSpeedProfile = field(default_factory=lambda: SoundSpeedProfile.constant(1500))
    vehicle: Vehicle = field(default_factory=Vehicle)
    options: Options = field(default_factory=Options)
    start: Start | None = None
    name: str = ""
    origin: GeodeticOrigin | None = None

    def __post_init__(self) -> None:
        check_names(self.beacons)
        check_node(self.options, self.start)

    @property
    def beacon_names(self) -> tuple[str, ...]:
        """Names of the beacons, in order."""
        return tuple(b.name for b in self.beacons)

    def beacon_numbers(self, names: FloatArray) -> IntArray:
        """Number in `beacons` of each name, shape (M,); the names are known to be there."""
        return np.array([self._numbers[str(name)] for name in names], dtype=np.int64)

    @cached_property
    def _numbers(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.beacon_names)}

    @property
    def uses_eigenrays(self) -> bool:
        """Whether travel times run along eigenrays (else along straight lines)."""
        if self.options.rays == "auto":
            return not self.sound_speed.is_constant
        return self.options.rays == "eigenray"

    @property
    def sound_speed_sigma(self) -> float:
        """Relative standard deviation of the sound speed at a segment's start, in force."""
        if self.options.sound_speed_sigma is not None:
            return self.options.sound_speed_sigma
        return CONSTANT_SIGMA if self.sound_speed.is_constant else PROFILE_SIGMA

    def check_beacons(self, ranges: Any) -> None:
        """Refuse ranges that name a beacon which is not there.

        Raises
        ------
        DataError
            It names the record, and the beacon that may have been meant.
        """
        check_beacons(ranges, self.beacon_names)

    def check_current(self, velocity: Velocity) -> None:
        """Refuse velocities relative to the water where the current is no unknown.

        Raises
        ------
        DataError
            It names the record.
        """
        check_current(velocity, self.options)

    def check_pose(self, records: Heading | AngularRate | Odometry) -> None:
        """Refuse records that need poses where nodes are points.

        Raises
        ------
        DataError
            It names the record.
        """
        check_pose(records, self.options)

    def check_start(self, start: Start) -> None:
        """Refuse a heading to start with where nodes are points.

        Raises
        ------
        ConfigurationError
            It names the heading.
        """
        check_node(self.options, start)

    def fingerprint(self) -> str:
        """A hash of all but the name: equal for setups that mean the same."""
        profile = self.sound_speed
        parts = (
            [(b.name, b.position.tolist(), b.sigma.tolist(), b.turnaround) for b in self.beacons],
            profile.depth.tolist(),
            profile.speed.tolist(),
            astuple(self.vehicle),
            astuple(self.options),
            None if self.start is None else astuple(self.start),
            None if self.origin is None else astuple(self.origin),
        )
        return hashlib.sha256(repr(parts).encode()).hexdigest()


@dataclass(frozen=True, eq=False)
class Mission:
    """All that `smooth` needs to know.

    Attributes
    ----------
    segments : tuple of Segment
        At least one.
    beacons : tuple of Beacon
        Every beacon that the ranges name; names are unique.
    sound_speed : SoundSpeedProfile
        Speed over depth, or a constant.
    vehicle : Vehicle
        Lever arms.
    options : Options
        Everything that can be chosen.
    name : str
        For titles and file headers.
    origin : GeodeticOrigin, optional
        Where the local frame sits on the Earth.
    aided : bool
        Whether others (vehicles of a fleet) may say where the vehicle is: then a segment needs no
        range and no fix of its own.

    Raises
    ------
    DataError
        Where a range names an unknown beacon, a record is there twice, or there is nothing to
        smooth.
    ConfigurationError
        Where options, lever arms and data do not go together.
    """

    segments: tuple[Segment, ...]
    beacons: tuple[Beacon, ...]
    sound_speed: SoundSpeedProfile
    vehicle: Vehicle = field(default_factory=Vehicle)
    options: Options = field(default_factory=Options)
    name: str = ""
    origin: GeodeticOrigin | None = None
    aided: bool = False

    def __post_init__(self) -> None:
        check_names(self.beacons)
        if not self.segments:
            raise DataError("the mission holds no data", "name a data file or a line")
        for segment in self.segments:
            self._check_segment(segment)

    @cached_property
    def setup(self) -> Setup:
        """The mission without its records."""
        return Setup(
            self.beacons,
            self.sound_speed,
            self.vehicle,
            self.options,
            name=self.name,
            origin=self.origin,
        )

    @property
    def beacon_names(self) -> tuple[str, ...]:
        """Names of the beacons, in order."""
        return self.setup.beacon_names

    def beacon_numbers(self, names: FloatArray) -> IntArray:
        """Number in `beacons` of each name, shape (M,); the names are known to be there."""
        return self.setup.beacon_numbers(names)

    @property
    def uses_eigenrays(self) -> bool:
        """Whether travel times run along eigenrays (else along straight lines)."""
        return self.setup.uses_eigenrays

    @property
    def sound_speed_sigma(self) -> float:
        """Relative standard deviation of the sound speed at a segment's start, in force."""
        return self.setup.sound_speed_sigma

    def _check_segment(self, segment: Segment) -> None:
        records = segment.records()
        where = f"segment '{segment.name}'" if segment.name else "the mission"
        if not self.aided:
            check_located(tuple(records), where)
        check_kinds(tuple(records), self.options, where)
        check_node(self.options, segment.start)
        for kind, rows in records.items():
            check_duplicates(rows, RECORD_KINDS[kind][1])
            if kind in RANGE_KINDS:
                self.setup.check_beacons(rows)
        check_epochs(segment)
        if self.options.node == "point":
            check_attitude(segment, self.vehicle, self.options, where)
        if segment.velocity is not None:
            self.setup.check_current(segment.velocity)
