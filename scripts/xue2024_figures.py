"""The figures of Xue et al. 2024 again, with the graph in them.

One seed of each track; window lengths are those of the table, over all seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from xue2024_cases import BY_LIKELIHOOD, MODELS, Case, passing, simulated, squared, windows
from xue2024_rows import CA, CV, EFFECTIVE, FIG5, PASSING, SPACE, STATED, TRACKS
from xue2024_rows import passing as name_of_passing

from ubl_graph.arrays import FloatArray
from ubl_graph.mission import Mission
from ubl_graph.plots import COLOURS, GREY
from ubl_graph.smoother import smooth

Draw = Callable[[Path], None]
#: Colours, line styles and marks of the paper's models and of the graph.
STYLES: dict[str, dict[str, Any]] = {
    SPACE: {"color": COLOURS[3], "ls": ":", "marker": "^"},
    CV: {"color": COLOURS[1], "ls": "--", "marker": "s"},
    CA: {"color": COLOURS[2], "ls": "-.", "marker": "D"},
    "graph": {"color": COLOURS[0], "ls": "-", "marker": "o"},
}
#: Of the tracks.
TRACK_COLOURS = dict(zip(TRACKS, COLOURS, strict=False))
SEED = 1


def simulated_figures(rows: Sequence[Mapping[str, Any]]) -> dict[str, Draw]:
    """What is drawn of the simulations, by file name."""
    return {
        "fig2_dop_and_error": dop_and_error,
        "fig4_trdop": trdop,
        "fig5_window_length": partial(window_length, rows),
        "fig7_tracks": tracks,
    }


def recorded_figures(
    mission: Mission, found: Mapping[str, Mapping[str, FloatArray]]
) -> dict[str, Draw]:
    """What is drawn of recorded lines, by file name."""
    return {"fig7_lines": partial(lines, mission, found)}


def dop_and_error(path: Path) -> None:
    """Figure 2: dilutions and errors over time where a track leaves the net."""
    case = Case("correlation", name_of_passing(PASSING[1]), STATED, SEED)
    mission, truth = passing(case)
    figure = Figure(figsize=(9.0, 6.0), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True)
    for column, model in enumerate((CV, CA)):
        found = windows(mission, truth, MODELS[model])
        t = found.centre.t
        errors = (
            ("position", "m", np.sqrt(squared(truth, t, found.centre.position)), "PDOP"),
            (
                "velocity",
                "m/s",
                np.hypot(*(found.velocity - truth.velocity(t)[:, :2]).T),
                "VDOP",
            ),
        )
        for power, (what, unit, error, name) in enumerate(errors):
            axes: Axes = panels[power, column]
            axes.plot(t, error, ".", color=STYLES[model]["color"], ms=4)
            axes.set_ylabel(f"{what} error, {unit}")
            axes.set_ylim(bottom=0.0)
            right = axes.twinx()
            right.plot(t, found.dop[:, power], color="black", lw=1.4)
            right.set_ylabel(name)
            right.set_ylim(bottom=0.0)
            r = np.corrcoef(error, found.dop[:, power])[0, 1]
            axes.set_title(f"{model}: correlation {r:.2f}", fontsize=9, loc="left")
            axes.grid(alpha=0.3)
        panels[1, column].set_xlabel("time, s")
    figure.suptitle(
        "errors at the windows' centres (dots) and dilutions (lines), 4 m/s eastward from "
        f"{PASSING[1]:g} m, noise {1e3 * STATED:g} ms",
        fontsize=10,
    )
    figure.savefig(path, dpi=130, format="png")


def trdop(path: Path) -> None:
    """Figure 4: TRDOP over time, by model and track."""
    figure = Figure(figsize=(9.0, 7.0), layout="constrained")
    panels = figure.subplots(len(MODELS), 1, sharex=True)
    for track in TRACKS:
        mission, truth = simulated(Case("", track, STATED, SEED), BY_LIKELIHOOD)
        for axes, model in zip(panels, MODELS, strict=True):
            found = windows(mission, truth, MODELS[model])
            mean = float(found.trdop.mean())
            style = ("-", "--", "-.")[TRACKS.index(track)]
            axes.plot(
                found.centre.t,
                found.trdop,
                color=TRACK_COLOURS[track],
                ls=style,
                lw=1.3,
                label=f"{track}, mean {mean:.3f}",
            )
    for axes, model in zip(panels, MODELS, strict=True):
        axes.set_title(model, fontsize=9, loc="left")
        axes.set_ylabel("TRDOP")
        axes.grid(alpha=0.3)
        low, high = axes.get_ylim()
        axes.set_ylim(low, high + 0.25 * (high - low))
        axes.legend(fontsize=8, ncols=3, loc="upper center")
    panels[-1].set_xlabel("time at the window's centre, s")
    figure.savefig(path, dpi=130, format="png")


def window_length(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Figure 5: errors over the window's length, and of the graph with a lag as long."""
    mine = {
        (r["case"].split(", ")[0], int(r["case"].split(", ")[1].split()[0]), r["quantity"]): r
        for r in rows
        if r["table"] == "Fig. 5"
    }
    seconds = [10 * pings for pings in FIG5]
    figure = Figure(figsize=(9.0, 4.5), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, model in zip(panels, (CV, CA), strict=True):
        for epoch, filled in (("centre", True), ("current", False)):
            for column, name in (("baseline", model), ("graph", "graph")):
                values = [mine[model, s, epoch][column] for s in seconds]
                style = STYLES[name] | {"mfc": STYLES[name]["color"] if filled else "white"}
                drawn = [np.nan if v is None else v for v in values]
                label = f"{'windows' if column == 'baseline' else 'graph'}, {epoch}"
                axes.semilogy(seconds, drawn, ms=5, lw=1.3, label=label, **style)
        axes.set_title(model, fontsize=9, loc="left")
        axes.set_xlabel("window, and lag of the graph, s")
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize=8)
    panels[0].set_ylabel("horizontal RMSE, m")
    figure.suptitle("accelerating track, noise 1 ms", fontsize=10)
    figure.savefig(path, dpi=130, format="png")


def tracks(path: Path) -> None:
    """Figures 3 and 7: the tracks, and errors along them."""
    figure = Figure(figsize=(10.0, 9.0), layout="constrained")
    panels = figure.subplots(len(TRACKS), 2, width_ratios=(2, 3))
    for (left, right), track in zip(panels, TRACKS, strict=True):
        mission, truth = simulated(Case("", track, EFFECTIVE, SEED), BY_LIKELIHOOD)
        t = np.arange(0.0, 1003.0, 2.0)
        left.plot(*truth.position(t)[:, :2].T, color="black", lw=1.0)
        for beacon in mission.beacons:
            left.plot(*beacon.position[:2], "^", color="black", ms=6)
        for model in (CV, CA):
            fixes = windows(mission, truth, MODELS[model]).centre
            left.plot(
                *fixes.position[:, :2].T, color=STYLES[model]["color"], ls="", marker=".", ms=3
            )
            error = np.sqrt(squared(truth, fixes.t, fixes.position))
            _errors(right, fixes.t, error, model, f"window, {model}, centre")
        result = smooth(mission)
        position = result.trajectory.at(t).position
        left.plot(*position[:, :2].T, color=STYLES["graph"]["color"], lw=1.2)
        error = np.sqrt(squared(truth, t, position))
        _errors(
            right, t, error, "graph", f"graph, {result.mission.options.motion.replace('_', ' ')}"
        )
        left.set_aspect("equal", adjustable="datalim")
        left.set_title(track, fontsize=9, loc="left")
        left.set_xlabel("east, m")
        left.set_ylabel("north, m")
        right.set_ylabel("horizontal error, m")
        right.legend(fontsize=8, loc="best")
        for axes in (left, right):
            axes.grid(alpha=0.3)
    panels[-1, 1].set_xlabel("time, s")
    figure.suptitle(
        f"tracks with beacons (triangles), and errors; noise {1e3 * EFFECTIVE:g} ms", fontsize=10
    )
    figure.savefig(path, dpi=130, format="png")


def _errors(axes: Axes, t: FloatArray, error: FloatArray, name: str, label: str) -> None:
    style = STYLES[name]
    axes.semilogy(t, error, color=style["color"], ls=style["ls"], lw=1.1, label=label)
    axes.set_ylim(1e-2, 1.5e2)


def lines(mission: Mission, found: Mapping[str, Mapping[str, FloatArray]], path: Path) -> None:
    """Figure 7: windows, graph and reference of each recorded line, along and across it."""
    segments = [s for s in mission.segments if s.reference is not None]
    figure = Figure(figsize=(10.0, 1.0 + 1.7 * len(segments)), layout="constrained")
    panels = figure.subplots(len(segments), 1, squeeze=False)[:, 0]
    for axes, segment in zip(panels, segments, strict=True):
        assert segment.reference is not None
        place = segment.reference.position[:, :2]
        origin, along = place[0], place[-1] - place[0]
        along = along / np.hypot(*along)
        turn = np.array([along, [-along[1], along[0]]]).T
        for name in (CV, CA, "graph"):
            x, y = ((found[name][segment.name] - origin) @ turn).T
            style = STYLES[name]
            label = name if name == "graph" else f"window, {name}"
            axes.plot(x, y, color=style["color"], ls=style["ls"], lw=1.1, label=label)
        x, y = ((place - origin) @ turn).T
        axes.plot(x, y, color=GREY, lw=2.5, alpha=0.5, zorder=1, label="reference")
        axes.set_title(segment.name, fontsize=9, loc="left")
        axes.set_ylabel("across, m")
        axes.grid(alpha=0.3)
    panels[0].legend(fontsize=8, ncols=4)
    panels[-1].set_xlabel("along the line, m")
    figure.suptitle(f"{mission.name or 'mission'}: tracks along and across each line", fontsize=10)
    figure.savefig(path, dpi=130, format="png")
