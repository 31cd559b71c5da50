"""Mission files: a TOML document that names data, beacons, vehicle, sound speed and options.

`mission_schema` says which keys there are. What it cannot say (values out of range, things that do
not go together) the mission's own classes check; their errors are made to name the file here and in
`mission_parts`, which fleets share. Files of several vehicles are `fleet_file`'s.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.errors import ConfigurationError
from ubl_graph.io import records
from ubl_graph.io.garpos import GARPOS_OPTIONS, IN_FILE, read_garpos
from ubl_graph.io.mission_parts import (
    beacon_of,
    check_sound_speed,
    is_fleet,
    name_of,
    origin_of,
    parsed,
    read_records,
    sound_speed_of,
    start_of,
    vehicle_of,
)
from ubl_graph.io.mission_schema import CsvDocument, GarposDocument, PyfgDocument, validated
from ubl_graph.io.pyfg import read_pyfg
from ubl_graph.io.pyfg_mission import PYFG_OPTIONS, pyfg_beacons, pyfg_node, pyfg_segments
from ubl_graph.io.tables import naming
from ubl_graph.mission import RECORD_KINDS, Mission, Segment, Setup
from ubl_graph.mission_checks import RANGE_KINDS
from ubl_graph.options import Options


def load_mission(path: str | Path, known_track: bool = False) -> Mission:
    """Read a mission file and the data files that it names.

    Parameters
    ----------
    path : path
        TOML file; docs/mission-file.md lists its keys. Relative paths in it start at its folder.
    known_track : bool
        Whether the ship's track of a garpos mission is data, for a survey of its beacons
        (`ubl_graph.survey.calibrate`), and no reference to compare with.

    Returns
    -------
    Mission

    Raises
    ------
    DataError
        Where a file cannot be read, or a value in it is wrong; it names file, row and field.
    ConfigurationError
        Where the mission file is no TOML, a key is unknown or missing, a value is of the wrong
        kind, parts of the mission do not go together, or the file is of a fleet; it names the file
        and the key.
    """
    path = Path(path)
    content = parsed(path)
    _refuse_fleet(content, path, "load_fleet reads it; `ubl-graph smooth` smooths one at a time")
    document = validated(content, path)
    if isinstance(document, GarposDocument):
        return _garpos_mission(document, path, known_track)
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
        are named, an option is left to the data, or the file is of a fleet; it names the file and
        the key.
    """
    path = Path(path)
    content = parsed(path)
    _refuse_fleet(
        content,
        path,
        "a live process is one vehicle's; FleetEstimator in Python is for several, and "
        "`ubl-graph smooth` for their recorded data",
    )
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
    check_sound_speed(
        document.sound_speed, path, needed=bool(document.beacon), why="there are beacons"
    )
    with naming(path):
        setup = Setup(**_parts(document, path))
        setup.options.require_settled()
        return setup


def _refuse_fleet(content: dict[str, Any], path: Path, remedy: str) -> None:
    if is_fleet(content):
        raise ConfigurationError(
            "the file is of a fleet, with a table [[vehicle]] for each vehicle",
            remedy,
            file=path,
            field="vehicle",
        )


def _garpos_mission(document: GarposDocument, path: Path, known_track: bool) -> Mission:
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
            known_track,
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
            name=name_of(document.mission, path),
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
            segments=pyfg_segments(graph, start_of(document.start, path)),
            beacons=pyfg_beacons(graph, options.estimate_beacons),
            sound_speed=sound_speed_of(None, path),
            vehicle=vehicle_of(document.vehicle, path),
            options=options,
            name=name_of(document.mission, path),
            origin=origin_of(document.mission.origin, path),
        )


def _csv_mission(document: CsvDocument, path: Path) -> Mission:
    _check_data(document, path)
    parts = _parts(document, path)
    rows = read_records(document.data, path, parts["beacons"], parts["options"], parts["origin"])
    segment = Segment(start=parts.pop("start"), **rows)
    with naming(path):
        return Mission(segments=(segment,), **parts)


def _parts(document: CsvDocument, path: Path) -> dict[str, Any]:
    """All but the data, by the names that `Setup` has for them."""
    origin = origin_of(document.mission.origin, path)
    beacons = tuple(beacon_of(table, origin, path) for table in document.beacon)
    with naming(path, "options."):
        options = Options(**document.options.given())
    return {
        "beacons": beacons,
        "sound_speed": sound_speed_of(document.sound_speed, path),
        "vehicle": vehicle_of(document.vehicle, path),
        "options": options,
        "start": start_of(document.start, path),
        "name": name_of(document.mission, path),
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
    check_sound_speed(document.sound_speed, path, needed=timed, why="ranges are given")
