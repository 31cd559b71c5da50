"""From CSV files to measurement records and sound-speed profiles.

`LAYOUTS` says which columns each kind of file has. A column bears the name of the record's field
and holds SI units, but for angles, which files give in degrees. Rows may stand in any order of
time. Columns of other names are ignored, unless one looks like a slip for an optional column that
is missing: then the file is refused, since a silently ignored ``sgima`` is a wrong result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.acoustics.profile import FASTEST, SLOWEST
from ubl_graph.arrays import FloatArray
from ubl_graph.beacon import Beacon
from ubl_graph.errors import ConfigurationError, DataError
from ubl_graph.frames import GeodeticOrigin
from ubl_graph.io.tables import Table, did_you_mean, naming, nearest, read_table
from ubl_graph.measurements import (
    TRAVEL_TIME_SIGMA,
    Attitude,
    Depth,
    OneWayRange,
    PositionFix,
    TwoWayRange,
    Velocity,
)
from ubl_graph.records import Records

HORIZONTAL_COVARIANCE = ("cov_east_east", "cov_east_north", "cov_north_north")
VERTICAL_COVARIANCE = ("cov_east_up", "cov_north_up", "cov_up_up")
_COVARIANCE = (*HORIZONTAL_COVARIANCE, *VERTICAL_COVARIANCE)

AnyRecords = TypeVar("AnyRecords", bound=Records)


@dataclass(frozen=True)
class Layout:
    """Columns of one kind of file.

    Attributes
    ----------
    required, optional : tuple of str
        Names of columns.
    degrees : tuple of str
        Those that hold degrees.
    """

    required: tuple[str, ...]
    optional: tuple[str, ...] = ()
    degrees: tuple[str, ...] = ()


LAYOUTS: dict[str, Layout] = {
    "two_way_range": Layout(
        ("beacon", "t_transmit", "t_receive"),
        ("travel_time", "slant_range", "sound_speed", "sigma"),
    ),
    "one_way_range": Layout(("beacon", "t_transmit", "t_receive"), ("sigma",)),
    "velocity": Layout(("t", "forward", "right", "down"), ("sigma", "reference")),
    "attitude": Layout(
        ("t", "heading"), ("pitch", "roll", "sigma"), ("heading", "pitch", "roll", "sigma")
    ),
    "depth": Layout(("t", "depth"), ("sigma",)),
    "position": Layout(("t", "east", "north"), ("up", "sigma", *_COVARIANCE)),
    "geodetic_position": Layout(("t", "latitude", "longitude"), ("height", "sigma", *_COVARIANCE)),
    "sound_speed": Layout(("depth", "speed")),
}


def read_two_way_range(
    file: str | Path, beacons: Sequence[Beacon] = (), sigma: float = TRAVEL_TIME_SIGMA
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
    table = _open("two_way_range", read_table(file))
    if "travel_time" in table:
        return _records(TwoWayRange, "two_way_range", table, sigma=sigma)
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
    waits = _turnarounds(table, beacons)
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
    table = _open("one_way_range", read_table(file))
    return _records(OneWayRange, "one_way_range", table, sigma=sigma)


def read_velocity(file: str | Path) -> Velocity:
    """Read DVL velocities: ``t, forward, right, down[, sigma, reference]``, s and m/s.

    Raises
    ------
    DataError
        Where the file or a value in it is wrong.
    """
    return _records(Velocity, "velocity", _open("velocity", read_table(file)))


def read_attitude(file: str | Path) -> Attitude:
    """Read attitudes: ``t, heading[, pitch, roll, sigma]``, s and degrees.

    Raises
    ------
    DataError
        Where the file or a value in it is wrong.
    """
    return _records(Attitude, "attitude", _open("attitude", read_table(file)))


def read_depth(file: str | Path) -> Depth:
    """Read depths: ``t, depth[, sigma]``, s and m, positive down.

    Raises
    ------
    DataError
        Where the file or a value in it is wrong.
    """
    return _records(Depth, "depth", _open("depth", read_table(file)))


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
    _open("geodetic_position" if geodetic else "position", table)
    spread: dict[str, Any] = {}
    vertical = "height" if geodetic else "up"
    if any(name in table for name in _COVARIANCE):
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
    table = _open("sound_speed", read_table(file).lower())
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


def degrees(table: Table, name: str, low: float, high: float) -> FloatArray:
    """Return a column of angles in degrees, checked.

    Parameters
    ----------
    table : Table
    name : str
    low, high : float
        What is legal, degrees.

    Returns
    -------
    array, shape (M,)

    Raises
    ------
    DataError
        Where a value is no number, not finite or not legal.
    """
    values = table.finite(name)
    outside = (values < low) | (values > high)
    if outside.any():
        i = int(np.argmax(outside))
        problem = f"{values[i]} degrees is outside {low:g} to {high:g} degrees"
        raise table.source.error(i, name, problem, "check the unit")
    return values


def _open(layout: str, table: Table) -> Table:
    """Check the names of a table's columns; return the table."""
    columns = LAYOUTS[layout]
    table.require(*columns.required)
    absent = [name for name in columns.optional if name not in table]
    for name in table.names:
        near = None if name in columns.required + columns.optional else nearest(name, absent)
        if near:
            raise DataError(
                f"unknown column '{name}'",
                f"did you mean '{near}'? rename it, or give it a name of its own",
                file=table.file,
                field=name,
            )
    return table


def _records(kind: type[AnyRecords], layout: str, table: Table, **defaults: Any) -> AnyRecords:
    columns = {
        f.name: _column(kind, layout, table, f.name) for f in fields(kind) if f.name in table
    }
    return kind(**{**defaults, **columns, "source": table.source})


def _column(kind: type[Records], layout: str, table: Table, name: str) -> Any:
    if name in kind.TEXT:
        return table.text(name)
    if name in LAYOUTS[layout].degrees:
        low, high, _ = kind.LIMITS[name]
        return np.deg2rad(degrees(table, name, float(np.rad2deg(low)), float(np.rad2deg(high))))
    return table.numbers(name)


def _turnarounds(table: Table, beacons: Sequence[Beacon]) -> FloatArray:
    """Turnaround of each row's beacon, s, shape (M,)."""
    by_name = {beacon.name: beacon.turnaround for beacon in beacons}
    names, inverse = np.unique(table.text("beacon"), return_inverse=True)
    waits = np.empty(len(names))
    for i, name in enumerate(names.tolist()):
        first = int(np.argmax(inverse == i))
        if name not in by_name:
            raise table.source.error(
                first, "beacon", f"unknown beacon '{name}'", did_you_mean(name, list(by_name))
            )
        wait = by_name[name]
        if wait is None:
            raise ConfigurationError(
                f"no travel times are given, and beacon '{name}' states no turnaround to take out "
                "of receive minus transmit time",
                f"add a column travel_time, or turnaround (s) to beacon '{name}'",
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
