"""The figures of Cao 2017 again: error maps (3 to 5), and errors along a pass (8 and 9)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import cao2017_plan as plans
import cao2017_rows as tables
import numpy as np
from cao2017_cases import ERRORS, Found, Trial
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from ubl_graph.plots import COLOURS, GREY

#: Figure of the paper, by velocity error, and by distance of the track from the beacon, m.
MAPS = {"forward": 3, "right": 4, "up": 5}
PASSES = {0.0: 8, 800.0: 9}
#: Name in the legend, colour and mark of each method.
METHODS = {
    "gauss-newton": ("Gauss-Newton", GREY, "o"),
    "lm": ("LM, three trials", COLOURS[1], "*"),
    "graph": ("graph, pings so far", COLOURS[0], "."),
    "graph, whole track": ("graph, whole track", COLOURS[2], "."),
}
#: Errors on the maps are drawn from here to there, m; smaller and larger ones have its ends' hues.
LEAST, MOST = 0.01, 200.0


def figures(plan: plans.Plan, solved: tables.Solved) -> dict[str, Callable[[Path], None]]:
    """Who draws each figure, by its name."""
    made = tables.maps(plan, solved)
    out: dict[str, Callable[[Path], None]] = {
        f"figure{MAPS[error]}": partial(draw_map, plan, error, made[error]) for error in ERRORS
    }
    calibration = plans.TRIALS[0][1]
    for north, number in PASSES.items():
        found = [
            f
            for case, f in solved
            if isinstance(case, Trial) and (case.north, case.calibration) == (north, calibration)
        ]
        out[f"figure{number}"] = partial(draw_pass, north, found)
    return out


def draw_map(plan: plans.Plan, error: str, found: Found, path: Path) -> None:
    """Errors of Gauss-Newton, LM and the graph over the working area, as colours."""
    figure = Figure(figsize=(13.0, 5.2), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    east, north = np.array(plan.map_east), np.array(plans.either_side(plan.map_north))
    norm = LogNorm(LEAST, MOST)
    image = None
    for axes, name in zip(panels, ("gauss-newton", "lm", "graph"), strict=True):
        errors = found[name]
        axes.set_facecolor("white")
        # A map of zeros has no logarithm.
        image = axes.pcolormesh(
            east / 1e3, north / 1e3, np.maximum(errors, LEAST / 10.0), norm=norm, cmap="cividis"
        )
        missing = int(np.isnan(errors).sum())
        axes.plot(0.0, 0.0, "^", color="white", mec="black", ms=8)
        title = METHODS[name][0]
        title += f"\nlargest {np.nanmax(errors):.3g} m"
        if missing:
            title += f"; white: no solution ({missing} of {errors.size} nodes)"
        axes.set_title(title, fontsize=9)
        axes.set_xlabel("east, km")
        axes.set_aspect("equal")
        axes.set_xlim(east[0] / 1e3, east[-1] / 1e3)
        axes.set_ylim(north[0] / 1e3, north[-1] / 1e3)
    panels[0].set_ylabel("north, km")
    assert image is not None
    bar = figure.colorbar(image, ax=panels, extend="both", pad=0.01, format=FuncFormatter(_plain))
    bar.set_label("horizontal error, m")
    figure.suptitle(
        f"Cao 2017, Figure {MAPS[error]}: velocity measured {1e3 * max(ERRORS[error]):g} mm/s too "
        f"large {'to the right' if error == 'right' else error}, exact start and ranges; "
        "track eastward, triangle: beacon",
        fontsize=10,
    )
    figure.savefig(path, dpi=130, format="png")


def draw_pass(north: float, found: Sequence[Found], path: Path) -> None:
    """A run's fixes on a map, and the errors of all runs along the track."""
    figure = Figure(figsize=(9.0, 8.5), layout="constrained")
    above, below = figure.subplots(2, 1, height_ratios=(2, 3))
    _places(above, found[0])
    _errors(below, found)
    where = "through the beacon" if north == 0.0 else f"{north:g} m off the beacon"
    figure.suptitle(
        f"Cao 2017, Figure {PASSES[north]}, simulated: a pass {where}, beacon calibrated to "
        f"{plans.TRIALS[0][1]:g} m",
        fontsize=10,
    )
    figure.savefig(path, dpi=130, format="png")


def _places(axes: Axes, run: Found) -> None:
    axes.plot(*run["truth"].T, color="black", lw=1.0, label="truth")
    for name, (label, colour, mark) in METHODS.items():
        if name == "graph, whole track":
            continue
        face = "none" if mark == "o" else colour
        axes.plot(*run[f"{name}, place"].T, mark, color=colour, mfc=face, ms=6, label=label)
    north = float(run["truth"][0, 1])
    if north == 0.0:
        axes.plot(0.0, 0.0, "^", color="black", ms=8, label="beacon")
    title = "one run" if north == 0.0 else f"one run; the beacon is {north:g} m south of the track"
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    axes.set_title(title, fontsize=9, loc="left")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, ncols=5, loc="upper center", bbox_to_anchor=(0.5, -0.16))


def _errors(axes: Axes, found: Sequence[Found]) -> None:
    east = found[0]["truth"][:, 0]
    for name, (label, colour, mark) in METHODS.items():
        errors = np.stack([run[name] for run in found])
        solved = np.isfinite(errors)
        count = solved.sum(axis=0)
        total = np.where(solved, errors, 0.0) ** 2
        rms = np.sqrt(total.sum(axis=0) / np.where(count > 0, count, np.nan))
        share = solved.mean()
        if share < 1.0:
            label += f", {share:.0%} solved"
        style = "--" if name == "gauss-newton" else "-"
        axes.semilogy(east, rms, style, color=colour, marker=mark, ms=4, lw=1.2, label=label)
    axes.set_xlabel("east, m")
    axes.set_ylabel("horizontal error, m")
    axes.set_title(
        f"root mean square over {len(found)} runs, each with a beacon error of its own",
        fontsize=9,
        loc="left",
    )
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(_plain))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def _plain(value: float, _place: float | None = None) -> str:
    """A tick's number without powers of ten."""
    return f"{value:g}"
