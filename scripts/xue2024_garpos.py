"""Table 5 of Xue et al. 2024 on recorded lines: windows of 80 s, and the graph, on the same pings.

Estimates are made when a reply has come. A window then holds the pings that were sent and heard
within the last 80 s; "current" is that reception, "centre" the middle of the window. The reference
is the mission's own, interpolated as `scripts/replay.py` does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import replay_runs as runs
from xue2024_rows import CA, CV, SPACE, Row, row

from ubl_graph.arrays import FloatArray
from ubl_graph.baselines.xue2024 import Windows, xue2024
from ubl_graph.errors import DataError
from ubl_graph.evaluation import Errors, evaluate
from ubl_graph.io.mission_file import load_mission
from ubl_graph.mission import Mission
from ubl_graph.result import Result
from ubl_graph.smoother import smooth

#: Length of the windows, s.
WINDOW = 80.0
ORDERS = {SPACE: 0, CV: 1, CA: 2}
#: What the paper prints for its own lines, off CHOS and MYGI: other beacons, another ship. Space
#: intersection once; else centre and current.
PAPER = {
    SPACE: {"CHOS": (None, 137.926), "MYGI": (None, 100.490)},
    CV: {"CHOS": (2.0873, 2.6263), "MYGI": (2.2297, 2.4142)},
    CA: {"CHOS": (2.2269, 2.7204), "MYGI": (2.4893, 3.1026)},
}
Report = Callable[[str, float], None]


def loaded(path: Path) -> Mission:
    """The mission, which needs a reference.

    Raises
    ------
    DataError
        Where a line has no pings, or no reference.
    """
    mission = load_mission(path)
    for segment in mission.segments:
        name = f"segment '{segment.name}'" if segment.name else "the mission"
        if segment.two_way_range is None or not len(segment.two_way_range):
            raise DataError(f"{name} has no two-way range", "name lines that have", file=path)
        if segment.reference is None or not len(segment.reference.t):
            raise DataError(
                f"{name} has no reference to compare with", "a garpos mission has one", file=path
            )
    return mission


def compared(
    mission: Mission, report: Report
) -> tuple[list[Row], dict[str, dict[str, FloatArray]]]:
    """Rows of Table 5 over all segments, and tracks to draw, by name and segment.

    Returns
    -------
    list of dict
        The paper's own numbers are of other lines.
    dict of str to dict of str to array, shape (M, 2)
        East and north, m.
    """
    truths = {
        s.name: runs.of_reference(s.reference) for s in mission.segments if s.reference is not None
    }
    found = {name: xue2024(mission, order, window_seconds=WINDOW) for name, order in ORDERS.items()}
    result = smooth(mission, lambda text, share: report(text, 0.5 * share))
    scores = _online(mission, result, truths, report)
    numbers = runs.summary(scores)
    rows: list[Row] = []
    for name, windows in found.items():
        for epoch, key in (("centre", "half_lag_rmse_m"), ("current", "newest_rmse_m")):
            fixes = {s: (w.centre if epoch == "centre" else w.newest) for s, w in windows.items()}
            errors = np.concatenate(
                [_distance(f.t, f.position, truths[s]) for s, f in fixes.items()]
            )
            rows += _rows(name, epoch, float(np.sqrt(np.nanmean(errors**2))), numbers[key])
        # Windows with too few pings for the model have no dilution.
        dop = float(np.nanmean(np.concatenate([w.trdop for w in windows.values()])))
        rows.append(row("Table 5", name, "TRDOP", None, None, dop))
    rows += _whole(result, found, truths)
    return rows, _tracks(mission, found, result)


def _rows(name: str, epoch: str, error: float, graph: Any) -> list[Row]:
    """One row for these lines, and the paper's numbers for its own."""
    place = ("centre", "current").index(epoch)
    printed = [
        row("Table 5", f"{name}, {site} (the paper's lines)", epoch, "m", pair[place], None)
        for site, pair in PAPER[name].items()
        if pair[place] is not None
    ]
    return [row("Table 5", name, epoch, "m", None, error, graph), *printed]


def _online(
    mission: Mission, result: Result, truths: Mapping[str, runs.Truth], report: Report
) -> list[runs.Score]:
    """The fixed-lag estimator with a lag as long as the windows, scored as in a replay."""
    setup = replace(mission.setup, options=replace(mission.options, lag=WINDOW))
    total, done = sum(map(runs.count, mission.segments)), 0
    scores: list[runs.Score] = []
    for segment in mission.segments:

        def step(name: str = segment.name) -> None:
            nonlocal done
            done += 1
            report(name, 0.5 + 0.5 * done / total)

        played = runs.run(segment, setup, runs.Pace(), step)
        smoothed = runs.of_trajectory(result.trajectory[segment.name])
        scores.append(runs.score(played, truths[segment.name], smoothed))
    return scores


def _whole(
    result: Result, found: Mapping[str, Mapping[str, Windows]], truths: Mapping[str, runs.Truth]
) -> list[Row]:
    """The whole line smoothed against the best window's centre, both away from the ends."""
    centres: list[float] = []
    for windows in (found[CV], found[CA]):
        parts = [
            _distance(w.centre.t, w.centre.position, truths[name]) for name, w in windows.items()
        ]
        centres.append(float(np.sqrt(np.nanmean(np.concatenate(parts) ** 2))))
    graph = Errors.joined(evaluate(result).values()).summary()["interior_horizontal_rmse_m"]
    return [
        row("Table 5", "best window, whole line smoothed", "centre", "m", None, min(centres), graph)
    ]


def _distance(t: FloatArray, position: FloatArray, truth: runs.Truth) -> FloatArray:
    return np.hypot(*(position[:, :2] - truth(t)).T)


def _tracks(
    mission: Mission, found: Mapping[str, Mapping[str, Windows]], result: Result
) -> dict[str, dict[str, FloatArray]]:
    names: Sequence[str] = [s.name for s in mission.segments]
    tracks = {name: {s: found[name][s].centre.position[:, :2] for s in names} for name in (CV, CA)}
    tracks["graph"] = {s: result.trajectory[s].position[:, :2] for s in names}
    return tracks
