"""The rows of the Cao 2017 study's tables, of what its cases gave."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import cao2017_plan as plans
import numpy as np
from cao2017_cases import (
    ERRORS,
    Case,
    Found,
    GraphPasses,
    GraphTrack,
    MirrorMap,
    Passes,
    Trial,
    Unanchored,
    WindowMap,
    WindowPasses,
    closed_form_error,
)
from cao2017_plan import AXIS_ENDS, AXIS_WIDTH, METHODS, Plan, either_side
from paper_rows import Row

from ubl_graph.arrays import BoolArray, FloatArray

Solved: TypeAlias = Sequence[tuple[Case, Found]]

#: LM and Gauss-Newton count as the same within the larger of a share of the error and so much, m.
SAME_SHARE, SAME = 0.15, 0.3
#: What the paper prints: the errors at the axis ends are "up to" and "within" these, m; shares.
PAPER = {
    "gauss-newton, ends": {"forward": 200.0, "up": 10.0},
    "lm, ends": {"forward": 30.0, "right": 4.0, "up": 3.0},
    "unsolved": {"forward": 1.0, "right": 1.0, "up": 1.0},
    "same, middle": {"forward": 1.0},
    "least": {0.0: 10.0, 800.0: 5.0},
}


def maps(plan: Plan, solved: Solved) -> dict[str, Found]:
    """A2's errors (N, E), m, on both sides of the beacon: by velocity error, then by method."""
    north = either_side(plan.map_north)
    out: dict[str, Found] = {}
    for error in ERRORS:
        tracks = {
            case.north: found["graph"]
            for case, found in solved
            if isinstance(case, GraphTrack) and case.error == error
        }
        (windows,) = [
            found
            for case, found in solved
            if isinstance(case, WindowMap) and case.error == error and case.settings == METHODS
        ]
        graph = np.stack([tracks[n] if n in tracks else tracks[-n] for n in north])
        out[error] = {**windows, "graph": graph}
    return out


def rows(plan: Plan, solved: Solved) -> list[Row]:
    """All rows, table by table."""
    made = maps(plan, solved)
    out = closed_form_rows(plan, made)
    for error, found in made.items():
        out += map_rows(plan, error, found)
    out += dependence_rows(solved)
    out += mirror_rows(solved)
    for setting in plans.SETTINGS:
        for error in ("forward", "right"):
            out += draw_rows(plan, solved, setting, error)
    for trial in plans.TRIALS:
        out += trial_rows(solved, trial)
    return out


def row(
    table: str,
    case: str,
    quantity: str,
    unit: str | None,
    *,
    paper: float | None = None,
    baseline: float | None = None,
    graph: float | None = None,
) -> Row:
    """One row of the file."""
    numbers = {"paper": paper, "baseline": baseline, "graph": graph}
    return {
        "table": table,
        "case": case,
        "quantity": quantity,
        "unit": unit,
        **{name: None if v is None else float(v) for name, v in numbers.items()},
    }


def closed_form_rows(plan: Plan, made: Mapping[str, Found]) -> list[Row]:
    """How far the closed forms are from windows iterated to convergence, off the axis."""
    north, east = np.array(either_side(plan.map_north)), np.array(plan.map_east)
    # Within a window's length of the beacon's meridian, errors forward change sign.
    off = (np.abs(north) > 0.0)[:, None] & (np.abs(east) >= 200.0)[None, :]
    out: list[Row] = []
    for error, found in made.items():
        for name, title in (("gauss-newton", "Gauss-Newton"), ("lm converged", "converged LM")):
            share = closed_form_error(error, north, east) / found[name] - 1.0
            out.append(
                row(
                    "A1",
                    case_name(error),
                    f"closed form against {title}, largest share off the axis",
                    None,
                    baseline=np.abs(share[off]).max(),
                )
            )
    return out


def case_name(error: str) -> str:
    """A velocity error in words."""
    return f"{error} {1e3 * max(ERRORS[error]):g} mm/s"


def map_rows(plan: Plan, error: str, found: Found) -> list[Row]:
    """A2: errors at the axis ends, on the axis, over the map, where Gauss-Newton has an answer."""
    north, east = np.array(either_side(plan.map_north)), np.array(plan.map_east)
    weights = cells(north)[:, None] * cells(east)[None, :]
    axis = np.broadcast_to((north == 0.0)[:, None], weights.shape)
    ends = (np.abs(north) <= AXIS_WIDTH)[:, None] & (np.abs(east) >= AXIS_ENDS)[None, :]
    newton, marquardt, graph = found["gauss-newton"], found["lm"], found["graph"]
    solved = np.isfinite(newton)
    case, out = case_name(error), list[Row]()

    def compare(title: str, name: str, chosen: BoolArray, paper: float | None = None) -> None:
        numbers = [float(e[chosen].max()) for e in (found[name], graph)]
        out.append(row("A2", case, title, "m", paper=paper, baseline=numbers[0], graph=numbers[1]))

    ends_of = "axis ends, largest"
    paper = PAPER["gauss-newton, ends"].get(error)
    compare(f"Gauss-Newton, {ends_of} (paper: up to)", "gauss-newton", ends & solved, paper)
    paper = PAPER["lm, ends"].get(error)
    compare(f"LM, {ends_of} (paper: within)", "lm", ends, paper)
    compare(f"converged LM, {ends_of}", "lm converged", ends)
    compare("LM, axis, largest", "lm", axis)
    compare("LM, map, largest", "lm", np.ones_like(solved))
    for name, title, chosen in (
        ("lm", "LM", np.ones_like(solved)),
        ("lm converged", "converged LM", np.ones_like(solved)),
        ("gauss-newton", "Gauss-Newton", solved),
    ):
        means = [
            float(np.average(e[chosen], weights=weights[chosen])) for e in (found[name], graph)
        ]
        out.append(row("A2", case, f"{title}, map, mean", "m", baseline=means[0], graph=means[1]))
    out.append(
        row(
            "A2",
            case,
            "Gauss-Newton, share of axis nodes without a solution",
            None,
            paper=PAPER["unsolved"][error],
            baseline=1.0 - solved[axis].mean(),
            graph=1.0 - np.isfinite(graph[axis]).mean(),
        )
    )
    same = np.abs(marquardt - newton) <= np.maximum(SAME_SHARE * newton, SAME)
    middle = solved & (np.abs(east) <= 1000.0)[None, :]
    for title, chosen, paper in (
        ("map", solved, None),
        ("map, 1 km either way", middle, PAPER["same, middle"].get(error)),
    ):
        share = float(np.average(same[chosen], weights=weights[chosen]))
        title = f"share of nodes where LM is Gauss-Newton, {title}"
        out.append(row("A2", case, title, None, paper=paper, baseline=share))
    return out


def cells(places: FloatArray) -> FloatArray:
    """Widths that places on a line stand for, so that a coarse map has the mean of a fine one."""
    return np.gradient(places)


def dependence_rows(solved: Solved) -> list[Row]:
    """A2: what LM's errors at the axis ends depend on, and Gauss-Newton's on the grid's step."""
    out: list[Row] = []
    for error in ERRORS:
        for case, found in solved:
            if not isinstance(case, WindowMap) or case.error != error or case.settings == METHODS:
                continue
            for name, _ in case.settings:
                title = name if name.startswith("Gauss") else f"LM, {name}"
                number = np.nanmax(found[name])
                out.append(
                    row(
                        "A2 dependence",
                        case_name(error),
                        f"{title}, axis ends, largest",
                        "m",
                        baseline=number,
                    )
                )
    return out


def mirror_rows(solved: Solved) -> list[Row]:
    """Where windows end that begin on the wrong side, and what the graph says without a start."""
    (found,) = [found for case, found in solved if isinstance(case, MirrorMap)]
    out: list[Row] = []
    for name, title in (
        ("lm", "LM"),
        ("lm converged", "converged LM"),
        ("gauss-newton", "Gauss-Newton"),
    ):
        for place in ("mirror", "truth"):
            where = "at the mirror image" if place == "mirror" else "at the truth"
            number = float(found[f"{name}, {place}"])
            title_of = f"{title}, of {int(found['nodes'])} nodes begun on the wrong side, {where}"
            out.append(row("A2 mirror", "no error", title_of, None, baseline=number))
    named = [float(f["ambiguous"]) for case, f in solved if isinstance(case, Unanchored)]
    title = "one beacon, DVL, straight, no start: share of passes that the report calls ambiguous"
    return [*out, row("A2 mirror", "no error", title, None, graph=np.mean(named))]


def draw_rows(
    plan: Plan, solved: Solved, setting: tuple[float, float, float], error: str
) -> list[Row]:
    """A3: mean and largest over the map of each node's error, averaged over the draws."""
    start, ranging, noise = setting
    graph = [
        found["graph"]
        for case, found in solved
        if isinstance(case, GraphPasses) and is_of(case, setting, error)
    ]
    (windows,) = [
        {name: found[f"{name}, {number}"] for name in ("lm", "lm converged", "dead reckoning")}
        for case, found in solved
        if isinstance(case, WindowPasses)
        for number, part in enumerate(case.parts)
        if is_of(part, setting, error)
    ]
    shape = (-1, len(plan.draw_north), len(plan.draw_east))
    drawn = {**windows, "graph": np.concatenate(graph)}
    means = {name: errors.reshape(shape).mean(axis=0) for name, errors in drawn.items()}
    north = np.array(plan.draw_north)
    # Of a map on both sides of the beacon all but the axis is there twice.
    width = cells(np.array(either_side(plan.draw_north)))[-len(north) :]
    width = width * np.where(north > 0.0, 2.0, 1.0)
    weights = width[:, None] * cells(np.array(plan.draw_east))[None, :]
    noisy = f"start {start:g} m, range {ranging:g} m" if noise else "exact start and ranges"
    case = f"{noisy}, {case_name(error)}"
    out: list[Row] = []
    for name, title in (
        ("lm", "LM"),
        ("lm converged", "converged LM"),
        ("dead reckoning", "dead reckoning"),
    ):
        for what, number in (
            ("map, mean", lambda e: float(np.average(e, weights=weights))),
            ("map, largest mean of the draws", lambda e: float(e.max())),
            ("axis, largest mean of the draws", lambda e: float(e[north == 0.0].max())),
        ):
            numbers = number(means[name]), number(means["graph"])
            out.append(
                row("A3", case, f"{title}, {what}", "m", baseline=numbers[0], graph=numbers[1])
            )
    return out


def is_of(passes: Passes, setting: tuple[float, float, float], error: str) -> bool:
    """Whether passes belong to a setting of noise and starts, and to an error of the velocity."""
    mine = (passes.start_sigma, passes.range_sigma, passes.noise)
    return mine == setting and passes.error == error


def trial_rows(solved: Solved, trial: tuple[float, float]) -> list[Row]:
    """A4: errors of fixes over all runs, beside the graph's at the same pings."""
    north, calibration = trial
    found = [
        f
        for case, f in solved
        if isinstance(case, Trial) and (case.north, case.calibration) == trial
    ]
    runs = {name: np.stack([f[name] for f in found]) for name in found[0]}
    where = "through the beacon" if north == 0.0 else f"{north:g} m off"
    case, out = f"{where}, calibration {calibration:g} m", list[Row]()
    newton, marquardt = runs["gauss-newton"], runs["lm"]
    solved_by = np.isfinite(newton)
    distance = np.abs(runs["truth"][:, :, 0])

    def rms(errors: FloatArray) -> float:
        return float(np.sqrt(np.mean(errors**2)))

    def add(title: str, baseline: float, graph: float, paper: float | None = None) -> None:
        out.append(row("A4", case, title, "m", paper=paper, baseline=baseline, graph=graph))

    unsolved = "Gauss-Newton, share of pings without a solution"
    paper = 1.0 if north == 0.0 else 0.0
    share = float(1.0 - solved_by.mean())
    missing = float(1.0 - np.isfinite(runs["graph"]).mean())
    out.append(row("A4", case, unsolved, None, paper=paper, baseline=share, graph=missing))
    for name, title in (("graph", "now"), ("graph, whole track", "whole track")):
        graph = runs[name]
        for what, number in (("rms", rms), ("median", lambda e: float(np.median(e)))):
            beside = f"{what} (graph: {title})"
            add(f"Gauss-Newton, {beside}", number(newton[solved_by]), number(graph[solved_by]))
            add(f"LM, {beside}", number(marquardt), number(graph))
    graph = runs["graph"]
    for what, least, paper in (
        ("least of a run", np.min, PAPER["least"][north]),
        ("largest of a run", np.max, None),
    ):
        numbers = (float(np.median(least(e, axis=1))) for e in (marquardt, graph))
        add(f"LM, {what}, median over the runs", *numbers, paper)
    for low, high in ((0.0, 300.0), (300.0, 600.0), (600.0, 1e9)):
        near = (distance >= low) & (distance < high)
        name = f"{low:g} to {high:g} m" if high < 1e9 else f"beyond {low:g} m"
        add(f"LM, rms {name} from the beacon", rms(marquardt[near]), rms(graph[near]))
    return out
