"""The keys of a mission file, and what to say where a document has others.

Unknown keys are refused, and text never becomes a number. Only modules that read mission files
import this one, so that no other user pays for pydantic.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_type_hints

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    create_model,
)

from ubl_graph.errors import ConfigurationError
from ubl_graph.io.tables import did_you_mean, shortened
from ubl_graph.options import Options

_STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


def one_or_three(value: object) -> object:
    """Let a number or a list of three pass; for `BeforeValidator`."""
    numbers = value if isinstance(value, list) else [value]
    if len(numbers) not in (1, 3) or not all(type(n) in (int, float) for n in numbers):
        raise ValueError(f"{shortened(value)} is neither a number nor [east, north, up]")
    return value


def _number_or_file(value: object) -> object:
    if type(value) not in (int, float, str):
        raise ValueError(f"{shortened(value)} is neither a number (m/s) nor a file name")
    return value


class Table(BaseModel):
    """A table of which every key is known and every value of its kind."""

    model_config = _STRICT

    def given(self) -> dict[str, Any]:
        """Return the keys that stand in the file."""
        return self.model_dump(exclude_unset=True)


class OriginTable(Table):
    """The key `origin` of [mission]: degrees and metres."""

    latitude: float
    longitude: float
    height: float = 0.0


class NamedTable(Table):
    """[mission] where the data state the origin."""

    name: str | None = None


class MissionTable(NamedTable):
    """[mission] where the data do not state the origin."""

    origin: OriginTable | None = None


class PositionTable(Table):
    """Three of these, metres or degrees; `mission_parts` checks which."""

    east: float | None = None
    north: float | None = None
    up: float | None = None
    latitude: float | None = None
    longitude: float | None = None
    height: float | None = None


class BeaconTable(Table):
    """[[beacon]]: position and sigma in metres, turnaround in seconds."""

    name: str
    position: PositionTable
    sigma: Annotated[Any, BeforeValidator(one_or_three)] = 0.0
    turnaround: float | None = None


class SoundSpeedTable(Table):
    """[sound_speed]: m/s or a file; `mission_parts` checks that it is one of them."""

    constant: float | None = None
    profile: str | None = None


class LeverArmTable(Table):
    """A sensor's place on the vehicle, metres."""

    forward: float = 0.0
    right: float = 0.0
    down: float = 0.0


class VehicleTable(Table):
    """[vehicle]: lever arms."""

    transducer: LeverArmTable = LeverArmTable()
    dvl: LeverArmTable = LeverArmTable()
    depth_sensor: LeverArmTable = LeverArmTable()
    antenna: LeverArmTable = LeverArmTable()


class StartTable(Table):
    """[start]: seconds and metres; degrees where the key says so."""

    t: float
    east: float
    north: float
    up: float | None = None
    sigma: float | None = None
    heading_deg: float | None = None
    heading_sigma_deg: float | None = None


class CsvDataTable(Table):
    """[data] of a vehicle of one's own: file names."""

    format: Literal["csv"] = "csv"
    two_way_range: str | None = None
    one_way_range: str | None = None
    slant_range: str | None = None
    velocity: str | None = None
    attitude: str | None = None
    heading: str | None = None
    angular_rate: str | None = None
    odometry: str | None = None
    depth: str | None = None
    position: str | None = None


class GarposDataTable(Table):
    """[data] of a GARPOS campaign: file names, and a speed or file name."""

    format: Literal["garpos"]
    observations: str
    config: str
    sound_speed: Annotated[Any, BeforeValidator(_number_or_file)]
    beacons: str | None = None
    lines: Annotated[list[str], Field(min_length=1)] | None = None


class PyfgDataTable(Table):
    """[data] in a PyFG file: its name."""

    format: Literal["pyfg"]
    file: str


def options_model(without: Sequence[str] = ()) -> Any:
    """[options]: its keys are the fields of Options, which stand there alone, but for some."""
    kinds = get_type_hints(Options)
    keys: dict[str, Any] = {
        f.name: (kinds[f.name], f.default) for f in fields(Options) if f.name not in without
    }
    return create_model("_Options", __base__=Table, **keys)


OptionsTable = options_model()


class CsvDocument(Table):
    """A mission file with data in CSV files, one per kind of record."""

    mission: MissionTable = MissionTable()
    beacon: list[BeaconTable] = []
    sound_speed: SoundSpeedTable | None = None
    vehicle: VehicleTable = VehicleTable()
    start: StartTable | None = None
    options: OptionsTable = OptionsTable()  # pyright: ignore[reportInvalidTypeForm] - `create_model`
    data: CsvDataTable = CsvDataTable()


class GarposDocument(Table):
    """A mission file with data in a GARPOS campaign's files."""

    mission: NamedTable = NamedTable()
    options: OptionsTable = OptionsTable()  # pyright: ignore[reportInvalidTypeForm] - `create_model`
    data: GarposDataTable


class PyfgDocument(Table):
    """A mission file with beacons and data in a PyFG file."""

    mission: MissionTable = MissionTable()
    vehicle: VehicleTable = VehicleTable()
    start: StartTable | None = None
    options: OptionsTable = OptionsTable()  # pyright: ignore[reportInvalidTypeForm] - `create_model`
    data: PyfgDataTable


Document = CsvDocument | GarposDocument | PyfgDocument

_FORMATS: dict[str, type[Document]] = {
    "csv": CsvDocument,
    "garpos": GarposDocument,
    "pyfg": PyfgDocument,
}


def validated(content: dict[str, Any], path: Path) -> Document:
    """Check the content of a mission file against the format that its [data] names.

    Parameters
    ----------
    content : dict
        The parsed TOML document.
    path : Path
        For the errors.

    Returns
    -------
    CsvDocument, GarposDocument or PyfgDocument

    Raises
    ------
    ConfigurationError
        Where a key is unknown or missing, or its value of the wrong kind.
    """
    data = content.get("data")
    form = data.get("format", "csv") if isinstance(data, dict) else "csv"
    if not isinstance(form, str) or form not in _FORMATS:
        raise ConfigurationError(
            f"{shortened(form)} is no format of data",
            did_you_mean(str(form), tuple(_FORMATS)),
            file=path,
            field="data.format",
        )
    try:
        return _FORMATS[form].model_validate(content)
    except ValidationError as error:
        raise plain(error, content, path, lambda place: _unknown_key(place, form)) from error


_WORDS = {
    "missing": "the key is missing",
    "float_type": "{value} is not a number",
    "finite_number": "{value} is not a finite number",
    "int_type": "{value} is not a whole number",
    "int_from_float": "{value} is not a whole number",
    "string_type": "{value} is not a text in quotes",
    "bool_type": "{value} is neither true nor false",
    "list_type": "{value} is not a list",
    "model_type": "{value} is not a table",
    "too_short": "the list is empty",
}


#: Where a complaint belongs in a document: keys of tables, numbers within lists of tables.
Place = tuple[int | str, ...]


def plain(
    error: ValidationError,
    content: dict[str, Any],
    path: Path,
    unknown: Callable[[Place], tuple[str, str]],
) -> ConfigurationError:
    """Say the first of pydantic's complaints, unknown keys before all others, in plain words.

    Parameters
    ----------
    error : ValidationError
        What pydantic said.
    content : dict
        The document.
    path : Path
        Its file.
    unknown : callable
        Problem and remedy where a key is unknown, by its place.

    Returns
    -------
    ConfigurationError
    """
    details = error.errors(include_url=False)
    # A misspelt key is often the reason why another is missing.
    detail = next((d for d in details if d["type"] == "extra_forbidden"), details[0])
    kind, place, value = detail["type"], detail["loc"], detail["input"]
    remedy = ""
    words_allowed: list[str] = []
    if "options" in place:
        # Each kind that an option may have complains for itself, under a place of its own.
        place = place[: place.index("options") + 2]
        complaints = [d for d in details if d["loc"][: len(place)] == place]
        allowing = [d for d in complaints if d["type"] == "literal_error"]
        words_allowed = [word for d in allowing for word in _literals(d)]
    if kind == "extra_forbidden":
        problem, remedy = unknown(place)
    elif kind == "literal_error":
        allowed = words_allowed or _literals(detail)
        problem, remedy = f"{shortened(value)} is not allowed", did_you_mean(str(value), allowed)
    elif kind == "value_error":
        problem = detail["msg"].removeprefix("Value error, ")
    elif place in (("beacon",), ("target",)):
        name = place[0]
        problem, remedy = f"[{name}] is one table", f"each {name}'s table starts with [[{name}]]"
    else:
        words = _WORDS.get(kind)
        problem = words.format(value=shortened(value)) if words else detail["msg"]
        problem += "".join(f" or '{word}'" for word in words_allowed)
    return ConfigurationError(
        " ".join(problem.split()),
        remedy,
        file=path,
        record=_label(place, content),
        field=".".join(part for part in place if isinstance(part, str)),
    )


def _literals(detail: Any) -> list[str]:
    """The words that one of pydantic's complaints would have allowed."""
    return re.findall(r"'([^']*)'", detail.get("ctx", {}).get("expected", ""))


def _unknown_key(place: Place, form: str) -> tuple[str, str]:
    *tables, key = place
    if place == ("target",):
        return "targets belong to a fleet", "each vehicle's table starts with [[vehicle]] then"
    known = keys_of(_FORMATS[form], tables)
    for other, model in _FORMATS.items():
        if key in keys_of(model, tables):
            return (
                f"'{key}' does not go with format = '{form}'",
                f"it belongs to format = '{other}'; known here: {', '.join(known)}",
            )
    return f"unknown key '{key}'", did_you_mean(str(key), known)


def keys_of(model: type[BaseModel], tables: Sequence[int | str]) -> tuple[str, ...]:
    """Return the keys of the table that `tables` leads to, none where there is no such table."""
    found: type[BaseModel] | None = model
    for name in tables:
        if isinstance(name, int):
            continue
        if found is None or name not in found.model_fields:
            return ()
        found = _model_in(found.model_fields[name].annotation)
    return tuple(found.model_fields) if found else ()


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((m for m in map(_model_in, get_args(annotation)) if m), None)


def _label(place: Place, content: dict[str, Any]) -> str | None:
    """Which of several tables of one kind a place lies in, by its name."""
    if len(place) < 2 or not isinstance(place[1], int):
        return None
    kind = str(place[0])
    table = content[kind][place[1]]
    name = table.get("name") if isinstance(table, dict) else None
    return f"{kind} '{name}'" if isinstance(name, str) else f"{kind} number {place[1] + 1}"
