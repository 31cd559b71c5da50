"""The columns of each kind of file, by name: what a file must have, and what its values are."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.errors import DataError
from ubl_graph.io.tables import Table, nearest
from ubl_graph.measurements import Odometry
from ubl_graph.records import Records

HORIZONTAL_COVARIANCE = ("cov_east_east", "cov_east_north", "cov_north_north")
VERTICAL_COVARIANCE = ("cov_east_up", "cov_north_up", "cov_up_up")
COVARIANCE = (*HORIZONTAL_COVARIANCE, *VERTICAL_COVARIANCE)

AnyRecords = TypeVar("AnyRecords", bound=Records)


@dataclass(frozen=True)
class Layout:
    """Columns of one kind of file.

    Attributes
    ----------
    required, optional : tuple of str
        Names of columns.
    degrees : tuple of str
        Those that hold degrees, or degrees per second.
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
    "slant_range": Layout(("t", "beacon", "distance"), ("sigma",)),
    "velocity": Layout(("t", "forward", "right", "down"), ("sigma", "reference")),
    "attitude": Layout(
        ("t", "heading"), ("pitch", "roll", "sigma"), ("heading", "pitch", "roll", "sigma")
    ),
    "heading": Layout(("t", "heading"), ("sigma",), ("heading", "sigma")),
    "angular_rate": Layout(
        ("t", "about_down"),
        ("about_forward", "about_right", "sigma"),
        ("about_forward", "about_right", "about_down", "sigma"),
    ),
    "odometry": Layout(
        ("t_from", "t_to", "forward", "right", "about_down"),
        (*Odometry.SPATIAL, "sigma", "sigma_turn"),
        ("about_forward", "about_right", "about_down"),
    ),
    "depth": Layout(("t", "depth"), ("sigma",)),
    "position": Layout(("t", "east", "north"), ("up", "sigma", *COVARIANCE)),
    "geodetic_position": Layout(("t", "latitude", "longitude"), ("height", "sigma", *COVARIANCE)),
    "sound_speed": Layout(("depth", "speed")),
}


#: What a file of the whole fleet calls the two ends of a range: who measured, and the other one.
ENDS = ("vehicle", "peer")
for _kind in ("two_way_range", "one_way_range", "slant_range"):
    _columns = (*ENDS, *(name for name in LAYOUTS[_kind].required if name != "beacon"))
    LAYOUTS[f"fleet_{_kind}"] = Layout(_columns, LAYOUTS[_kind].optional)


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
    return bounded(table, name, low, high, "degrees")


def bounded(table: Table, name: str, low: float, high: float, unit: str) -> FloatArray:
    """Return a column of numbers in some unit, checked; as `degrees`."""
    values = table.finite(name)
    outside = (values < low) | (values > high)
    if outside.any():
        i = int(np.argmax(outside))
        problem = f"{values[i]} {unit} is outside {low:g} to {high:g} {unit}"
        raise table.source.error(i, name, problem, "check the unit")
    return values


def opened(layout: str, table: Table) -> Table:
    """Check the names of a table's columns; return the table.

    Raises
    ------
    DataError
        Where a column is missing, or one looks like a slip for an optional one that is missing.
    """
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


def records_of(kind: type[AnyRecords], layout: str, table: Table, **defaults: Any) -> AnyRecords:
    """Make records of the columns that bear the names of their fields; `defaults` for the others.

    Raises
    ------
    DataError
        Where a value is wrong.
    """
    columns = {
        f.name: _column(kind, layout, table, f.name) for f in fields(kind) if f.name in table
    }
    return kind(**{**defaults, **columns, "source": table.source})


def _column(kind: type[Records], layout: str, table: Table, name: str) -> Any:
    if name in kind.TEXT:
        return table.text(name)
    if name in LAYOUTS[layout].degrees:
        low, high, unit = kind.LIMITS[name]
        unit = unit.replace("rad", "degrees")
        limits = float(np.rad2deg(low)), float(np.rad2deg(high))
        return np.deg2rad(bounded(table, name, *limits, unit))
    return table.numbers(name)
