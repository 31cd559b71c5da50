"""Mission files: a TOML document that names data, beacons, vehicle, sound speed and options.

`mission_schema` says which keys there are. What it cannot say (values out of range, things that do
not go together) the mission's own classes check; their errors are made to name the file here.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.arrays import FloatArray
from ubl_graph.beacon import Beacon
from ubl_graph.errors import ConfigurationError
from ubl_graph.frames import GeodeticOrigin, LeverArm
from ubl_graph.io import records
from ubl_graph.io.garpos import GARPOS_OPTIONS, IN_FILE, read_garpos
from ubl_graph.io.mission_schema import (
    BeaconTable,
    CsvDataTable,
    CsvDocument,
    GarposDocument,
    LeverArmTable,
    NamedTable,
    OriginTable,
    PyfgDocument,
    SoundSpeedTable,
    StartTable,
    VehicleTable,
    validated,
)
from ubl_graph.io.pyfg import read_pyfg
from ubl_graph.io.pyfg_mission import PYFG_OPTIONS, pyfg_beacons, pyfg_node, pyfg_segments
from ubl_graph.io.tables import naming, read_text
from ubl_graph.mission import RECORD_KINDS, Mission, Segment, Setup, Start, Vehicle
from ubl_graph.mission_checks import RANGE_KINDS
from ubl_graph.options import Options
from ubl_graph.records import Records


def load_mission(path: str | Path) -> Mission:
    """Read a mission file and the data files that it names.

    Parameters
    ----------
    path : path
        TOML file; docs/mission-file.md lists its keys. Relative paths in it start at its folder.

    Returns
    -------
    Mission

    Raises
    ------
    DataError
        Where a file cannot be read, or a value in it is wrong; it names file, row and field.
    ConfigurationError
        Where the mission file is no TOML, a key is unknown or missing, a value is of the wrong
        kind, or parts of the mission do not go together; it names the file and the key.
    """
    path = Path(path)
    document = validated(_parsed(path), path)
    if isinstance(document, GarposDocument):
        return _garpos_mission(document, path)
    if isinstance(document, PyfgDocument):
        return _pyfg_mission(document, path)
    return _csv_mission(document, path)


def load_setup(path: str | Path) -> Setup:
    """Read the configuration of a live process: a mission file without data.

    Parameters
    ----------
    path : path
        TOML file; its tables are those of a mission file, but for [data]. Relative paths in it
        start at its folder.

    Returns
    -------
    Setup

    Raises
    ------
    DataError
        Where a file cannot be read, or a value in it is wrong; it names file and field.
    ConfigurationError
        Where the file is no TOML, a key is unknown or missing, a value is of the wrong kind, data
        are named, or an option is left to the data; it names the file and the key.
    """
    path = Path(path)
    content = _parsed(path)
    if "data" in content:
        raise ConfigurationError(
            "the configuration of a live process has no data",
            "leave [data] out; `ubl-graph smooth` takes files with data, and scripts/replay.py "
            "replays them",
            file=path,
            field="data",
        )
    document = validated(content, path)
    assert isinstance(document, CsvDocument)
    _check_sound_speed(document, path, needed=bool(document.beacon), why="there are beacons")
    with naming(path):
        setup = Setup(**_parts(document, path))
        setup.options.require_settled()
        return setup


def _parsed(path: Path) -> dict[str, Any]:
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


def _garpos_mission(document: GarposDocument, path: Path) -> Mission:
    data, folder = document.data, path.parent
    with naming(path, "options."):
        options = Options(**{**GARPOS_OPTIONS, **document.options.given()})
    with naming(path, "data."):
        campaign = read_garpos(
            folder / data.observations,
            folder / data.config,
            None if data.beacons is None else folder / data.beacons,
            data.lines,
            options.settled.number("travel_time_sigma"),
        )
    if isinstance(data.sound_speed, str):
        profile = records.read_sound_speed(folder / data.sound_speed)
    else:
        with naming(path, "data.", columns={"speed": "sound_speed"}):
            profile = SoundSpeedProfile.constant(data.sound_speed)
    with naming(path, columns=IN_FILE):
        return Mission(
            segments=campaign.segments,
            beacons=campaign.beacons,
            sound_speed=profile,
            options=options,
            name=_name(document.mission, path),
            origin=campaign.origin,
        )


def _pyfg_mission(document: PyfgDocument, path: Path) -> Mission:
    graph = read_pyfg(path.parent / document.data.file)
    node, given = pyfg_node(graph), document.options.given()
    if given.get("node", node) != node:
        raise ConfigurationError(
            f"'{given['node']}' does not go with the poses of {graph.file}, which are of {node}",
            "leave node out: it is taken from the file",
            file=path,
            field="options.node",
        )
    chosen: dict[str, Any] = {**PYFG_OPTIONS, "node": node, **given}
    with naming(path, "options."):
        options = Options(**chosen)
    with naming(path):
        return Mission(
            segments=pyfg_segments(graph, _start(document.start, path)),
            beacons=pyfg_beacons(graph, options.estimate_beacons),
            sound_speed=_sound_speed(None, path),
            vehicle=_vehicle(document.vehicle, path),
            options=options,
            name=_name(document.mission, path),
            origin=_origin(document.mission.origin, path),
        )


def _csv_mission(document: CsvDocument, path: Path) -> Mission:
    _check_data(document, path)
    parts = _parts(document, path)
    rows = _read_records(document.data, path, parts["beacons"], parts["options"], parts["origin"])
    segment = Segment(start=parts.pop("start"), **rows)
    with naming(path):
        return Mission(segments=(segment,), **parts)


def _parts(document: CsvDocument, path: Path) -> dict[str, Any]:
    """All but the data, by the names that `Setup` has for them."""
    origin = _origin(document.mission.origin, path)
    beacons = tuple(_beacon(table, origin, path) for table in document.beacon)
    with naming(path, "options."):
        options = Options(**document.options.given())
    return {
        "beacons": beacons,
        "sound_speed": _sound_speed(document.sound_speed, path),
        "vehicle": _vehicle(document.vehicle, path),
        "options": options,
        "start": _start(document.start, path),
        "name": _name(document.mission, path),
        "origin": origin,
    }


def _check_data(document: CsvDocument, path: Path) -> None:
    """Refuse a mission that lacks a part, before any file is read."""
    given = document.data.given().keys() & RECORD_KINDS.keys()
    ranges = bool(given & set(RANGE_KINDS))
    timed = bool(given & set(RANGE_KINDS) - {"slant_range"})
    if not given:
        raise ConfigurationError(
            "no data file is named", f"known: {', '.join(RECORD_KINDS)}", file=path, field="data"
        )
    if ranges and not document.beacon:
        raise ConfigurationError(
            "ranges are given, but no beacon",
            "add [[beacon]] with name and position",
            file=path,
            field="beacon",
        )
    _check_sound_speed(document, path, needed=timed, why="ranges are given")


def _check_sound_speed(document: CsvDocument, path: Path, *, needed: bool, why: str) -> None:
    if needed and document.sound_speed is None:
        raise ConfigurationError(
            f"{why}, but no sound speed",
            "add [sound_speed] with constant or profile",
            file=path,
            field="sound_speed",
        )


def _read_records(
    data: CsvDataTable,
    path: Path,
    beacons: tuple[Beacon, ...],
    options: Options,
    origin: GeodeticOrigin | None,
) -> dict[str, Any]:
    sigma = options.settled.number("travel_time_sigma")
    readers: dict[str, Callable[[Path], Records]] = {
        "two_way_range": lambda file: records.read_two_way_range(file, beacons, sigma),
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


def _name(table: NamedTable, path: Path) -> str:
    return path.stem if table.name is None else table.name


def _origin(table: OriginTable | None, path: Path) -> GeodeticOrigin | None:
    if table is None:
        return None
    with naming(path, "mission.origin."):
        return GeodeticOrigin(table.latitude, table.longitude, table.height)


def _beacon(table: BeaconTable, origin: GeodeticOrigin | None, path: Path) -> Beacon:
    with naming(path, "beacon.", record=f"beacon '{table.name}'"):
        position = _position(table.position.given(), origin)
        return Beacon(table.name, position, table.sigma, table.turnaround)


def _position(given: dict[str, float], origin: GeodeticOrigin | None) -> FloatArray | list[float]:
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


def _sound_speed(table: SoundSpeedTable | None, path: Path) -> SoundSpeedProfile:
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


def _start(table: StartTable | None, path: Path) -> Start | None:
    if table is None:
        return None
    given = table.given()
    angles = {"heading": "heading_deg", "heading_sigma": "heading_sigma_deg"}
    with naming(path, "start."):
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


def _vehicle(table: VehicleTable, path: Path) -> Vehicle:
    arms: dict[str, LeverArm] = {}
    for name in type(table).model_fields:
        arm: LeverArmTable = getattr(table, name)
        with naming(path, f"vehicle.{name}."):
            arms[name] = LeverArm(arm.forward, arm.right, arm.down)
    return Vehicle(**arms)
