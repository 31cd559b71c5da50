"""The keys of a fleet's mission file: [[vehicle]] and [[target]] beside those of any mission."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationError

from ubl_graph.cooperative.fleet import UNKNOWN_PLACE
from ubl_graph.io.mission_schema import (
    BeaconTable,
    CsvDataTable,
    MissionTable,
    OptionsTable,
    Place,
    PositionTable,
    SoundSpeedTable,
    StartTable,
    Table,
    VehicleTable,
    keys_of,
    one_or_three,
    options_model,
    plain,
)
from ubl_graph.io.tables import did_you_mean
from ubl_graph.mission_checks import RANGE_KINDS

#: Options that `Fleet` takes from the whole, whatever its vehicles say.
OF_THE_WHOLE = ("loss", "solver", "max_iterations", "rays", "estimate_beacons")

MemberOptionsTable = options_model(without=OF_THE_WHOLE)


class MemberTable(VehicleTable):
    """[[vehicle]]: a name, lever arms, and what the vehicle alone has."""

    name: str
    start: StartTable | None = None
    options: MemberOptionsTable = MemberOptionsTable()  # pyright: ignore[reportInvalidTypeForm] - `create_model`
    data: CsvDataTable = CsvDataTable()


class TargetTable(Table):
    """[[target]]: metres, m/s and seconds."""

    name: str
    position: PositionTable | None = None
    sigma: Annotated[Any, BeforeValidator(one_or_three)] = UNKNOWN_PLACE
    velocity_sigma: Annotated[Any, BeforeValidator(one_or_three)] = 0.0
    t: float | None = None


class FleetDataTable(Table):
    """[data] of a fleet: files with the ranges of several vehicles."""

    format: Literal["csv"] = "csv"
    two_way_range: str | None = None
    one_way_range: str | None = None
    slant_range: str | None = None


class FleetDocument(Table):
    """A mission file of several vehicles."""

    mission: MissionTable = MissionTable()
    beacon: list[BeaconTable] = Field(default_factory=list[BeaconTable])
    vehicle: list[MemberTable]
    target: list[TargetTable] = Field(default_factory=list[TargetTable])
    sound_speed: SoundSpeedTable | None = None
    options: OptionsTable = OptionsTable()  # pyright: ignore[reportInvalidTypeForm] - `create_model`
    data: FleetDataTable = FleetDataTable()


def validated_fleet(content: dict[str, Any], path: Path) -> FleetDocument:
    """Check the content of a fleet's mission file.

    Parameters
    ----------
    content : dict
        The parsed TOML document.
    path : Path
        For the errors.

    Returns
    -------
    FleetDocument

    Raises
    ------
    ConfigurationError
        Where a key is unknown or missing, or its value of the wrong kind.
    """
    try:
        return FleetDocument.model_validate(content)
    except ValidationError as error:
        raise plain(error, content, path, _unknown_key) from error


def _unknown_key(place: Place) -> tuple[str, str]:
    *tables, key = place
    if place == ("start",):
        return "each vehicle of a fleet has its own start", "put it into [vehicle.start]"
    if tables == ["data"] and key in CsvDataTable.model_fields:
        return (
            f"'{key}' is one vehicle's, and belongs into [vehicle.data]",
            f"known here: {', '.join(RANGE_KINDS)}",
        )
    if tables[:1] == ["vehicle"] and tables[-1] == "options" and key in OF_THE_WHOLE:
        return f"'{key}' is chosen for the whole fleet", "put it into [options]"
    return f"unknown key '{key}'", did_you_mean(str(key), keys_of(FleetDocument, tables))
