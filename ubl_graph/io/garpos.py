"""Campaigns in the format of GARPOS (Watanabe et al. 2020): observations, configuration, beacons.

A GARPOS campaign is a ship that ranges to seafloor transponders while GNSS and a gyrocompass give
its antenna's track. Here the navigation is under test: the estimator gets the two-way travel times
and the transducer's depth; the ship's east and north become the reference track, which no
estimator sees.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ubl_graph.arrays import BoolArray, FloatArray, IntArray
from ubl_graph.beacon import Beacon
from ubl_graph.errors import ConfigurationError, DataError
from ubl_graph.frames import GeodeticOrigin, LeverArm, world_R_body
from ubl_graph.io.records import degrees
from ubl_graph.io.tables import Table, did_you_mean, naming, read_table, read_text, shortened
from ubl_graph.measurements import (
    MAX_DISTANCE,
    TRAVEL_TIME_SIGMA,
    Depth,
    PositionFix,
    TwoWayRange,
)
from ubl_graph.mission import Reference, Segment

#: Standard deviation of the transducer's depth, m: kinematic GNSS heave.
GARPOS_DEPTH_SIGMA = 0.05
#: The same of its east, north and up where the ship's track serves as data, m.
GARPOS_TRACK_SIGMA = (0.02, 0.02, GARPOS_DEPTH_SIGMA)
#: Options of a garpos mission where the user gives none: a surface vessel heaves.
GARPOS_OPTIONS: dict[str, Any] = {"vertical_acceleration_psd": 0.3}

_TIMES = ("ST", "RT")
_POSES = tuple(
    tuple(f"{name}{end}" for name in ("ant_e", "ant_n", "ant_u", "head", "pitch", "roll"))
    for end in "01"
)
_COLUMNS = ("SET", "LN", "MT", "TT", "flag", *_TIMES, *_POSES[0], *_POSES[1])
#: Columns of the observation file by the names that records use.
IN_FILE = {"beacon": "MT", "travel_time": "TT", "t_transmit": "ST", "t_receive": "RT"}
_FLAGS = {"true": True, "1": True, "false": False, "0": False}


@dataclass(frozen=True, eq=False)
class Campaign:
    """What a campaign's files hold.

    Attributes
    ----------
    segments : tuple of Segment
        One per survey line, named "SET/LN".
    beacons : tuple of Beacon
        Every station of the configuration and of the beacons file.
    origin : GeodeticOrigin or None
        Of the local frame, where the configuration states it.
    """

    segments: tuple[Segment, ...]
    beacons: tuple[Beacon, ...]
    origin: GeodeticOrigin | None


@dataclass(frozen=True)
class Entry:
    """Value of a key of a configuration file, and the line it stands on (from 1)."""

    value: str
    line: int


class Config:
    """Keys of a GARPOS configuration file.

    Parameters
    ----------
    file : path
        INI file; its sections carry no meaning here, as its keys are unique.

    Raises
    ------
    DataError
        Where the file cannot be read.
    """

    def __init__(self, file: str | Path) -> None:
        self.file = file
        self.entries: dict[str, Entry] = {}
        for number, text in enumerate(read_text(file).splitlines(), start=1):
            key, equals, value = text.partition("=")
            if equals and not key.lstrip().startswith(("#", ";")):
                self._add(key.strip(), Entry(value.strip(), number))

    def _add(self, key: str, entry: Entry) -> None:
        earlier = self.entries.setdefault(key, entry)
        if earlier.value.split() != entry.value.split():
            raise DataError(
                f"the key is there twice (before on line {earlier.line})",
                "keep one of the two",
                file=self.file,
                line=entry.line,
                field=key,
            )

    def __contains__(self, key: str) -> bool:
        return key in self.entries

    def numbers(self, key: str, at_least: int = 1) -> list[float]:
        """Return the numbers of a key, separated by white space.

        Raises
        ------
        DataError
            Where the key is missing, or has too few values or one that is no finite number.
        """
        entry = self.entries.get(key)
        if entry is None:
            known = did_you_mean(key, tuple(self.entries), "keys found")
            raise DataError(f"the key '{key}' is missing", known, file=self.file, field=key)
        values: list[float] = []
        for word in entry.value.split():
            try:
                values.append(float(word))
            except ValueError:
                raise self._error(key, f"{shortened(word)} is not a number") from None
        if len(values) < at_least:
            raise self._error(key, f"{len(values)} of {at_least} numbers")
        if not np.isfinite(values).all():
            raise self._error(key, "a value is not a finite number")
        return values

    def _error(self, key: str, problem: str) -> DataError:
        return DataError(problem, file=self.file, line=self.entries[key].line, field=key)

    @property
    def origin(self) -> GeodeticOrigin | None:
        """Origin of the local frame; None where the file does not state it."""
        if "Latitude0" not in self and "Longitude0" not in self:
            return None
        height = self.numbers("Height0")[0] if "Height0" in self else 0.0
        with naming(self.file):
            return GeodeticOrigin(
                self.numbers("Latitude0")[0], self.numbers("Longitude0")[0], height
            )

    @property
    def lever_arm(self) -> FloatArray:
        """From the antenna to the transducer, forward-left-up, m, shape (3,)."""
        forward, right, down = self.numbers("ATDoffset", 3)[:3]
        with naming(self.file, "ATDoffset."):
            return LeverArm(forward, right, down).body

    @property
    def beacons(self) -> dict[str, Beacon]:
        """Beacons by name: stated positions, moved by dCentPos, with their sigmas or zero."""
        shift = self.numbers("dCentPos", 3)[:3] if "dCentPos" in self else [0.0, 0.0, 0.0]
        found: dict[str, Beacon] = {}
        for key in self.entries:
            name = key.removesuffix("_dPos")
            if name == key or not name:
                continue
            values = self.numbers(key, 3)
            sigma = values[3:6] if len(values) >= 6 else 0.0
            with naming(self.file):
                found[name] = Beacon(name, np.add(values[:3], shift), sigma)
        return found


def read_garpos(
    observations: str | Path,
    config: str | Path,
    beacons: str | Path | None = None,
    lines: Sequence[str] | None = None,
    sigma: float = TRAVEL_TIME_SIGMA,
    known_track: bool = False,
) -> Campaign:
    """Read a campaign.

    Parameters
    ----------
    observations : path
        CSV, one row a ping; rows whose `flag` is true are left out, whatever they hold.
    config : path
        INI with the stations' positions and the lever arm from antenna to transducer.
    beacons : path, optional
        JSON ``{"beacons": {name: {"enu": [e, n, u], "sigma_enu": [e, n, u]}}}``, metres; takes the
        place of the configuration's position of every station that it names.
    lines : sequence of str, optional
        "SET/LN" of the lines to take, in this order; left out, all in order of appearance.
    sigma : float
        Standard deviation of a travel time, s.
    known_track : bool
        Whether the ship's track is data, for a survey of the beacons: fixes of the transducer at
        transmit and receive times take the place of its depths and of the reference.

    Returns
    -------
    Campaign

    Raises
    ------
    DataError
        Where a file or a value in it is wrong.
    ConfigurationError
        Where `lines` names a line that is not there, that holds no unflagged ping, or twice.
    """
    settings = Config(config)
    stations = settings.beacons
    if beacons is not None:
        stations |= read_beacons(beacons)
    arm = settings.lever_arm
    segments = tuple(
        _segment(name, table, arm, sigma, known_track)
        for name, table in _lines(observations, lines).items()
    )
    return Campaign(segments, tuple(stations.values()), settings.origin)


def read_beacons(file: str | Path) -> dict[str, Beacon]:
    """Read a beacons file (JSON), by name.

    Raises
    ------
    DataError
        Where the file cannot be read, is no JSON or has another structure.
    """
    text = read_text(file)
    try:
        document = json.loads(text)
    except json.JSONDecodeError as error:
        raise DataError(f"no JSON: {error.msg}", file=file, line=error.lineno) from error
    except RecursionError as error:
        raise DataError("no beacons file: nested too deeply", file=file) from error
    stations = document.get("beacons") if isinstance(document, dict) else None
    if not isinstance(stations, dict) or not stations:
        raise DataError(
            "the beacons are missing",
            'write {"beacons": {"M11": {"enu": [east, north, up]}}}',
            file=file,
            field="beacons",
        )
    found: dict[str, Beacon] = {}
    for name, station in stations.items():
        if not isinstance(station, dict) or "enu" not in station:
            raise DataError(
                "'enu' is missing",
                "write [east, north, up] in metres",
                file=file,
                record=f"beacon '{name}'",
                field="enu",
            )
        with naming(file, columns={"position": "enu", "sigma": "sigma_enu"}):
            found[name] = Beacon(name, station["enu"], station.get("sigma_enu", 0.0))
    return found


def _lines(observations: str | Path, wanted: Sequence[str] | None) -> Mapping[str, Table]:
    """Unflagged rows of the wanted lines, by the lines' names."""
    table = read_table(observations)
    table.require(*_COLUMNS)
    labels = np.array(
        [
            f"{survey}/{line}"
            for survey, line in zip(table.columns["SET"], table.columns["LN"], strict=True)
        ]
    )
    used = ~_flags(table)
    present = list(dict.fromkeys(labels[used].tolist()))
    if not present:
        raise DataError("every ping is flagged", "flag = False marks pings to use", file=table.file)
    names = present if wanted is None else list(wanted)
    for i, name in enumerate(names):
        if name in names[:i]:
            raise ConfigurationError(f"the line '{name}' is asked for twice", field="lines")
        if name not in present:
            flagged = f"every ping of the line '{name}' in {table.file} is flagged"
            unknown = f"there is no line '{name}' in {table.file}"
            raise ConfigurationError(
                flagged if name in labels else unknown,
                did_you_mean(name, present, "lines found"),
                field="lines",
            )
    return {name: table.where(used & (labels == name)) for name in names}


def _flags(table: Table) -> BoolArray:
    cells = table.columns["flag"]
    flags = [_FLAGS.get(cell.lower()) for cell in cells]
    if None in flags:
        i = flags.index(None)
        raise table.source.error(
            i, "flag", f"{shortened(cells[i])} is neither True nor False", "True: do not use"
        )
    return np.array(flags, dtype=np.bool_)


def _segment(name: str, table: Table, arm: FloatArray, sigma: float, known_track: bool) -> Segment:
    sent, heard = (table.finite(column) for column in _TIMES)
    with naming(table.file, columns=IN_FILE):
        ranges = TwoWayRange(
            table.text("MT"), sent, heard, table.finite("TT"), sigma, source=table.source
        )
    at_sent, at_heard = (_transducer(table, columns, arm) for columns in _POSES)
    if known_track:
        fixes = _fixes(table, (sent, heard), (at_sent, at_heard))
        return Segment(name=name, two_way_range=ranges, position=fixes)
    order = np.argsort(sent, kind="stable")
    return Segment(
        name=name,
        two_way_range=ranges,
        depth=_depths(table, (sent, heard), (at_sent, at_heard)),
        reference=Reference(sent[order], at_sent[order]),
    )


def _transducer(table: Table, columns: Sequence[str], arm: FloatArray) -> FloatArray:
    """Transducer positions, east, north, up, m, shape (M, 3): antenna + R lever arm."""
    antenna = np.stack([table.finite(name) for name in columns[:3]], axis=1)
    far = np.argwhere(np.abs(antenna) > MAX_DISTANCE)
    if len(far):
        row, column = far[0]
        raise table.source.error(
            int(row), columns[int(column)], f"{antenna[row, column]:g} m is no local coordinate"
        )
    angles = [np.deg2rad(degrees(table, name, -720.0, 720.0)) for name in columns[3:]]
    return antenna + world_R_body(*angles) @ arm


def _depths(
    table: Table,
    times: tuple[FloatArray, FloatArray],
    positions: tuple[FloatArray, FloatArray],
) -> Depth:
    t, position, rows = _instants(times, positions)
    return Depth(t, -position[:, 2], GARPOS_DEPTH_SIGMA, source=table.source[rows])


def _fixes(
    table: Table,
    times: tuple[FloatArray, FloatArray],
    positions: tuple[FloatArray, FloatArray],
) -> PositionFix:
    t, position, rows = _instants(times, positions)
    covariance = np.diag(np.square(GARPOS_TRACK_SIGMA))
    return PositionFix(t, *position.T, covariance=covariance, source=table.source[rows])


def _instants(
    times: tuple[FloatArray, FloatArray], positions: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Times at which the transducer's place is stated, the places (N, 3), and the table's rows.

    A reply may arrive in the instant of another ping: one time, one place.
    """
    t, first = np.unique(np.stack(times, axis=1).ravel(), return_index=True)
    return t, np.stack(positions, axis=1).reshape(-1, 3)[first], first // 2
