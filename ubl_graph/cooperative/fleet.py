"""A Fleet: vehicles that range each other, beacons and targets, checked as a whole."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.arrays import FloatArray, frozen
from ubl_graph.beacon import Beacon
from ubl_graph.errors import ConfigurationError, DataError
from ubl_graph.frames import GeodeticOrigin
from ubl_graph.mission import Mission, Segment, Setup, Vehicle
from ubl_graph.mission_checks import (
    EPOCH_SLACK,
    RANGE_KINDS,
    check_duplicates,
    check_names,
    check_node,
)
from ubl_graph.options import Options
from ubl_graph.pings import Pings, leg_times
from ubl_graph.segment import RECORD_KINDS

#: What is known of a target's place where nothing is said, m.
UNKNOWN_PLACE = 1e5
#: A target that moves faster is none, m/s.
FASTEST = 100.0


@dataclass(frozen=True, eq=False)
class Member:
    """A vehicle of a fleet, with what it measured.

    Parameters
    ----------
    name : str
        By which the ranges of others name it.
    segment : Segment
        Its records. The column `beacon` of its ranges names a beacon, another vehicle or a target:
        who replied, or whose broadcast was heard.
    vehicle : Vehicle
        Lever arms.
    options : Options
        Its nodes, motion and sensors. What belongs to the whole (`loss`, `solver`,
        `max_iterations`, `rays`, `estimate_beacons`, and what is said of the sound speed of ranges
        between vehicles) is taken from the fleet's options.
    """

    name: str
    segment: Segment
    vehicle: Vehicle = field(default_factory=Vehicle)
    options: Options = field(default_factory=Options)


@dataclass(frozen=True, eq=False)
class Target:
    """Something that vehicles range, at rest or in steady motion, whose place is asked for.

    One that wanders is a `Member` without sensors of its own.

    Parameters
    ----------
    name : str
        By which ranges name it.
    position : array, shape (3,), optional
        East, north, up where it is thought to be, m; at `t` where it moves. Left out, the search
        begins at what the ranges say.
    sigma : float or array, shape (3,), default 1e5
        Standard deviation of each component, m; 0 for one that is known, a depth most often.
    velocity_sigma : float or array, shape (3,), default 0
        Standard deviation of each component of its constant velocity, m/s; 0 everywhere for a
        target at rest.
    t : float, optional
        Time of `position` for one that moves, s; left out, the first range's.

    Raises
    ------
    DataError
        Where a number is not finite, negative where it must not be, or there are not three.
    """

    name: str
    position: Any = None
    sigma: Any = UNKNOWN_PLACE
    velocity_sigma: Any = 0.0
    t: float | None = None

    def __post_init__(self) -> None:
        position = None if self.position is None else self._three("position", self.position, "m")
        object.__setattr__(self, "position", position)
        limits = {"sigma": UNKNOWN_PLACE, "velocity_sigma": FASTEST}
        for name, unit in (("sigma", "m"), ("velocity_sigma", "m/s")):
            values = self._three(name, getattr(self, name), unit)
            if (values < 0.0).any() or (values > limits[name]).any():
                raise self._error(
                    name,
                    f"{values.tolist()} {unit} is outside 0 to {limits[name]:g} {unit}",
                    "give standard deviations",
                )
            object.__setattr__(self, name, values)
        if self.t is not None and not np.isfinite(self.t):
            raise self._error("t", f"{self.t} is not finite", "give seconds")
        if position is None and (self.sigma < UNKNOWN_PLACE).any():
            raise self._error("sigma", "a sigma of no position", "give position too")

    @property
    def moves(self) -> bool:
        """Whether its velocity is an unknown."""
        return bool((self.velocity_sigma > 0.0).any())

    def _three(self, name: str, values: Any, unit: str) -> FloatArray:
        try:
            array = np.asarray(values, dtype=np.float64)
        except (TypeError, ValueError):
            array = np.array(np.nan)
        if array.shape not in ((), (1,), (3,)) or not np.isfinite(array).all():
            raise self._error(
                name, f"{values} is no east, north, up in {unit}", "give three finite numbers"
            )
        if name == "position" and array.shape != (3,):
            raise self._error(name, f"{values} is not three numbers", "give east, north, up")
        return frozen(np.broadcast_to(array, (3,)))

    def _error(self, name: str, problem: str, remedy: str) -> DataError:
        return DataError(
            " ".join(problem.split()), remedy, record=f"target '{self.name}'", field=name
        )


@dataclass(frozen=True, eq=False)
class Fleet:
    """All that `smooth_fleet` needs to know.

    Attributes
    ----------
    vehicles : tuple of Member
        At least one.
    beacons : tuple of Beacon
        At rest, where they are said to be.
    targets : tuple of Target
        What is asked for beside the vehicles.
    sound_speed : SoundSpeedProfile
        Speed over depth, or a constant.
    options : Options
        What belongs to the whole: loss, solver, iterations, rays, whether beacons are unknowns,
        and the sound speed of ranges between vehicles.
    name : str
        For titles and file headers.
    origin : GeodeticOrigin, optional
        Where the local frame sits on the Earth.

    Raises
    ------
    ConfigurationError
        Where two of vehicles, beacons and targets have one name, there is no vehicle, or options do
        not go together.
    DataError
        Where a range has an unknown end or the vehicle itself at both, its times lie outside the
        other's records (clocks that differ by more than ten minutes), or a record is there twice;
        it names the record.
    """

    vehicles: tuple[Member, ...]
    beacons: tuple[Beacon, ...] = ()
    targets: tuple[Target, ...] = ()
    sound_speed: SoundSpeedProfile = field(default_factory=lambda: SoundSpeedProfile.constant(1500))
    options: Options = field(default_factory=Options)
    name: str = ""
    origin: GeodeticOrigin | None = None

    def __post_init__(self) -> None:
        given: Any = self.vehicles
        if not isinstance(given, tuple) or not all(
            isinstance(v, Member) and isinstance(vars(v)["segment"], Segment) for v in given
        ):
            raise ConfigurationError(
                "vehicles are no tuple of Member with a Segment each",
                "give (Member(name, segment), ...)",
                field="vehicle",
            )
        if not self.vehicles:
            raise ConfigurationError("the fleet has no vehicle", field="vehicle")
        check_names(self.beacons)
        self._check_names()
        self.options.require_settled()
        for member in self.vehicles:
            check_node(member.options, member.segment.start)
            member.options.require_settled()
            self._check_ends(member)
        for member in self.vehicles:
            # All that does not concern the others, as for any vehicle alone.
            self.mission_of(member.name)
            self._check_clocks(member)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all vehicles, beacons and targets."""
        groups: tuple[Sequence[Any], ...] = (self.vehicles, self.beacons, self.targets)
        return tuple(one.name for group in groups for one in group)

    @property
    def vehicle_names(self) -> tuple[str, ...]:
        """Names of the vehicles, in order."""
        return tuple(v.name for v in self.vehicles)

    @property
    def target_names(self) -> tuple[str, ...]:
        """Names of the targets, in order."""
        return tuple(t.name for t in self.targets)

    @cached_property
    def beacon_names(self) -> tuple[str, ...]:
        """Names of the beacons, in order."""
        return tuple(b.name for b in self.beacons)

    def member(self, name: str) -> Member:
        """The vehicle of that name.

        Raises
        ------
        ConfigurationError
            Where there is none.
        """
        for member in self.vehicles:
            if member.name == name:
                return member
        raise ConfigurationError(
            f"unknown vehicle '{name}'", f"known: {', '.join(self.vehicle_names)}"
        )

    @cached_property
    def setup(self) -> Setup:
        """What is common to all vehicles, with the fleet's options."""
        return Setup(
            self.beacons, self.sound_speed, options=self.options, name=self.name, origin=self.origin
        )

    def mission_of(self, name: str) -> Mission:
        """One vehicle's own mission: its records, but for its ranges to vehicles and targets.

        Raises
        ------
        DataError, ConfigurationError
            As `Mission` does.
        """
        member = self.member(name)
        return Mission(
            (own_ranges(member, self.beacon_names),),
            self.beacons,
            self.sound_speed,
            member.vehicle,
            self.options_of(member),
            name=member.name,
            origin=self.origin,
            aided=True,
        )

    def options_of(self, member: Member) -> Options:
        """A vehicle's options, with what belongs to the whole from the fleet's."""
        whole = ("loss", "solver", "max_iterations", "rays", "estimate_beacons")
        return replace(member.options, **{name: getattr(self.options, name) for name in whole})

    def _check_names(self) -> None:
        names: tuple[Any, ...] = self.names
        for name in names:
            if names.count(name) > 1:
                raise ConfigurationError(
                    f"the name '{name}' is there twice",
                    "vehicles, beacons and targets are told apart by their names",
                    field="name",
                )
            if not isinstance(name, str) or not name:
                raise ConfigurationError(
                    f"{name!r} is no name", "give a text that is not empty", field="name"
                )

    def _check_ends(self, member: Member) -> None:
        """Refuse ranges to the vehicle itself and to what is not there."""
        known = np.array(self.names, dtype=np.str_)
        for pings in ranges_of(member.segment).values():
            own = pings.beacon == member.name
            if own.any():
                raise pings.error(
                    int(np.argmax(own)),
                    "beacon",
                    f"a range of vehicle '{member.name}' to itself",
                    "name the vehicle, beacon or target at its other end",
                )
            unknown = ~np.isin(pings.beacon, known)
            if unknown.any():
                i = int(np.argmax(unknown))
                name = str(pings.beacon[i])
                near = difflib.get_close_matches(name, self.names, n=1)
                hint = f"did you mean '{near[0]}'? " if near else ""
                others = [n for n in self.names if n != member.name]
                raise pings.error(
                    i,
                    "beacon",
                    f"vehicle '{member.name}' ranges '{name}', which is no vehicle, beacon or "
                    "target",
                    f"{hint}known: {', '.join(others) or 'none'}",
                )
        for kind, pings in ranges_of(member.segment).items():
            check_duplicates(pings, RECORD_KINDS[kind][1])

    def _check_clocks(self, member: Member) -> None:
        """Refuse ranges between vehicles whose stamps lie far outside what either recorded."""
        spans = {v.name: span_of(v.segment) for v in self.vehicles}
        for pings in ranges_of(member.segment).values():
            times = leg_times(pings)
            for name in np.unique(pings.beacon):
                rows = np.flatnonzero(pings.beacon == name)
                for who in (str(name), member.name):
                    span = spans.get(who)
                    if span is None or str(name) in self.beacon_names:
                        continue
                    early = times[rows].min(axis=1) < span[0] - EPOCH_SLACK
                    late = times[rows].max(axis=1) > span[1] + EPOCH_SLACK
                    if (early | late).any():
                        i = int(rows[np.argmax(early | late)])
                        gap = max(span[0] - times[i].min(), times[i].max() - span[1])
                        differ = f"the clocks of '{member.name}' and '{name}' seem to differ"
                        if str(name) not in spans:
                            differ = f"the clocks of the ranges to '{name}' and of these differ"
                        raise pings.error(
                            i,
                            "t" if hasattr(pings, "t") else "t_receive",
                            f"{times[i, -1]} s: vehicle '{who}' has records from {span[0]} to "
                            f"{span[1]} s only, so {differ} by {gap:.0f} s",
                            "bring all vehicles' stamps to one epoch",
                        )


def ranges_of(segment: Segment) -> dict[str, Pings]:
    """The ranges of a segment that are present and not empty, by kind."""
    present = segment.records()
    return {kind: getattr(segment, kind) for kind in RANGE_KINDS if kind in present}


def own_ranges(member: Member, beacons: Sequence[str]) -> Segment:
    """A vehicle's segment with its ranges to beacons alone, named after the vehicle."""
    kept: dict[str, Any] = {}
    for kind, pings in ranges_of(member.segment).items():
        rows = pings[np.isin(pings.beacon, np.array(beacons, dtype=np.str_))]
        kept[kind] = rows if len(rows) else None
    return replace(member.segment, name=member.name, **kept)


def peer_ranges(member: Member, beacons: Sequence[str]) -> dict[str, Pings]:
    """A vehicle's ranges to other vehicles and to targets, by kind."""
    out: dict[str, Pings] = {}
    for kind, pings in ranges_of(member.segment).items():
        rows = pings[~np.isin(pings.beacon, np.array(beacons, dtype=np.str_))]
        if len(rows):
            out[kind] = rows
    return out


def span_of(segment: Segment) -> tuple[float, float] | None:
    """First and last time of what a vehicle recorded of itself, s; None where it did nothing."""
    times: list[FloatArray] = []
    for kind, rows in segment.records().items():
        if kind in RANGE_KINDS:
            continue
        columns = ("t",) if hasattr(rows, "t") else ("t_from", "t_to")
        times += [getattr(rows, column) for column in columns]
    # A single record may stand for all times.
    times = [t for t in times if len(t) > 1]
    if not times:
        return None
    whole = np.concatenate(times)
    return float(whole.min()), float(whole.max())
