"""The tables that the command prints: made here, shown by `cli`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.table import Table

if TYPE_CHECKING:
    from ubl_graph.arrays import FloatArray
    from ubl_graph.batch import BatchRow
    from ubl_graph.cooperative.result import FleetResult
    from ubl_graph.evaluation import Errors
    from ubl_graph.result import Result


def segments_table(result: Result) -> Table:
    """One row a segment."""
    from ubl_graph.pose_trajectory import PoseTrajectory

    poses = any(isinstance(s.trajectory, PoseTrajectory) for s in result.segments)
    further = ("heading sd, deg", "next best, cost") if poses else ()
    table = _table(
        *("segment", "nodes", "pings", "down-weighted", "median sd, m"), *further, "status"
    )
    for segment in result.segments:
        track = segment.trajectory
        residuals = segment.residuals
        row = [
            segment.name or "-",
            str(len(track.t)),
            "0" if residuals is None else str(len(residuals)),
            "0" if residuals is None else str(int(residuals.down_weighted.sum())),
            f"{_median_sd(track.covariance):.2f}",
        ]
        if isinstance(track, PoseTrajectory):
            row.append(f"{_middle(track.attitude_sigma[:, 0]) * 180.0 / math.pi:.2f}")
            row.append(_number(segment.runner_up, "+{:.3g}"))
        table.add_row(*row, segment.status)
    return table


def vehicles_table(result: FleetResult) -> Table:
    """One row a vehicle of a fleet, with its error where it has a reference."""
    from ubl_graph.evaluation import Errors, evaluate

    compared = {name: evaluate(vehicle) for name, vehicle in result.vehicles.items()}
    further = ("rmse, m",) if any(compared.values()) else ()
    table = _table(
        *("vehicle", "nodes", "pings", "down-weighted", "median sd, m"), *further, "status"
    )
    for name, vehicle in result.vehicles.items():
        doubted = [] if vehicle.residuals is None else list(vehicle.residuals.down_weighted)
        if result.residuals is not None:
            doubted += list(result.residuals.down_weighted[result.residuals.vehicle == name])
        row = [
            name,
            str(len(vehicle.trajectory.t)),
            str(len(doubted)),
            str(sum(doubted)),
            f"{_median_sd(vehicle.trajectory.covariance):.2f}",
        ]
        if further:
            errors = compared[name]
            rmse = Errors.joined(errors.values()).summary()["horizontal_rmse_m"] if errors else None
            row.append(_number(rmse, "{:.2f}"))
        table.add_row(*row, vehicle.status)
    return table


def targets_table(result: FleetResult) -> Table:
    """One row a target of a fleet."""
    table = _table(
        *("target", "east, m", "north, m", "up, m"),
        *("sd east, m", "sd north, m", "sd up, m", "status"),
    )
    for target in result.targets.values():
        sd = [math.sqrt(target.covariance[i, i]) for i in range(3)]
        table.add_row(
            target.name,
            *(f"{value:.2f}" for value in target.position),
            *(f"{value:.2f}" for value in sd),
            target.status,
        )
    return table


def batch_table(rows: Sequence[BatchRow]) -> Table:
    """One row a mission."""
    table = _table(
        *("mission", "segments", "pings", "down-weighted"),
        *("median sd, m", "rmse, m", "time, s", "status"),
    )
    for row in rows:
        table.add_row(
            row.folder,
            "-" if row.failed else str(row.segments),
            "-" if row.failed else str(row.pings),
            _number(row.down_weighted_share, "{:.1%}"),
            _number(row.median_sd_m, "{:.2f}"),
            _number(row.horizontal_rmse_m, "{:.2f}"),
            f"{row.seconds:.1f}",
            row.status,
        )
    return table


def errors_table(rows: dict[str, Errors]) -> Table:
    """One row a track that is compared with a reference."""
    table = _table("horizontal error", "rmse, m", "interior, m", "largest, m", "NEES (2 expected)")
    for name, errors in rows.items():
        found = errors.summary()
        table.add_row(
            name,
            _number(found["horizontal_rmse_m"], "{:.2f}"),
            _number(found["interior_horizontal_rmse_m"], "{:.2f}"),
            f"{errors.horizontal.max():.2f}",
            _number(found["interior_mean_nees_2dof"], "{:.1f}"),
        )
    return table


def _median_sd(covariance: FloatArray) -> float:
    """Median over the nodes of the larger of the standard deviations east and north, m."""
    return _middle(covariance[:, [0, 1], [0, 1]].max(axis=1) ** 0.5)


def _middle(values: FloatArray) -> float:
    return float(sorted(values)[len(values) // 2])


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False, header_style="")
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i == 0 else "right", no_wrap=True)
    return table
