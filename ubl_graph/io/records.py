"""From CSV files to measurement records and sound-speed profiles.

Module `columns` says which columns each kind of file has. A column bears the name of the record's
field and holds SI units, but for angles, which files give in degrees. Rows may stand in any order
of time. Columns of other names are ignored, unless one looks like a slip for an optional column
that is missing: then the file is refused, since a silently ignored ``sgima`` is a wrong result.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.acoustics.profile import FASTEST, SLOWEST
from ubl_graph.arrays import FloatArray
from ubl_graph.beacon import Beacon
from ubl_graph.errors import ConfigurationError
from ubl_graph.frames import GeodeticOrigin
from ubl_graph.io.columns import (
    COVARIANCE,
    VERTICAL_COVARIANCE,
    bounded,
    degrees,
    opened,
    records_of,
)
from ubl_graph.io.tables import Table, did_you_mean, naming, read_table
from ubl_graph.measurements import (
    TRAVEL_TIME_SIGMA,
    AngularRate,
    Attitude,
    Depth,
    Heading,
    Odometry,
    OneWayRange,
    PositionFix,
    SlantRange,
    TwoWayRange,
    Velocity,
    odometry_covariance,
)


def read_two_way_range(
    file: str | Path,
    beacons: Sequence[Beacon] = (),
    sigma: float = TRAVEL_TIME_SIGMA,
    others: Sequence[str] = (),
) -> TwoWayRange:
    """Read pings and replies.

    Parameters
    ----------
    file : path
        CSV with ``beacon, t_transmit, t_receive`` (s) and ``travel_time`` (s), or ``slant_range``
        (m) and the ``sound_speed`` that the modem assumed (m/s), or neither.
    beacons : sequence of Beacon
        Whose `turnaround` is taken out where a file gives neither.
    sigma : float
        Standard deviation of the travel time where the file has no column of it, s.
    others : sequence of str
        Names of what answers beside the beacons, without a turnaround that is known.

    Returns
    -------
    TwoWayRange

    Raises
    ------
    DataError
        Where the file or a value in it is wrong.
    ConfigurationError
        Where a turnaround is needed and the beacon has none.
    """
    table = opened("two_way_range", read_table(file))
    return two_way_ranges(table, beacons, sigma, others)


def two_way_ranges(
    table: Table,
    beacons: Sequence[Beacon],
    sigma: float | FloatArray,
    others: Sequence[str] = (),
) -> TwoWayRange:
    """Pings and replies of a table that was opened, as `read_two_way_range`; `sigma` may be (M,).

    Raises
    ------
    DataError, ConfigurationError
        As `read_two_way_range`.
    """
    if "travel_time" in table:
        return records_of(TwoWayRange, "two_way_range", table, sigma=sigma)
    times = table.text("beacon"), table.numbers("t_transmit"), table.numbers("t_receive")
    spread = table.numbers("sigma") if "sigma" in table else sigma
    if "slant_range" in table or "sound_speed" in table:
        return TwoWayRange.from_slant_range(
            *times,
            table.numbers("slant_range"),
            table.numbers("sound_speed"),
            spread,
            source=table.source,
        )
    waits = _turnarounds(table, beacons, others)
    return TwoWayRange.from_turnaround(*times, waits, spread, source=table.source)


def read_one_way_range(file: str | Path, sigma: float = TRAVEL_TIME_SIGMA) -> OneWayRange:
    """Read broadcasts heard: ``beacon, t_transmit, t_receive[, sigma]``, s.

    Parameters
    ----------
    file : path
    sigma : float
        Standard deviation where the file has no column of it, s.

    Returns
    -------
    OneWayRange

    Raises
    ------
    DataError
        Where the file or a value in it is wrong.
    """
    table = opened("one_way_range", read_table(file))
    return records_of(OneWayRange, "one_way_range", table, sigma=sigma)


def read_slant_range(file: str | Path) -> SlantRange:
    """Read distances in metres: ``t, beacon, distance[, sigma]``, s and m.

    Raises
    ------
    DataError
        Where the file or a value in it is wrong.
    """
    return records_of(SlantRange, "slant_range", opened("slant_range", read_table(file)))


def read_velocity(file: str | Path) -> Velocity:
    """Read DVL velocities: ``t, forward, right, down[, sigma, reference]``, s and m/s.

    Raises
    ------
    DataError
        Where the file or a value in it is wrong.
    """
    return records_of(Velocity, "velocity", opened("velocity", read_table(file)))


def read_attitude(file: str | Path) -> Attitude:
    """Read attitudes: ``t, heading[, pitch, roll, sigma]``, s and degrees.

    Raises
    ------
    DataError
        Where the file or a value in it is wrong.
    """
    return records_of(Attitude, "attitude", opened("attitude", read_table(file)))


def read_heading(file: str | Path) -> Heading:
    """Read compass headings: ``t, heading[, sigma]``, s and degrees.

    Raises
    ------
    DataError
        Where the file or a value in it is wrong.
    """
    return records_of(Heading, "heading", opened("heading", read_table(file)))


def read_angular_rate(file: str | Path) -> AngularRate:
    """Read gyros: ``t, about_down[, about_forward, about_right, sigma]``, s and degrees/s.

    Raises
    ------
    DataError
        Where the file or a value in it is wrong.
    """
    return records_of(AngularRate, "angular_rate", opened("angular_rate", read_table(file)))


def read_odometry(file: str | Path) -> Odometry:
    """Read changes of pose.

    Parameters
    ----------
    file : path
        CSV with ``t_from, t_to`` (s), ``forward, right`` (m), ``about_down`` (degrees) and, where
        the vehicle does not move in a plane, ``down`` (m), ``about_forward, about_right``
        (degrees), of which those left out are zero. ``sigma`` (m, each displacement) and
        ``sigma_turn`` (degrees, each rotation) stand together or not at all.

    Returns
    -------
    Odometry

    Raises
    ------
    DataError
        Where the file or a value in it is wrong.
    """
    table = opened("odometry", read_table(file))
    spatial = [name for name in Odometry.SPATIAL if name in table]
    zeros: dict[str, Any] = dict.fromkeys(Odometry.SPATIAL if spatial else (), 0.0)
    spread: dict[str, Any] = {}
    if "sigma" in table or "sigma_turn" in table:
        table.require("sigma", "sigma_turn")
        spread["covariance"] = odometry_covariance(
            bounded(table, "sigma", 1e-6, 1e4, "m"),
            np.deg2rad(degrees(table, "sigma_turn", 1e-6, 180.0)),
            3 if spatial else 2,
        )
    return records_of(Odometry, "odometry", table, **zeros, **spread)


def read_depth(file: str | Path) -> Depth:
    """Read depths: ``t, depth[, sigma]``, s and m, positive down.

    Raises
    ------
    DataError
        Where the file or a value in it is wrong.
    """
    return records_of(Depth, "depth", opened("depth", read_table(file)))


def read_position(file: str | Path, origin: GeodeticOrigin | None = None) -> PositionFix:
    """Read position fixes.

    Parameters
    ----------
    file : path
        CSV with ``t, east, north[, up]`` (s, m) or ``t, latitude, longitude[, height]`` (s,
        degrees, m); the former is taken where both are there. Either ``sigma`` (m) or the
        covariance (m^2) as ``cov_east_east, cov_east_north, cov_north_north`` and, for fixes with
        a vertical, ``cov_east_up, cov_north_up, cov_up_up``; the latter is taken where both are
        there.
    origin : GeodeticOrigin, optional
        Needed for latitudes and longitudes.

    Returns
    -------
    PositionFix

    Raises
    ------
    DataError
        Where the file or a value in it is wrong.
    ConfigurationError
        Where latitudes are given and no origin.
    """
    table = read_table(file)
    geodetic = "east" not in table and ("latitude" in table or "longitude" in table)
    opened("geodetic_position" if geodetic else "position", table)
    spread: dict[str, Any] = {}
    vertical = "height" if geodetic else "up"
    if any(name in table for name in COVARIANCE):
        spread["covariance"] = _covariance(table, vertical)
    elif "sigma" in table:
        spread["sigma"] = table.numbers("sigma")
    if geodetic:
        east, north, up = _local(table, origin).T
    else:
        east, north = table.numbers("east"), table.numbers("north")
        up = table.numbers("up") if "up" in table else None
    return PositionFix(
        table.numbers("t"),
        east,
        north,
        up if vertical in table else None,
        **spread,
        source=table.source,
    )


def read_sound_speed(file: str | Path) -> SoundSpeedProfile:
    """Read a profile: ``depth, speed`` (names in any case), m positive down and m/s.

    Raises
    ------
    DataError
        Where the file or a value in it is wrong, or depths do not increase from row to row.
    """
    table = opened("sound_speed", read_table(file).lower())
    depth, speed = table.finite("depth"), table.finite("speed")
    outside = (speed < SLOWEST) | (speed > FASTEST)
    if outside.any():
        i = int(np.argmax(outside))
        problem = f"{speed[i]} m/s is no speed of sound in water ({SLOWEST:g} to {FASTEST:g})"
        raise table.source.error(i, "speed", problem, "metres per second are meant")
    back = np.diff(depth, prepend=-np.inf) <= 0.0
    if back.any():
        i = int(np.argmax(back))
        problem = f"{depth[i]} m is not below the row before ({depth[i - 1]} m)"
        raise table.source.error(i, "depth", problem, "sort by depth and drop duplicates")
    with naming(file):
        return SoundSpeedProfile(depth, speed)


def _turnarounds(table: Table, beacons: Sequence[Beacon], others: Sequence[str]) -> FloatArray:
    """Turnaround of each row's beacon, s, shape (M,)."""
    by_name = dict.fromkeys(others) | {beacon.name: beacon.turnaround for beacon in beacons}
    names, inverse = np.unique(table.text("beacon"), return_inverse=True)
    waits = np.empty(len(names))
    for i, name in enumerate(names.tolist()):
        first = int(np.argmax(inverse == i))
        if name not in by_name:
            what = "beacon, vehicle or target" if others else "beacon"
            raise table.source.error(
                first, "beacon", f"unknown {what} '{name}'", did_you_mean(name, list(by_name))
            )
        wait = by_name[name]
        if wait is None:
            who = "" if name in others else "beacon "
            remedy = f", or turnaround (s) to beacon '{name}'" if who else ""
            raise ConfigurationError(
                f"no travel times are given, and {who}'{name}' states no turnaround to take out "
                "of receive minus transmit time",
                f"add a column travel_time{remedy}",
                file=table.file,
                row=int(table.source.row[first]),
                line=int(table.source.line[first]),
                field="travel_time",
            )
        waits[i] = wait
    return waits[inverse]


def _covariance(table: Table, vertical: str) -> FloatArray:
    """Covariance matrices, m^2, shape (M, 2, 2) or, with a vertical, (M, 3, 3)."""
    if any(name in table for name in VERTICAL_COVARIANCE):
        table.require(vertical)
    upper = {
        (0, 0): "cov_east_east",
        (0, 1): "cov_east_north",
        (1, 1): "cov_north_north",
        (0, 2): "cov_east_up",
        (1, 2): "cov_north_up",
        (2, 2): "cov_up_up",
    }
    size = 3 if vertical in table else 2
    matrices = np.empty((len(table), size, size))
    for (i, j), name in upper.items():
        if j < size:
            matrices[:, i, j] = matrices[:, j, i] = table.finite(name)
    return matrices


def _local(table: Table, origin: GeodeticOrigin | None) -> FloatArray:
    """Geodetic columns as east, north, up, m, shape (M, 3); without height at the origin's."""
    if origin is None:
        raise ConfigurationError(
            "latitudes and longitudes need an origin",
            "give origin = { latitude = ..., longitude = ... } under [mission]",
            file=table.file,
            field="latitude",
        )
    latitude = degrees(table, "latitude", -90.0, 90.0)
    longitude = degrees(table, "longitude", -360.0, 360.0)
    height = table.finite("height") if "height" in table else origin.height
    return origin.to_enu(latitude, longitude, height)
