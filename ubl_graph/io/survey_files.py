"""Writing a SurveyResult into a folder: beacons, result, residuals, the water, figures.

As with any result, all files are there in the end or none is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ubl_graph.io.output_folder import scientific_cell, staged, time_cell, write_json, write_rows
from ubl_graph.io.resolved import resolved
from ubl_graph.io.result_files import RESIDUAL_COLUMNS, residual_cells, versions
from ubl_graph.result import RangeResiduals, SlowState
from ubl_graph.survey import BeaconCheck, SurveyResult

#: Components of the slow states as slow_states.csv names them.
SLOW_COMPONENTS = {
    "sound_speed": ("sound_speed_log_factor",),
    "vehicle_gradient": ("vehicle_gradient_east", "vehicle_gradient_north"),
    "beacon_gradient": ("beacon_gradient_east", "beacon_gradient_north"),
    "track_error": ("track_error_east", "track_error_north", "track_error_up"),
    "clock_offset": ("clock_offset",),
    "clock_drift": ("clock_drift",),
}


def write_survey(result: SurveyResult, folder: str | Path, figures: bool = True) -> list[Path]:
    """Write everything that `ubl-graph calibrate` leaves behind.

    Parameters
    ----------
    result : SurveyResult
        What to write.
    folder : path
        Made where it is missing. Files of the same names in it are replaced, others stay.
    figures : bool
        Whether to draw figures (PNG).

    Returns
    -------
    list of Path
        The files, sorted by name.

    Raises
    ------
    DataError
        Where the folder cannot be made or written to; then nothing is left behind.
    """
    folder = Path(folder)
    with staged(folder) as stage:
        write_json(stage / "beacons.json", beacons_document(result))
        write_json(stage / "result.json", summary(result))
        write_json(stage / "mission.json", resolved(result.mission))
        write_rows(stage / "residuals.csv", RESIDUAL_COLUMNS, _residual_rows(result))
        if result.slow:
            columns, rows = _slow_table(result.slow)
            write_rows(stage / "slow_states.csv", columns, rows)
        if figures:
            from ubl_graph import survey_plots  # matplotlib is heavy: only who draws pays for it

            survey_plots.save_all(result, stage)
        names = sorted(p.name for p in stage.iterdir())
    return [folder / name for name in names]


def beacons_document(result: SurveyResult) -> dict[str, Any]:
    """What beacons.json holds: a beacons file, with the joint covariance beside it."""
    return {
        "mission": result.mission.name,
        "status": result.status,
        "beacons": {
            b.name: {"enu": b.position.tolist(), "sigma_enu": b.sigma.tolist()}
            for b in result.beacons
        },
        "covariance": {
            "order": [
                f"{name} {axis}" for name in result.names for axis in ("east", "north", "up")
            ],
            "m2": result.covariance.tolist(),
        },
    }


def summary(result: SurveyResult) -> dict[str, Any]:
    """What result.json holds, as a plain dict; docs/survey.md explains each key."""
    given = {b.name: b for b in result.mission.beacons}
    return {
        "mission": result.mission.name,
        "method": result.method,
        "status": result.status,
        "reason": result.reason,
        "verdict": result.verdict,
        "warnings": list(result.warnings),
        "beacons": {
            b.name: {
                "enu": b.position.tolist(),
                "sigma_enu": b.sigma.tolist(),
                "given_enu": given[b.name].position.tolist(),
                "given_sigma_enu": given[b.name].sigma.tolist(),
                "estimated": b.name in result.names,
                **ranges_summary(result.residuals, b.name),
                **_bias(result, b.name),
            }
            for b in result.beacons
        },
        "leave_one_out": {
            "reason": result.check.reason,
            "named": list(result.check.named),
            "undecided": list(result.check.undecided),
            "checks": {c.name: _check(c, result) for c in result.check.checks},
        },
        "noise": {"range_factor": result.noise.range_factor, "sound_speed_walk": result.noise.walk},
        "survey_options": asdict(result.options),
        "slow_states": {name: _slow(state) for name, state in result.slow.items()},
        "wall_times_s": {name: round(t, 4) for name, t in result.wall_times.items()},
        "versions": versions(),
    }


def ranges_summary(table: RangeResiduals, name: str) -> dict[str, Any]:
    """Count, down-weighted count, and rms and mean of the residuals that count of one beacon."""
    mine = table.beacon == name
    kept = mine & ~table.down_weighted
    residual = table.residual[kept]
    return {
        "ranges": int(mine.sum()),
        "down_weighted": int((mine & table.down_weighted).sum()),
        "residual_rms_s": float(np.sqrt(np.mean(residual**2))) if len(residual) else None,
        "residual_mean_s": float(residual.mean()) if len(residual) else None,
        "median_sigma_s": float(np.median(table.sigma[mine])) if mine.any() else None,
    }


def _bias(result: SurveyResult, name: str) -> dict[str, Any]:
    if name not in result.range_bias:
        return {}
    value, sigma = result.range_bias[name]
    return {"range_bias_m": value, "range_bias_sigma_m": sigma}


def _check(check: BeaconCheck, result: SurveyResult) -> dict[str, Any]:
    return {
        "offset_enu": check.offset.tolist(),
        "sigma_enu": check.sigma.tolist(),
        "statistic": check.statistic,
        "degrees_of_freedom": check.degrees_of_freedom,
        "threshold": result.check.thresholds[check.name],
    }


def _slow(state: SlowState) -> dict[str, Any]:
    return {
        "mean": state.value.mean(axis=0).tolist(),
        "standard_deviation": state.value.std(axis=0).tolist(),
        "first": state.value[0].tolist(),
        "last": state.value[-1].tolist(),
        "median_sigma": np.median(state.sigma, axis=0).tolist(),
    }


def _residual_rows(result: SurveyResult) -> Iterator[list[str]]:
    r = result.residuals
    for i, (segment, cells) in enumerate(zip(result.segments, residual_cells(r), strict=True)):
        yield [str(segment), str(r.kind[i]), str(r.beacon[i]), *cells]


def _slow_table(slow: dict[str, SlowState]) -> tuple[list[str], Iterator[list[str]]]:
    components = [c for name in slow for c in SLOW_COMPONENTS[name]]
    t = next(iter(slow.values())).t

    def rows() -> Iterator[list[str]]:
        values = np.concatenate([s.value for s in slow.values()], axis=1)
        sigmas = np.concatenate([s.sigma for s in slow.values()], axis=1)
        for at, value, sigma in zip(t, values, sigmas, strict=True):
            yield [time_cell(at), *(scientific_cell(v, 6) for v in (*value, *sigma))]

    return ["t", *components, *(f"sd_{c}" for c in components)], rows()
