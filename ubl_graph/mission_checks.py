"""What must go together in a mission: records with beacons, with options, and with each other."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ubl_graph.beacon import Beacon
from ubl_graph.errors import ConfigurationError, DataError
from ubl_graph.measurements import AngularRate, Heading, Odometry, Velocity
from ubl_graph.options import AUTO, Options
from ubl_graph.records import Records
from ubl_graph.segment import Segment, Start

if TYPE_CHECKING:
    from ubl_graph.mission import Vehicle

#: Kinds that hold ranges to beacons.
RANGE_KINDS = ("two_way_range", "one_way_range", "slant_range")
#: Kinds that a vehicle can use only if its nodes are poses.
POSE_KINDS = ("heading", "angular_rate", "odometry")
#: Depth, attitude and motion may begin or end so much before or after the ranges, s.
EPOCH_SLACK = 600.0

_POSE_REMEDY = "set node = 'pose2' or 'pose3' under [options], or leave these records out"


def check_names(beacons: Sequence[Beacon]) -> None:
    """Refuse two beacons of one name.

    Raises
    ------
    ConfigurationError
        It names the beacon.
    """
    names = [b.name for b in beacons]
    for name in names:
        if names.count(name) > 1:
            raise ConfigurationError(f"beacon '{name}' is there twice", field="beacon")


def check_node(options: Options, start: Start | None = None) -> None:
    """Refuse options and starts that do not go with the kind of node.

    Raises
    ------
    ConfigurationError
        Where poses are to move with white noise on jerk, or the kind of motion is left to the
        data; where a point has a heading to start with.
    """
    if options.node == "point":
        if start is not None and start.heading is not None:
            raise ConfigurationError(
                "node = 'point' has no heading to start with",
                "leave it out, or set node = 'pose2' or 'pose3' under [options]",
                field="start.heading",
            )
    elif options.motion in ("constant_acceleration", AUTO):
        raise ConfigurationError(
            f"motion = '{options.motion}' does not go with node = '{options.node}': poses move "
            "with white noise on acceleration",
            "set motion = 'constant_velocity', or node = 'point'",
            field="options.motion",
        )


def check_kinds(kinds: Sequence[str], options: Options, where: str) -> None:
    """Refuse kinds of records that need poses where nodes are points.

    Raises
    ------
    ConfigurationError
        It names the kind and the nodes that take it.
    """
    for kind in POSE_KINDS:
        if kind in kinds and options.node == "point":
            raise ConfigurationError(
                f"{where} has {kind} records, which node = 'point' cannot use",
                _POSE_REMEDY,
                field="options.node",
            )


def check_pose(records: Heading | AngularRate | Odometry, options: Options) -> None:
    """Refuse single records that need poses where nodes are points.

    Raises
    ------
    DataError
        It names the record.
    """
    if options.node == "point":
        kind = type(records).__name__
        raise records.error(0, None, f"node = 'point' cannot use {kind} records", _POSE_REMEDY)


def check_beacons(ranges: Any, names: tuple[str, ...]) -> None:
    """Refuse ranges that name a beacon which is not there.

    Parameters
    ----------
    ranges : TwoWayRange, OneWayRange or SlantRange
    names : tuple of str
        Of the beacons that are there.

    Raises
    ------
    DataError
        It names the record, and the beacon that may have been meant.
    """
    unknown = ~np.isin(ranges.beacon, np.array(names, dtype=np.str_))
    if unknown.any():
        i = int(np.argmax(unknown))
        name = str(ranges.beacon[i])
        near = difflib.get_close_matches(name, names, n=1)
        hint = f"did you mean '{near[0]}'? " if near else ""
        known = ", ".join(names) or "none"
        raise ranges.error(i, "beacon", f"unknown beacon '{name}'", f"{hint}known: {known}")


def check_current(velocity: Velocity, options: Options) -> None:
    """Refuse velocities relative to the water where the current is no unknown.

    Raises
    ------
    DataError
        It names the record.
    """
    water = velocity.reference == "water"
    if water.any() and not options.estimate_current:
        raise velocity.error(
            int(np.argmax(water)),
            "reference",
            "a velocity relative to the water needs the current as a state",
            "set estimate_current = true under [options], or drop the water-track rows",
        )


def check_duplicates(records: Records, columns: tuple[str, ...]) -> None:
    """Refuse a record that is there twice.

    Parameters
    ----------
    records : Records
    columns : tuple of str
        Those that make a duplicate, where all are equal.

    Raises
    ------
    DataError
        It names the second of the two.
    """
    again = records.duplicates(*columns)
    if again is not None:
        column = columns[-1]
        value = getattr(records, column)[again]
        raise records.error(
            again, column, f"duplicate record ({column} = {value})", "keep one of the two"
        )


def check_located(kinds: Sequence[str], where: str) -> None:
    """Refuse a segment in which nothing says where the vehicle is.

    Raises
    ------
    DataError
        It names the segment.
    """
    if not {*RANGE_KINDS, "position"} & set(kinds):
        raise DataError(
            f"{where} holds no range and no position fix", "add a file with at least one row"
        )


def check_epochs(segment: Segment) -> None:
    """Refuse depth, attitude and motion that do not meet the ranges: they are of another epoch.

    Raises
    ------
    DataError
        It names the first record of the kind.
    """
    ranges = [getattr(segment, kind) for kind in RANGE_KINDS]
    spans = [_span(r, "t_receive", "t_receive") for r in ranges if r is not None and len(r)]
    if not spans:
        return
    begin, end = min(s[0] for s in spans), max(s[1] for s in spans)
    for kind in ("depth", "attitude", *POSE_KINDS):
        rows = getattr(segment, kind)
        # One record may stand for all times.
        if rows is None or len(rows) < 2:
            continue
        first, last = _span(rows, "t_from", "t_to")
        if last < begin - EPOCH_SLACK or first > end + EPOCH_SLACK:
            column = "t" if hasattr(rows, "t") else "t_from"
            raise rows.error(
                0,
                column,
                f"{getattr(rows, column)[0]} s: no record lies within the ranges' times, "
                f"{begin} to {end} s",
                "are all files in the same epoch?",
            )


def _span(rows: Any, begin: str, end: str) -> tuple[float, float]:
    """First and last time of records that have one column `t`, or else these two, s."""
    first, last = ("t", "t") if hasattr(rows, "t") else (begin, end)
    return float(np.min(getattr(rows, first))), float(np.max(getattr(rows, last)))


def check_attitude(segment: Segment, vehicle: Vehicle, options: Options, where: str) -> None:
    """Refuse a segment of points that lacks the attitude which its sensors need.

    Raises
    ------
    ConfigurationError
        It names what needs it.
    """
    if segment.attitude is not None and len(segment.attitude):
        return
    needs = {
        "velocity": segment.velocity is not None,
        "vehicle.transducer": not vehicle.transducer.is_zero,
        "options.lever_arm_sigma": options.lever_arm_sigma > 0.0,
        "vehicle.depth_sensor": not vehicle.depth_sensor.is_zero and segment.depth is not None,
        "vehicle.antenna": not vehicle.antenna.is_zero and segment.position is not None,
    }
    for name, needed in needs.items():
        if needed:
            raise ConfigurationError(
                f"{where} has no attitude, and '{name}' cannot be turned into the world without it",
                "add an attitude file, or leave it out",
                field=name,
            )
