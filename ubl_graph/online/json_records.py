"""Measurement records as JSON objects, one record an object: which keys they have, there and back.

A key bears the name of the record's field and holds SI units, but for angles, which are degrees.
Keys of other names are refused, since a silently ignored `sgima` is a wrong result.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from ubl_graph.errors import DataError
from ubl_graph.io.tables import did_you_mean, shortened
from ubl_graph.measurements import (
    MAX_DISTANCE,
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
from ubl_graph.mission import RECORD_KINDS, Setup, Start
from ubl_graph.records import MAX_TIME, Records

if TYPE_CHECKING:
    from ubl_graph.beacon import Beacon


@dataclass(frozen=True)
class Form:
    """Keys of one type of record.

    Attributes
    ----------
    required, optional : tuple of str
        Names of keys beside `type`.
    """

    required: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()

    @property
    def keys(self) -> tuple[str, ...]:
        """All of them."""
        return self.required + self.optional


_GEODETIC = Form(("t", "latitude", "longitude"), ("height", "sigma"))

#: The types of records and their keys. A position may have `latitude` and its kin instead.
FORMS: dict[str, Form] = {
    "two_way_range": Form(("beacon", "t_transmit", "t_receive"), ("travel_time", "sigma")),
    "one_way_range": Form(("beacon", "t_transmit", "t_receive"), ("sigma",)),
    "slant_range": Form(("t", "beacon", "distance"), ("sigma",)),
    "velocity": Form(("t", "forward", "right", "down"), ("sigma", "reference")),
    "attitude": Form(("t", "heading"), ("pitch", "roll", "sigma")),
    "heading": Form(("t", "heading"), ("sigma",)),
    "angular_rate": Form(("t", "about_down"), ("about_forward", "about_right", "sigma")),
    "odometry": Form(
        ("t_from", "t_to", "forward", "right", "about_down"),
        (*Odometry.SPATIAL, "sigma", "sigma_turn"),
    ),
    "depth": Form(("t", "depth"), ("sigma",)),
    "position": Form(("t", "east", "north"), ("up", "sigma")),
    "query": Form((), ("t",)),
    "health": Form(),
    "reset": Form(),
    "set_position": Form(("t", "east", "north"), ("up", "sigma", "heading", "heading_sigma")),
}
_WORDS = frozenset({"type", "beacon", "reference"})
#: Columns that are angles, or angles per second, by kind of record.
_ANGLES: dict[type[Records], tuple[str, ...]] = {
    Attitude: ("heading", "pitch", "roll", "sigma"),
    Heading: ("heading", "sigma"),
    AngularRate: ("about_forward", "about_right", "about_down", "sigma"),
    Odometry: ("about_forward", "about_right", "about_down"),
}


def kind_of(content: dict[str, Any]) -> str:
    """Return the type of a record, of which the keys are checked.

    Parameters
    ----------
    content : dict

    Returns
    -------
    str
        A key of `FORMS`.

    Raises
    ------
    DataError
        Where the type is missing or unknown, a key of it is missing, or there is another key.
    """
    if "type" not in content:
        raise DataError("the key is missing", f"known: {', '.join(FORMS)}", field="type")
    kind = content["type"]
    if not isinstance(kind, str) or kind not in FORMS:
        raise DataError(
            f"{shown(kind)} is no type of record",
            did_you_mean(kind if isinstance(kind, str) else "", tuple(FORMS)),
            field="type",
        )
    _check_keys(kind, content)
    return kind


def record_of(kind: str, content: dict[str, Any], setup: Setup) -> Records | None:
    """Make the measurement record that an object describes.

    Parameters
    ----------
    kind : str
        Its type, as `kind_of` returns it.
    content : dict
        The object.
    setup : Setup
        Says which beacons there are, their turnarounds, the default sigma of travel times, and
        where latitudes count from.

    Returns
    -------
    Records or None
        One row; None where the type is none of a measurement.

    Raises
    ------
    DataError
        Where a value is of the wrong kind, not finite, or absurd; it names the key.
    """
    return _MEASUREMENTS[kind](content, setup) if kind in _MEASUREMENTS else None


def _check_keys(kind: str, content: dict[str, Any]) -> None:
    form = FORMS[kind]
    if kind == "position" and "east" not in content and {"latitude", "longitude"} & content.keys():
        form = _GEODETIC
    unknown = [key for key in content if key not in form.keys and key != "type"]
    if unknown:
        known = FORMS[kind].keys + (_GEODETIC.keys[1:4] if kind == "position" else ())
        if unknown[0] in known:
            raise DataError(
                f"'{unknown[0]}' does not go with '{form.required[1]}'",
                f"known here: {', '.join(form.keys)}",
                field=unknown[0],
            )
        raise DataError(
            f"unknown key {shortened(unknown[0])}",
            did_you_mean(unknown[0], [key for key in known if key not in content]),
        )
    for key in form.required:
        if key not in content:
            raise DataError("the key is missing", f"{kind} has {', '.join(form.keys)}", field=key)


def shown(value: object) -> str:
    """Show a value of a JSON object in a message: its beginning, and null, true, NaN as in JSON."""
    if isinstance(value, (dict, list)):
        return "an object" if isinstance(value, dict) else "a list"
    if isinstance(value, str):
        return shortened(value)
    text = json.dumps(value)
    return text if len(text) <= 40 else text[:37] + "..."


def numbers_of(content: dict[str, Any]) -> dict[str, Any]:
    """Return the numbers of an object by key.

    Parameters
    ----------
    content : dict

    Returns
    -------
    dict of str to float

    Raises
    ------
    DataError
        Where one is no number, or not finite, or a time that is none; it names the key.
    """
    return {name: _number(content, name) for name in content if name not in _WORDS}


def _number(content: dict[str, Any], name: str) -> float:
    value = content[name]
    if type(value) not in (int, float):
        remedy = "leave the key out where there is none" if value is None else ""
        raise DataError(f"{shown(value)} is not a number", remedy, field=name)
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise DataError(f"{shown(value)} is not a finite number", field=name)
    if (name == "t" or name.startswith("t_")) and abs(number) > MAX_TIME:
        raise DataError(f"{number} s is no time in seconds", "check the unit", field=name)
    return number


def _between(values: dict[str, float], name: str, low: float, high: float, unit: str) -> None:
    if name in values and not low <= values[name] <= high:
        raise DataError(
            f"{values[name]} {unit} is outside {low:g} to {high:g} {unit}",
            "check the unit",
            field=name,
        )


def _beacon(content: dict[str, Any], setup: Setup) -> Beacon:
    # Compared as they stand: numpy's texts would lose a zero byte at their end.
    name = content["beacon"]
    for beacon in setup.beacons:
        if beacon.name == name:
            return beacon
    if not isinstance(name, str):
        raise DataError(f"{shown(name)} is no beacon's name", field="beacon")
    raise DataError(
        f"unknown beacon {shortened(name)}",
        did_you_mean(name, [b.name for b in setup.beacons]),
        field="beacon",
    )


def _two_way_range(content: dict[str, Any], setup: Setup) -> TwoWayRange:
    beacon = _beacon(content, setup)
    sigma = setup.options.number("travel_time_sigma")
    values: dict[str, Any] = {"sigma": sigma, **numbers_of(content)}
    if "travel_time" in values:
        return TwoWayRange(beacon.name, **values)
    if beacon.turnaround is None:
        raise DataError(
            f"no travel time, and beacon '{beacon.name}' states no turnaround to take out of "
            "receive minus transmit time",
            "give travel_time, or the beacon's turnaround in the configuration",
            field="travel_time",
        )
    return TwoWayRange.from_turnaround(beacon.name, turnaround=beacon.turnaround, **values)


def _one_way_range(content: dict[str, Any], setup: Setup) -> OneWayRange:
    sigma = setup.options.number("travel_time_sigma")
    values: dict[str, Any] = {"sigma": sigma, **numbers_of(content)}
    return OneWayRange(_beacon(content, setup).name, **values)


def _velocity(content: dict[str, Any], setup: Setup) -> Velocity:  # noqa: ARG001 - one form for all
    reference = content.get("reference", "bottom")
    if reference not in ("bottom", "water"):
        raise DataError(
            f"{shown(reference)} is neither 'bottom' nor 'water'",
            "say which of the two",
            field="reference",
        )
    return Velocity(**numbers_of(content), reference=reference)


def _slant_range(content: dict[str, Any], setup: Setup) -> SlantRange:
    return SlantRange(beacon=_beacon(content, setup).name, **numbers_of(content))


def _in_radians(kind: type[Records], content: dict[str, Any]) -> dict[str, Any]:
    """Numbers of an object whose angles are degrees, in SI."""
    values = numbers_of(content)
    for name in _ANGLES[kind]:
        if name in values:
            low, high, unit = kind.LIMITS[name]
            unit = unit.replace("rad", "degrees")
            _between(values, name, math.degrees(low), math.degrees(high), unit)
            values[name] = math.radians(values[name])
    return values


def heading_of(values: dict[str, Any]) -> dict[str, float]:
    """Take a heading and its sigma, degrees, out of the numbers of a position that was set.

    Parameters
    ----------
    values : dict
        By key; the two are taken out.

    Returns
    -------
    dict of str to float
        The two in radians, as far as they are there.

    Raises
    ------
    DataError
        Where one is out of its limits, or the sigma stands alone; it names the key.
    """
    limits = {"heading": (-720.0, 720.0), "heading_sigma": (1e-6, 180.0)}
    taken = {name: values.pop(name) for name in limits if name in values}
    for name, bounds in limits.items():
        _between(taken, name, *bounds, "degrees")
    if "heading" not in taken and taken:
        raise DataError("the sigma of no heading", "give the heading, too", field="heading_sigma")
    return {name: math.radians(value) for name, value in taken.items()}


def _attitude(content: dict[str, Any], setup: Setup) -> Attitude:  # noqa: ARG001 - one form for all
    return Attitude(**_in_radians(Attitude, content))


def _heading(content: dict[str, Any], setup: Setup) -> Heading:  # noqa: ARG001 - one form for all
    return Heading(**_in_radians(Heading, content))


def _angular_rate(content: dict[str, Any], setup: Setup) -> AngularRate:  # noqa: ARG001 - one form for all
    return AngularRate(**_in_radians(AngularRate, content))


def _odometry(content: dict[str, Any], setup: Setup) -> Odometry:  # noqa: ARG001 - one form for all
    values = _in_radians(Odometry, content)
    planar = not any(name in values for name in Odometry.SPATIAL)
    if not planar:
        values.update({name: values.get(name, 0.0) for name in Odometry.SPATIAL})
    limits = {"sigma": (1e4, "m"), "sigma_turn": (180.0, "degrees")}
    if limits.keys() & values.keys():
        for name, (high, unit) in limits.items():
            if name not in values:
                raise DataError(
                    "the key is missing", "sigma and sigma_turn stand together", field=name
                )
            _between(values, name, 1e-6, high, unit)
        way, turn = (values.pop(name) for name in limits)
        values["covariance"] = odometry_covariance(way, math.radians(turn), 2 if planar else 3)
    return Odometry(**values)


def _depth(content: dict[str, Any], setup: Setup) -> Depth:  # noqa: ARG001 - one form for all
    return Depth(**numbers_of(content))


def _position(content: dict[str, Any], setup: Setup) -> PositionFix:
    values = numbers_of(content)
    if "east" in values:
        return PositionFix(**values)
    if setup.origin is None:
        raise DataError(
            "latitudes and longitudes need an origin",
            "give origin = { latitude = ..., longitude = ... } under [mission] in the "
            "configuration, or east and north",
            field="latitude",
        )
    limits = {"latitude": 90.0, "longitude": 360.0}
    for name, limit in limits.items():
        _between(values, name, -limit, limit, "degrees")
    _between(values, "height", -MAX_DISTANCE, MAX_DISTANCE, "m")
    has_height = "height" in values
    place = values.pop("latitude"), values.pop("longitude")
    height = values.pop("height", setup.origin.height)
    east, north, up = setup.origin.to_enu(*place, height)[0].tolist()
    return PositionFix(east=east, north=north, up=up if has_height else None, **values)


_MEASUREMENTS: dict[str, Callable[[dict[str, Any], Setup], Records]] = {
    "two_way_range": _two_way_range,
    "one_way_range": _one_way_range,
    "slant_range": _slant_range,
    "velocity": _velocity,
    "attitude": _attitude,
    "heading": _heading,
    "angular_rate": _angular_rate,
    "odometry": _odometry,
    "depth": _depth,
    "position": _position,
}
_TYPES: dict[type[Records], str] = {made: kind for kind, (made, _) in RECORD_KINDS.items()}


def record_content(record: Records | Start) -> dict[str, Any]:
    """Put a record in the words of the protocol, as a client would send it.

    Parameters
    ----------
    record : Records or Start
        One row, or a position that was set by hand or by the configuration.

    Returns
    -------
    dict
        `type` and the keys of that type; angles in degrees. A fix that has a covariance matrix
        shows it as `covariance`, m^2, row by row; so does odometry (m^2, m rad, rad^2), unless
        `sigma` and `sigma_turn` say all of it.
    """
    if isinstance(record, Start):
        stated: dict[str, Any] = {"type": "set_position", **asdict(record)}
        heading, sigma = stated.pop("heading"), stated.pop("heading_sigma")
        if heading is not None:
            stated["heading"], stated["heading_sigma"] = math.degrees(heading), math.degrees(sigma)
        return {key: value for key, value in stated.items() if value is not None}
    content: dict[str, Any] = {"type": _TYPES[type(record)]}
    for f in fields(record):
        value = getattr(record, f.name)
        if f.name == "source" or value is None:
            continue
        if f.name in _ANGLES.get(type(record), ()):
            value = np.rad2deg(value)
        content[f.name] = value[0].tolist()
    if "covariance" in content:
        content.pop("sigma", None)
    if isinstance(record, Odometry) and record.covariance is not None:
        ways, sigmas = record.dimension, np.sqrt(np.diagonal(record.covariance[0]))
        way, turn = float(sigmas[0]), float(sigmas[-1])
        if np.array_equal(odometry_covariance(way, turn, ways), record.covariance):
            del content["covariance"]
            content["sigma"], content["sigma_turn"] = way, math.degrees(turn)
    return content
