"""Mission files of several vehicles: from [[vehicle]] and [[target]] tables to a `Fleet`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.beacon import Beacon
from ubl_graph.cooperative.fleet import Fleet, Member, Target
from ubl_graph.errors import ConfigurationError, DataError
from ubl_graph.frames import GeodeticOrigin
from ubl_graph.io.columns import ENDS, opened, records_of
from ubl_graph.io.fleet_schema import FleetDocument, MemberTable, TargetTable, validated_fleet
from ubl_graph.io.mission_parts import (
    beacon_of,
    check_sound_speed,
    is_fleet,
    name_of,
    origin_of,
    parsed,
    position_of,
    read_records,
    sound_speed_of,
    start_of,
    vehicle_of,
)
from ubl_graph.io.records import two_way_ranges
from ubl_graph.io.tables import Table, did_you_mean, naming, read_table
from ubl_graph.measurements import OneWayRange, SlantRange
from ubl_graph.mission_checks import RANGE_KINDS
from ubl_graph.options import Options
from ubl_graph.pings import Pings
from ubl_graph.records import Source
from ubl_graph.segment import RECORD_KINDS, Segment


def load_fleet(path: str | Path) -> Fleet:
    """Read a mission file of several vehicles and the data files that it names.

    Parameters
    ----------
    path : path
        TOML file; docs/fleet.md lists its keys. Relative paths in it start at its folder.

    Returns
    -------
    Fleet

    Raises
    ------
    DataError
        Where a file cannot be read, or a value in it is wrong; it names file, row and field.
    ConfigurationError
        Where the mission file is no TOML, a key is unknown or missing, a value is of the wrong
        kind, parts of the fleet do not go together, or the file is of one vehicle; it names the
        file and the key.
    """
    path = Path(path)
    content = parsed(path)
    if not is_fleet(content):
        raise ConfigurationError(
            "the file has no [[vehicle]] tables, so it is of one vehicle",
            "load_mission reads it; each vehicle of a fleet has a table [[vehicle]]",
            file=path,
            field="vehicle",
        )
    document = validated_fleet(content, path)
    _check_names(document, path)
    _check_data(document, path)
    origin = origin_of(document.mission.origin, path)
    beacons = tuple(beacon_of(table, origin, path) for table in document.beacon)
    with naming(path, "options."):
        options = Options(**document.options.given())
        options.require_settled()
    members = [_member(table, document, path, beacons, origin) for table in document.vehicle]
    targets = tuple(_target(table, origin, path) for table in document.target)
    for kind in RANGE_KINDS:
        file = getattr(document.data, kind)
        if file is not None:
            members = _with_ranges(members, kind, path.parent / file, beacons, targets)
    with naming(path):
        return Fleet(
            vehicles=tuple(members),
            beacons=beacons,
            targets=targets,
            sound_speed=sound_speed_of(document.sound_speed, path),
            options=options,
            name=name_of(document.mission, path),
            origin=origin,
        )


def _check_names(document: FleetDocument, path: Path) -> None:
    """Refuse names by which files could not tell vehicles, beacons and targets apart."""
    taken: set[str] = set()
    tables = {"vehicle": document.vehicle, "beacon": document.beacon, "target": document.target}
    for kind, name in ((kind, table.name) for kind, some in tables.items() for table in some):
        if not name or name in taken:
            raise ConfigurationError(
                f"the name '{name}' is there twice" if name else "the name is empty",
                "vehicles, beacons and targets are told apart by their names",
                file=path,
                field=f"{kind}.name",
            )
        taken.add(name)


def _check_data(document: FleetDocument, path: Path) -> None:
    """Refuse a fleet that lacks a part, before any file is read."""
    given = {kind for kind in RANGE_KINDS if getattr(document.data, kind) is not None}
    for table in document.vehicle:
        given |= table.data.given().keys() & RECORD_KINDS.keys()
    if not given:
        raise ConfigurationError(
            "no data file is named",
            "name each vehicle's own under [vehicle.data], ranges of all under [data]",
            file=path,
            field="data",
        )
    timed = bool(given & set(RANGE_KINDS) - {"slant_range"})
    check_sound_speed(document.sound_speed, path, needed=timed, why="ranges are given")


def _member(
    table: MemberTable,
    document: FleetDocument,
    path: Path,
    beacons: Sequence[Beacon],
    origin: GeodeticOrigin | None,
) -> Member:
    label = f"vehicle '{table.name}'"
    with naming(path, "vehicle.", record=label), naming(None, "options."):
        options = Options(**(document.options.given() | table.options.given()))
        options.require_settled()
    others = [t.name for tables in (document.vehicle, document.target) for t in tables]
    rows = read_records(table.data, path, beacons, options, origin, others)
    start = start_of(table.start, path, "vehicle.", label)
    vehicle = vehicle_of(table, path, label)
    return Member(table.name, Segment(start=start, **rows), vehicle, options)


def _target(table: TargetTable, origin: GeodeticOrigin | None, path: Path) -> Target:
    with naming(path, "target.", record=f"target '{table.name}'"):
        given = table.given()
        if table.position is not None:
            given["position"] = position_of(table.position.given(), origin)
        return Target(**given)


def _with_ranges(
    members: Sequence[Member],
    kind: str,
    file: Path,
    beacons: Sequence[Beacon],
    targets: Sequence[Target],
) -> list[Member]:
    """The members with their rows of a file of ranges of the whole fleet."""
    table = opened(f"fleet_{kind}", read_table(file))
    who = table.text(ENDS[0])
    names = [member.name for member in members]
    unknown = ~np.isin(who, np.array(names, dtype=np.str_))
    if unknown.any():
        i = int(np.argmax(unknown))
        name = str(who[i])
        raise table.source.error(i, ENDS[0], f"unknown vehicle '{name}'", did_you_mean(name, names))
    sigma = np.empty(len(table))
    for member in members:
        sigma[who == member.name] = member.options.number("travel_time_sigma")
    others = [*names, *(target.name for target in targets)]
    pings = _pooled(kind, table, sigma, beacons, others)
    return [_with_rows(member, kind, pings[who == member.name]) for member in members]


def _pooled(
    kind: str, table: Table, sigma: FloatArray, beacons: Sequence[Beacon], others: Sequence[str]
) -> Pings:
    """The ranges of a table in which the column `peer` names the other end."""
    columns = {name: cells for name, cells in table.columns.items() if name != "beacon"}
    columns["beacon"] = columns.pop(ENDS[1])
    source = _PooledSource(table.source.file, table.source.row, table.source.line)
    ranges = Table(columns, source)
    readers: dict[str, Callable[[], Pings]] = {
        "two_way_range": lambda: two_way_ranges(ranges, beacons, sigma, others),
        "one_way_range": lambda: records_of(OneWayRange, kind, ranges, sigma=sigma),
        "slant_range": lambda: records_of(SlantRange, kind, ranges),
    }
    return readers[kind]()


def _with_rows(member: Member, kind: str, rows: Pings) -> Member:
    """A member with further ranges of one kind."""
    if not len(rows):
        return member
    own = getattr(member.segment, kind)
    every = rows if own is None else _joined(own, rows)
    return replace(member, segment=replace(member.segment, **{kind: every}))


def _joined(first: Pings, second: Pings) -> Any:
    """Ranges of one kind from two files, each row with its place."""
    columns: dict[str, Any] = {
        f.name: np.concatenate([getattr(first, f.name), getattr(second, f.name)])
        for f in fields(first)
        if f.name != "source"
    }
    assert first.source is not None
    assert second.source is not None
    return type(first)(**columns, source=_JoinedSource.of(first.source, second.source))


@dataclass(frozen=True)
class _PooledSource(Source):
    """Rows of a file that calls the other end of a range by a name of its own."""

    def __getitem__(self, index: Any) -> Source:
        return _PooledSource(self.file, self.row[index], self.line[index])

    def error(self, index: int, field: str | None, problem: str, remedy: str = "") -> DataError:
        field = ENDS[1] if field == "beacon" else field
        return super().error(index, field, problem, remedy)


@dataclass(frozen=True)
class _JoinedSource(Source):
    """Rows of two files, one after the other.

    Attributes
    ----------
    parts : tuple of Source
        One a file.
    part, within : array, shape (M,)
        Of each row, its file's number in `parts` and its own number there.
    """

    parts: tuple[Source, ...]
    part: IntArray
    within: IntArray

    @classmethod
    def of(cls, *parts: Source) -> Source:
        sizes = [len(part.row) for part in parts]
        return cls(
            ", ".join(part.file for part in parts),
            np.concatenate([part.row for part in parts]),
            np.concatenate([part.line for part in parts]),
            parts,
            np.repeat(np.arange(len(parts)), sizes),
            np.concatenate([np.arange(size) for size in sizes]),
        )

    def __getitem__(self, index: Any) -> Source:
        return replace(
            self,
            row=self.row[index],
            line=self.line[index],
            part=self.part[index],
            within=self.within[index],
        )

    def error(self, index: int, field: str | None, problem: str, remedy: str = "") -> DataError:
        part = self.parts[int(self.part[index])]
        return part.error(int(self.within[index]), field, problem, remedy)
