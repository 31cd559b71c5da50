"""Writing a Result into a folder: tables, JSON, the resolved mission, figures."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from ubl_graph.cooperative.result import FleetResiduals
from ubl_graph.evaluation import Errors, evaluate
from ubl_graph.io.output_folder import (
    names_in,
    number_cells,
    scientific_cell,
    staged,
    time_cell,
    write_json,
    write_rows,
)
from ubl_graph.io.pose_columns import (
    ATTITUDE_COLUMNS,
    COVARIANCE_COLUMNS,
    attitude_table,
    covariance_table,
    pose_tracks,
)
from ubl_graph.io.resolved import resolved
from ubl_graph.mission import Mission
from ubl_graph.pose_trajectory import PoseTrajectory
from ubl_graph.result import (
    Hypothesis,
    RangeResiduals,
    Result,
    SegmentResult,
    Shared,
    SlowState,
)
from ubl_graph.trajectory import Trajectory
from ubl_graph.verdict import Consistency

#: Columns of trajectory.csv; docs/outputs.md says what they hold.
TRAJECTORY_COLUMNS = (
    *("segment", "t", "east", "north", "up", "v_east", "v_north", "v_up"),
    *("sd_east", "sd_north", "sd_up", "cov_east_north"),
)
RESIDUAL_COLUMNS = (
    *("segment", "kind", "beacon", "t_transmit", "t_receive", "travel_time"),
    *("residual", "sigma", "weight", "direct_ray"),
)
#: Down-weighted pings that result.json lists; residuals.csv has them all.
MOST_LISTED = 100
#: Components of the slow states as slow_states.csv names them.
SLOW_COMPONENTS = {
    "sound_speed": ("sound_speed_log_factor",),
    "clock_offset": ("clock_offset",),
    "clock_drift": ("clock_drift",),
    "current": ("current_east", "current_north"),
    "heading_bias": ("heading_bias",),
}


def write_result(
    result: Result,
    folder: str | Path,
    figures: bool = True,
    beside: Mapping[str, Sequence[Trajectory]] | None = None,
) -> list[Path]:
    """Write everything that `ubl-graph smooth` leaves behind.

    Parameters
    ----------
    result : Result
        What to write.
    folder : path
        Made where it is missing. Files of the same names in it are replaced, others stay.
    figures : bool
        Whether to draw figures (PNG).
    beside : mapping of str to sequence of Trajectory, optional
        Further tracks to draw on the map, by their name in the legend.

    Returns
    -------
    list of Path
        The files, in the order written.

    Raises
    ------
    DataError
        Where the folder cannot be made or written to; then nothing is left behind.
    """
    folder = Path(folder)
    with staged(folder) as stage:
        has_poses = any(pose_tracks(result))
        columns = TRAJECTORY_COLUMNS + (ATTITUDE_COLUMNS if has_poses else ())
        write_rows(stage / "trajectory.csv", columns, _trajectory_rows(result))
        if has_poses:
            rows = _covariance_rows(result)
            write_rows(stage / "pose_covariance.csv", COVARIANCE_COLUMNS, rows)
        if result.residuals is not None:
            write_rows(stage / "residuals.csv", RESIDUAL_COLUMNS, _residual_rows(result))
        if any(s.slow for s in result.segments):
            columns, rows = _slow_table(result)
            write_rows(stage / "slow_states.csv", columns, rows)
        write_json(stage / "result.json", summary(result))
        write_json(stage / "mission.json", resolved(result.mission))
        if figures:
            from ubl_graph import plots  # matplotlib is heavy: only who draws pays for it

            plots.save_all(result, stage, beside)
        names = names_in(stage)
    return [folder / name for name in names]


def summary(result: Result) -> dict[str, Any]:
    """What result.json holds, as a plain dict; docs/outputs.md explains each key."""
    residuals = result.residuals
    errors = evaluate(result)
    chi_square = sum(s.chi_square for s in _problems(result))
    dof = sum(s.degrees_of_freedom for s in _problems(result))
    content: dict[str, Any] = {
        "mission": result.mission.name,
        "node": result.mission.options.node,
        "status": result.status,
        "reason": result.reason,
        "warnings": list(result.warnings),
        "cost": sum(s.cost for s in _problems(result)),
        "iterations": sum(s.iterations for s in _problems(result)),
        "chi_square_per_dof": chi_square / max(dof, 1),
        "pings": {} if residuals is None else _ping_counts(residuals),
        "down_weighted": _down_weighted(result),
        "beacons": {
            name: {"enu": b.value.tolist(), "sigma_enu": b.sigma.tolist()}
            for name, b in result.beacons.items()
        },
        "shared_states": {name: _shared_summary(s) for name, s in result.shared.items()},
        "segments": [
            {**segment_summary(s, errors.get(s.name)), **_odometry_noise(result.mission, s.name)}
            for s in result.segments
        ],
        **({} if result.tuning is None else {"tuning": asdict(result.tuning)}),
        **{
            name: _consistency_summary(found)
            for name in ("consistency", "inflation")
            if (found := getattr(result, name)) is not None
        },
        "wall_times_s": {name: round(t, 4) for name, t in result.wall_times.items()},
        "versions": versions(),
    }
    if errors:
        content["reference"] = Errors.joined(errors.values()).summary()
    return content


def versions() -> dict[str, str]:
    """Versions of ubl_graph, of what it stands on, and of Python."""
    found: dict[str, str] = {"python": platform.python_version()}
    for name in ("ubl-graph", "gtsam", "numpy", "scipy"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def _problems(result: Result) -> list[SegmentResult]:
    """One segment of each problem: segments solved together share cost and counts."""
    return list({s.problem: s for s in result.segments}.values())


def segment_summary(segment: SegmentResult, errors: Errors | None) -> dict[str, Any]:
    """What result.json says of a segment; `errors` against its reference, where it has one."""
    sd = np.sqrt(np.einsum("nii->ni", segment.trajectory.covariance))
    content: dict[str, Any] = {
        "name": segment.name,
        "status": segment.status,
        "reason": segment.reason,
        "nodes": len(segment.trajectory.t),
        "t_first": float(segment.trajectory.t[0]),
        "t_last": float(segment.trajectory.t[-1]),
        "solver": segment.solver,
        "cost": segment.cost,
        "runner_up": segment.runner_up,
        "hypotheses": [_hypothesis_summary(segment, h) for h in segment.hypotheses],
        "pruned_weight": segment.pruned,
        "iterations": segment.iterations,
        "chi_square_per_dof": segment.chi_square / max(segment.degrees_of_freedom, 1),
        "median_sd_m": dict(zip(("east", "north", "up"), np.median(sd, axis=0), strict=True)),
        "slow_states": {name: _slow_summary(s) for name, s in segment.slow.items()},
    }
    if isinstance(segment.trajectory, PoseTrajectory):
        heading = np.median(segment.trajectory.attitude_sigma[:, 0])
        content["median_sd_heading_deg"] = float(np.rad2deg(heading))
    if errors is not None:
        content["reference"] = errors.summary()
    return content


def _hypothesis_summary(segment: SegmentResult, told: Hypothesis) -> dict[str, Any]:
    """Weight of a track that the data allow, where it begins and ends, how far off it runs."""
    track = told.trajectory
    gap = track.position - segment.trajectory.position
    return {
        "weight": told.weight,
        "cost": told.cost,
        "status": told.status,
        "first_enu": track.position[0].tolist(),
        "last_enu": track.position[-1].tolist(),
        "rms_apart_m": float(np.sqrt(np.mean(np.sum(gap**2, axis=1)))),
    }


def _odometry_noise(mission: Mission, name: str) -> dict[str, str]:
    """Which noise a segment's odometry records were given; nothing where there are none."""
    for segment in mission.segments:
        records = segment.odometry
        if segment.name == name and records is not None and len(records):
            told = records.covariance is not None
            return {"odometry_noise": mission.options.odometry_noise if told else "growing"}
    return {}


def _consistency_summary(found: Consistency) -> dict[str, Any]:
    low, high = found.interval
    content = {"verdict": found.verdict, "agrees": found.agrees, **asdict(found)}
    return content if found.trouble else {**content, "factor_low": low, "factor_high": high}


def _shared_summary(state: Shared) -> dict[str, Any]:
    content: dict[str, Any] = {"value": state.value.tolist(), "sigma": state.sigma.tolist()}
    if state.prior is not None:
        content |= {"prior_sigma": state.prior.tolist(), "observed": state.observed}
    if state.expected is not None:
        expected = np.sqrt(np.diag(state.expected))
        content |= {"expected_sigma": expected.tolist(), "observable": state.observable}
    return content


def _slow_summary(state: SlowState) -> dict[str, Any]:
    return {
        "mean": state.value.mean(axis=0).tolist(),
        "first": state.value[0].tolist(),
        "last": state.value[-1].tolist(),
        "median_sigma": np.median(state.sigma, axis=0).tolist(),
        "prior_sigma": None if state.prior is None else state.prior.tolist(),
        "observed": state.observed,
    }


def _ping_counts(residuals: RangeResiduals) -> dict[str, dict[str, int]]:
    return {
        str(name): {
            "used": int((residuals.beacon == name).sum()),
            "down_weighted": int((residuals.down_weighted & (residuals.beacon == name)).sum()),
        }
        for name in np.unique(residuals.beacon)
    }


def _down_weighted(result: Result) -> dict[str, Any]:
    """How many pings are down-weighted, and the worst of them one by one."""
    found = result.down_weighted
    worst = [
        {
            "segment": p.segment,
            "kind": p.kind,
            "beacon": p.beacon,
            "t_transmit": p.t_transmit,
            "t_receive": p.t_receive,
            "residual_s": p.residual,
            "residual_m": p.residual_m,
            "sigma_s": p.sigma,
            "weight": p.weight,
        }
        for p in found[:MOST_LISTED]
    ]
    return {"count": len(found), "worst": worst}


def _trajectory_rows(result: Result) -> Iterator[list[str]]:
    for segment in result.segments:
        track = segment.trajectory
        sd = np.sqrt(np.einsum("nii->ni", track.covariance))
        parts = [track.position, track.velocity, sd, track.covariance[:, 0, 1]]
        if isinstance(track, PoseTrajectory):
            parts.append(attitude_table(track))
            if track.still and len(track.t) == 1:
                # Nothing says how fast a lone pose moves that knows no velocity.
                parts[1] = np.full_like(track.velocity, np.nan)
        table = np.column_stack(parts)
        for t, row in zip(track.t, table, strict=True):
            yield [segment.name, time_cell(t), *number_cells(row)]


def _covariance_rows(result: Result) -> Iterator[list[str]]:
    for name, track in pose_tracks(result):
        for t, row in zip(track.t, covariance_table(track), strict=True):
            yield [name, time_cell(t), *(scientific_cell(v, 9) for v in row)]


def _residual_rows(result: Result) -> Iterator[list[str]]:
    for segment in result.segments:
        r = segment.residuals
        if r is None:
            continue
        for i, cells in enumerate(residual_cells(r)):
            yield [segment.name, str(r.kind[i]), str(r.beacon[i]), *cells]


def residual_cells(residuals: RangeResiduals | FleetResiduals) -> Iterator[list[str]]:
    """Of each range what stands in `RESIDUAL_COLUMNS` behind the names of its ends."""
    r = residuals
    for i in range(len(r)):
        yield [
            time_cell(r.t_transmit[i]),
            time_cell(r.t_receive[i]),
            f"{r.travel_time[i]:.9f}",
            f"{r.residual[i]:.9f}",
            f"{r.sigma[i]:.3e}",
            f"{r.weight[i]:.4f}",
            "yes" if r.found[i] else "no",
        ]


def _slow_table(result: Result) -> tuple[list[str], Iterator[list[str]]]:
    names = list(dict.fromkeys(name for s in result.segments for name in s.slow))
    components = [c for name in names for c in SLOW_COMPONENTS[name]]

    def rows() -> Iterator[list[str]]:
        for segment in result.segments:
            states = [segment.slow[name] for name in names]
            values = np.concatenate([s.value for s in states], axis=1)
            sigmas = np.concatenate([s.sigma for s in states], axis=1)
            for t, value, sigma in zip(segment.trajectory.t, values, sigmas, strict=True):
                yield [
                    segment.name,
                    time_cell(t),
                    *(scientific_cell(v, 6) for v in (*value, *sigma)),
                ]

    return ["segment", "t", *components, *(f"sd_{c}" for c in components)], rows()
