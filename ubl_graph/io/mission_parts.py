"""What the tables of a mission file stand for, whether of one vehicle or of a fleet."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.arrays import FloatArray
from ubl_graph.beacon import Beacon
from ubl_graph.errors import ConfigurationError
from ubl_graph.frames import GeodeticOrigin, LeverArm
from ubl_graph.io import records
from ubl_graph.io.mission_schema import (
    BeaconTable,
    CsvDataTable,
    LeverArmTable,
    NamedTable,
    OriginTable,
    SoundSpeedTable,
    StartTable,
    VehicleTable,
)
from ubl_graph.io.tables import naming, read_text
from ubl_graph.mission import Start, Vehicle
from ubl_graph.options import Options
from ubl_graph.records import Records


def parsed(path: Path) -> dict[str, Any]:
    """The TOML document in a file.

    Raises
    ------
    DataError
        Where the file cannot be read.
    ConfigurationError
        Where it is no TOML; it names the line.
    """
    text = read_text(path)
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        message, _, place = str(error).partition(" (at ")
        line = re.search(r"line (\d+)", place)
        raise ConfigurationError(
            f"no TOML: {message}",
            "text stands in quotes, [table] and [[beacon]] on lines of their own",
            file=path,
            line=int(line[1]) if line else text.count("\n") + 1,
        ) from error


def is_fleet(content: dict[str, Any]) -> bool:
    """Whether a document has [[vehicle]] tables, so that it is of several vehicles."""
    return isinstance(content.get("vehicle"), list)


def holds_fleet(path: str | Path) -> bool:
    """Whether a mission file is of several vehicles: one for `load_fleet`, not `load_mission`.

    Raises
    ------
    DataError, ConfigurationError
        Where the file cannot be read, or is no TOML.
    """
    return is_fleet(parsed(Path(path)))


def name_of(table: NamedTable, path: Path) -> str:
    """The mission's name; the file's where it has none."""
    return path.stem if table.name is None else table.name


def origin_of(table: OriginTable | None, path: Path) -> GeodeticOrigin | None:
    """The key `origin` of [mission].

    Raises
    ------
    DataError
        Where a number is out of range.
    """
    if table is None:
        return None
    with naming(path, "mission.origin."):
        return GeodeticOrigin(table.latitude, table.longitude, table.height)


def beacon_of(table: BeaconTable, origin: GeodeticOrigin | None, path: Path) -> Beacon:
    """A table [[beacon]].

    Raises
    ------
    DataError, ConfigurationError
        Where a number is out of range, or the position is not three numbers of one kind.
    """
    with naming(path, "beacon.", record=f"beacon '{table.name}'"):
        position = position_of(table.position.given(), origin)
        return Beacon(table.name, position, table.sigma, table.turnaround)


def position_of(given: dict[str, float], origin: GeodeticOrigin | None) -> FloatArray | list[float]:
    """East, north, up (m) of a position that is given so, or as latitude, longitude, height.

    Raises
    ------
    ConfigurationError
        Where it is neither, or degrees lack an origin.
    DataError
        Where degrees are out of range.
    """
    if given.keys() == {"east", "north", "up"}:
        return [given[key] for key in ("east", "north", "up")]
    if given.keys() != {"latitude", "longitude", "height"}:
        raise ConfigurationError(
            f"the position has {', '.join(given) or 'no keys'}",
            "give east, north and up, or latitude, longitude and height",
            field="position",
        )
    if origin is None:
        raise ConfigurationError(
            "latitude and longitude need an origin",
            "give origin = { latitude = ..., longitude = ... } under [mission]",
            field="position",
        )
    with naming(None, "position."):
        GeodeticOrigin(given["latitude"], given["longitude"])
    return origin.to_enu(given["latitude"], given["longitude"], given["height"])[0]


def sound_speed_of(table: SoundSpeedTable | None, path: Path) -> SoundSpeedProfile:
    """The table [sound_speed], with the file that it names; 1500 m/s where there is none.

    Raises
    ------
    DataError, ConfigurationError
        Where it is not one of number and file, or one that is wrong.
    """
    if table is None:  # no travel times: never used
        return SoundSpeedProfile.constant(1500.0)
    if (table.constant is None) == (table.profile is None):
        raise ConfigurationError(
            "give either constant (m/s) or profile (a file)", file=path, field="sound_speed"
        )
    if table.profile is not None:
        return records.read_sound_speed(path.parent / table.profile)
    with naming(path, "sound_speed.", columns={"speed": "constant"}):
        return SoundSpeedProfile.constant(table.constant or 0.0)


def check_sound_speed(table: SoundSpeedTable | None, path: Path, *, needed: bool, why: str) -> None:
    """Refuse a file without [sound_speed] where it is `needed`.

    Raises
    ------
    ConfigurationError
    """
    if needed and table is None:
        raise ConfigurationError(
            f"{why}, but no sound speed",
            "add [sound_speed] with constant or profile",
            file=path,
            field="sound_speed",
        )


def start_of(
    table: StartTable | None, path: Path, within: str = "", record: str | None = None
) -> Start | None:
    """The table [start]; `within` and `record` say in errors whose it is.

    Raises
    ------
    ConfigurationError
        Where a number is out of range, or a sigma has no heading.
    """
    if table is None:
        return None
    given = table.given()
    angles = {"heading": "heading_deg", "heading_sigma": "heading_sigma_deg"}
    with naming(path, within, record=record), naming(None, "start."):
        if "heading_sigma_deg" in given and "heading_deg" not in given:
            raise ConfigurationError(
                "a sigma of no heading", "give heading_deg too", field="heading_sigma_deg"
            )
        for key, high, low in (("heading_deg", 720.0, -720.0), ("heading_sigma_deg", 180.0, 1e-6)):
            if key in given and not low <= given[key] <= high:
                raise ConfigurationError(
                    f"{given[key]} degrees is outside {low:g} to {high:g} degrees", field=key
                )
        for name, key in angles.items():
            if key in given:
                given[name] = math.radians(given.pop(key))
        return Start(**given)


def vehicle_of(table: VehicleTable, path: Path, record: str | None = None) -> Vehicle:
    """The lever arms of a table [vehicle]; `record` names it in errors.

    Raises
    ------
    DataError
        Where a number is out of range.
    """
    arms: dict[str, LeverArm] = {}
    for name in VehicleTable.model_fields:
        arm: LeverArmTable = getattr(table, name)
        with naming(path, f"vehicle.{name}.", record=record):
            arms[name] = LeverArm(arm.forward, arm.right, arm.down)
    return Vehicle(**arms)


def read_records(
    data: CsvDataTable,
    path: Path,
    beacons: Sequence[Beacon],
    options: Options,
    origin: GeodeticOrigin | None,
    others: Sequence[str] = (),
) -> dict[str, Any]:
    """Read the data files of one vehicle.

    Parameters
    ----------
    data : CsvDataTable
        Names of files.
    path : Path
        The mission file, in whose folder relative names begin.
    beacons : sequence of Beacon
        Whose turnaround is taken out where a file of pings has no travel times.
    options : Options
        With the standard deviation of travel times where a file has none.
    origin : GeodeticOrigin or None
        For positions in degrees.
    others : sequence of str
        Vehicles and targets that answer pings as well.

    Returns
    -------
    dict
        Records by kind, as `Segment` takes them.

    Raises
    ------
    DataError, ConfigurationError
        Where a file cannot be read or a value in it is wrong.
    """
    sigma = options.settled.number("travel_time_sigma")
    readers: dict[str, Callable[[Path], Records]] = {
        "two_way_range": lambda file: records.read_two_way_range(file, beacons, sigma, others),
        "one_way_range": lambda file: records.read_one_way_range(file, sigma),
        "slant_range": records.read_slant_range,
        "velocity": records.read_velocity,
        "attitude": records.read_attitude,
        "heading": records.read_heading,
        "angular_rate": records.read_angular_rate,
        "odometry": records.read_odometry,
        "depth": records.read_depth,
        "position": lambda file: records.read_position(file, origin),
    }
    named = {kind: getattr(data, kind) for kind in readers}
    return {k: readers[k](path.parent / name) for k, name in named.items() if name is not None}
