"""Writing a FleetResult into a folder: a subfolder a vehicle, and what concerns the whole."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ubl_graph.cooperative.result import FleetResiduals, FleetResult, TargetEstimate
from ubl_graph.evaluation import evaluate
from ubl_graph.io.output_folder import (
    names_in,
    number_cells,
    scientific_cell,
    staged,
    time_cell,
    write_json,
    write_rows,
)
from ubl_graph.io.resolved import resolved_fleet
from ubl_graph.io.result_files import RESIDUAL_COLUMNS, residual_cells, segment_summary, versions
from ubl_graph.io.result_files import write_result as write_vehicle
from ubl_graph.result import Result

#: Columns of targets.csv; docs/outputs.md says what they hold.
TARGET_COLUMNS = (
    *("target", "t", "east", "north", "up", "sd_east", "sd_north", "sd_up"),
    *("cov_east_north", "cov_east_up", "cov_north_up"),
    *("v_east", "v_north", "v_up", "sd_v_east", "sd_v_north", "sd_v_up", "status"),
)
#: Columns of residuals.csv of a fleet.
FLEET_RESIDUAL_COLUMNS = ("kind", "vehicle", "peer", *RESIDUAL_COLUMNS[3:])
#: Files of the whole, beside the vehicles' folders.
FILES = (
    *("result.json", "mission.json", "targets.csv", "residuals.csv"),
    *("map.png", "residuals.png"),
)
#: A name of a folder has no more characters.
LONGEST = 60


def write_fleet_result(result: FleetResult, folder: str | Path, figures: bool = True) -> list[Path]:
    """Write everything that `ubl-graph smooth` leaves behind of a fleet.

    Parameters
    ----------
    result : FleetResult
        What to write.
    folder : path
        Made where it is missing. Files of the same names in it and in the vehicles' subfolders are
        replaced, others stay.
    figures : bool
        Whether to draw figures (PNG).

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    DataError
        Where the folder cannot be made or written to; then nothing is left behind.
    """
    folder = Path(folder)
    with staged(folder) as stage:
        subfolders = vehicle_folders(list(result.vehicles))
        for name, vehicle in result.vehicles.items():
            write_vehicle(vehicle, stage / subfolders[name], figures)
        if result.targets:
            write_rows(stage / "targets.csv", TARGET_COLUMNS, _target_rows(result))
        if result.residuals is not None:
            rows = _residual_rows(result.residuals)
            write_rows(stage / "residuals.csv", FLEET_RESIDUAL_COLUMNS, rows)
        write_json(stage / "result.json", fleet_summary(result))
        write_json(stage / "mission.json", resolved_fleet(result.fleet))
        if figures:
            from ubl_graph import fleet_plots  # matplotlib is heavy: only who draws pays for it

            fleet_plots.save_all(result, stage)
        names = names_in(stage)
    return [folder / name for name in names]


def vehicle_folders(names: Sequence[str]) -> dict[str, str]:
    """Name of each vehicle's subfolder: the vehicle's own, as far as every file system takes it.

    What is no letter, digit, point, plus, minus or underscore becomes an underscore. Names that are
    equal then, or differ in case alone, get a number behind.

    Examples
    --------
    >>> vehicle_folders(["A1", "a1", "rov/left", "../A1"])
    {'A1': 'A1', 'a1': 'a1-2', 'rov/left': 'rov_left', '../A1': 'A1-3'}
    """
    safe = {n: re.sub(r"[^\w.+-]+", "_", n).strip("._")[:LONGEST] or "vehicle" for n in names}
    taken = {file.casefold() for file in FILES}
    folders: dict[str, str] = {}
    # Names that stay as they are come first: others must not take their place.
    for name in sorted(names, key=lambda n: safe[n] != n):
        folder, number = safe[name], 2
        while folder.casefold() in taken:
            folder, number = f"{safe[name]}-{number}", number + 1
        taken.add(folder.casefold())
        folders[name] = folder
    return {name: folders[name] for name in names}


def fleet_summary(result: FleetResult) -> dict[str, Any]:
    """What result.json of a fleet holds, as a plain dict; docs/outputs.md explains each key."""
    subfolders = vehicle_folders(list(result.vehicles))
    return {
        "mission": result.fleet.name,
        "status": result.status,
        "reason": result.reason,
        "warnings": list(result.warnings),
        "solver": result.solver,
        "cost": result.cost,
        "iterations": result.iterations,
        "vehicles": {
            name: {"folder": subfolders[name], **_vehicle_summary(vehicle)}
            for name, vehicle in result.vehicles.items()
        },
        "targets": {name: _target_summary(t) for name, t in result.targets.items()},
        "pings": {} if result.residuals is None else _ping_counts(result.residuals),
        "beacons": {
            name: {"enu": b.value.tolist(), "sigma_enu": b.sigma.tolist()}
            for name, b in result.beacons.items()
        },
        "shared_states": {
            name: {"value": s.value.tolist(), "sigma": s.sigma.tolist()}
            for name, s in result.shared.items()
        },
        "wall_times_s": {name: round(t, 4) for name, t in result.wall_times.items()},
        "versions": versions(),
    }


def _vehicle_summary(vehicle: Result) -> dict[str, Any]:
    segment = vehicle.segments[0]
    content = segment_summary(segment, evaluate(vehicle).get(segment.name))
    del content["name"]
    return {"node": vehicle.mission.options.node, **content}


def _target_summary(target: TargetEstimate) -> dict[str, Any]:
    content: dict[str, Any] = {
        "status": target.status,
        "reason": target.reason,
        "t": target.t,
        "enu": target.position.tolist(),
        "sigma_enu": np.sqrt(np.diag(target.covariance)).tolist(),
        "covariance": target.covariance.tolist(),
        "velocity_enu": target.velocity.tolist(),
        "velocity_sigma_enu": np.sqrt(np.diag(target.velocity_covariance)).tolist(),
    }
    if target.rival is not None:
        content["rival_enu"] = target.rival.tolist()
    return content


def _ping_counts(residuals: FleetResiduals) -> dict[str, dict[str, dict[str, int]]]:
    """By who measured and by the other end."""
    counts: dict[str, dict[str, dict[str, int]]] = {}
    pairs = zip(residuals.vehicle.tolist(), residuals.peer.tolist(), strict=True)
    for vehicle, peer in sorted(set(pairs)):
        mine = (residuals.vehicle == vehicle) & (residuals.peer == peer)
        counts.setdefault(vehicle, {})[peer] = {
            "used": int(mine.sum()),
            "down_weighted": int((mine & residuals.down_weighted).sum()),
        }
    return counts


def _target_rows(result: FleetResult) -> Iterator[list[str]]:
    for target in result.targets.values():
        covariance = target.covariance
        spread = np.sqrt(np.diag(covariance))
        speeds = np.concatenate([target.velocity, np.sqrt(np.diag(target.velocity_covariance))])
        yield [
            target.name,
            "" if np.isnan(target.t) else time_cell(target.t),
            *number_cells(np.concatenate([target.position, spread])),
            *(scientific_cell(covariance[i, j], 9) for i, j in ((0, 1), (0, 2), (1, 2))),
            *number_cells(speeds),
            target.status,
        ]


def _residual_rows(residuals: FleetResiduals) -> Iterator[list[str]]:
    r = residuals
    for i, cells in enumerate(residual_cells(r)):
        yield [str(r.kind[i]), str(r.vehicle[i]), str(r.peer[i]), *cells]
