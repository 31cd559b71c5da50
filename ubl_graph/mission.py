"""A Mission: records, beacons, vehicle, sound speed and options, checked as a whole."""

from __future__ import annotations

import difflib
import hashlib
from collections.abc import Sequence
from dataclasses import astuple, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.arrays import FloatArray, IntArray, frozen
from ubl_graph.beacon import Beacon
from ubl_graph.errors import ConfigurationError, DataError
from ubl_graph.frames import GeodeticOrigin, LeverArm
from ubl_graph.measurements import Attitude, Depth, OneWayRange, PositionFix, TwoWayRange, Velocity
from ubl_graph.options import Options
from ubl_graph.records import Records

#: Relative standard deviation of the sound speed at the start: a measured profile, a constant.
PROFILE_SIGMA, CONSTANT_SIGMA = 1e-3, 5e-3

#: Depth and attitude may begin or end so much before or after the ranges, s.
EPOCH_SLACK = 600.0

#: The record kinds of a segment: attribute, class, and the columns that make a duplicate.
RECORD_KINDS: dict[str, tuple[type[Records], tuple[str, ...]]] = {
    "two_way_range": (TwoWayRange, ("beacon", "t_transmit", "t_receive")),
    "one_way_range": (OneWayRange, ("beacon", "t_transmit", "t_receive")),
    "velocity": (Velocity, ("t", "reference")),
    "attitude": (Attitude, ("t",)),
    "depth": (Depth, ("t",)),
    "position": (PositionFix, ("t",)),
}


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


@dataclass(frozen=True)
class Start:
    """Where the vehicle was at one time, as far as is known: a prior.

    Attributes
    ----------
    t : float
        Seconds.
    east, north : float
        Metres.
    up : float, optional
        Metres; left out where only the horizontal position is known.
    sigma : float
        Standard deviation of each component, m.
    """

    t: float
    east: float
    north: float
    up: float | None = None
    sigma: float = 10.0

    def __post_init__(self) -> None:
        for name in ("t", "east", "north", "up", "sigma"):
            value = getattr(self, name)
            if value is not None and not np.isfinite(value):
                raise ConfigurationError(f"{value} is not finite", field=f"start.{name}")
        if self.sigma <= 0.0:
            raise ConfigurationError(
                f"a sigma of {self.sigma} m", "give metres, more than zero", field="start.sigma"
            )


@dataclass(frozen=True, eq=False)
class Reference:
    """An independent track to compare with; no estimator ever sees it.

    Attributes
    ----------
    t : array, shape (M,)
        Seconds, not decreasing.
    position : array, shape (M, 3)
        East, north, up, m.
    """

    t: FloatArray
    position: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "t", frozen(self.t))
        object.__setattr__(self, "position", frozen(self.position))


@dataclass(frozen=True, eq=False)
class Segment:
    """A stretch of a mission with a trajectory of its own: one line, one dive.

    Attributes
    ----------
    name : str
        Label of the segment in outputs; empty where a mission has only one.
    two_way_range, one_way_range, velocity, attitude, depth, position : records, optional
        What was measured.
    start : Start, optional
        Prior on the position at one time.
    reference : Reference, optional
        Independent track at the pings' transmit times, for comparison alone.
    """

    name: str = ""
    two_way_range: TwoWayRange | None = None
    one_way_range: OneWayRange | None = None
    velocity: Velocity | None = None
    attitude: Attitude | None = None
    depth: Depth | None = None
    position: PositionFix | None = None
    start: Start | None = None
    reference: Reference | None = None

    def records(self) -> dict[str, Records]:
        """Record sets that are present and not empty, by kind."""
        present = {kind: getattr(self, kind) for kind in RECORD_KINDS}
        return {kind: r for kind, r in present.items() if r is not None and len(r) > 0}


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
        _check_names(self.beacons)

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
        unknown = ~np.isin(ranges.beacon, np.array(self.beacon_names, dtype=np.str_))
        if unknown.any():
            i = int(np.argmax(unknown))
            name = str(ranges.beacon[i])
            near = difflib.get_close_matches(name, self.beacon_names, n=1)
            hint = f"did you mean '{near[0]}'? " if near else ""
            known = ", ".join(self.beacon_names) or "none"
            raise ranges.error(i, "beacon", f"unknown beacon '{name}'", f"{hint}known: {known}")

    def check_current(self, velocity: Velocity) -> None:
        """Refuse velocities relative to the water where the current is no unknown.

        Raises
        ------
        DataError
            It names the record.
        """
        water = velocity.reference == "water"
        if water.any() and not self.options.estimate_current:
            raise velocity.error(
                int(np.argmax(water)),
                "reference",
                "a velocity relative to the water needs the current as a state",
                "set estimate_current = true under [options], or drop the water-track rows",
            )

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


def _check_names(beacons: Sequence[Beacon]) -> None:
    names = [b.name for b in beacons]
    for name in names:
        if names.count(name) > 1:
            raise ConfigurationError(f"beacon '{name}' is there twice", field="beacon")


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

    def __post_init__(self) -> None:
        _check_names(self.beacons)
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
        if not {"two_way_range", "one_way_range", "position"} & records.keys():
            raise DataError(
                f"{where} holds no range and no position fix", "add a file with at least one row"
            )
        for kind, rows in records.items():
            again = rows.duplicates(*RECORD_KINDS[kind][1])
            if again is not None:
                column = RECORD_KINDS[kind][1][-1]
                value = getattr(rows, column)[again]
                raise rows.error(
                    again, column, f"duplicate record ({column} = {value})", "keep one of the two"
                )
        for kind in ("two_way_range", "one_way_range"):
            if kind in records:
                self.setup.check_beacons(records[kind])
        self._check_epochs(segment)
        self._check_attitude(segment, where)
        if segment.velocity is not None:
            self.setup.check_current(segment.velocity)

    def _check_epochs(self, segment: Segment) -> None:
        """Refuse depth and attitude that do not meet the ranges: they are of another epoch."""
        spans = [
            (float(np.min(r.t_receive)), float(np.max(r.t_receive)))
            for r in (segment.two_way_range, segment.one_way_range)
            if r is not None and len(r)
        ]
        if not spans:
            return
        begin, end = min(s[0] for s in spans), max(s[1] for s in spans)
        for rows in (segment.depth, segment.attitude):
            # One record may stand for all times.
            if rows is None or len(rows) < 2:
                continue
            if rows.t.max() < begin - EPOCH_SLACK or rows.t.min() > end + EPOCH_SLACK:
                raise rows.error(
                    0,
                    "t",
                    f"{rows.t[0]} s: no record lies within the ranges' times, {begin} to {end} s",
                    "are all files in the same epoch?",
                )

    def _check_attitude(self, segment: Segment, where: str) -> None:
        if segment.attitude is not None and len(segment.attitude):
            return
        needs = {
            "velocity": segment.velocity is not None,
            "vehicle.transducer": not self.vehicle.transducer.is_zero,
            "vehicle.depth_sensor": not self.vehicle.depth_sensor.is_zero
            and segment.depth is not None,
            "vehicle.antenna": not self.vehicle.antenna.is_zero and segment.position is not None,
        }
        for name, needed in needs.items():
            if needed:
                raise ConfigurationError(
                    f"{where} has no attitude, and '{name}' cannot be turned into the world "
                    "without it",
                    "add an attitude file, or leave it out",
                    field=name,
                )
