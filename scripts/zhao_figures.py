"""The figures of Zhao's paper again, with the graph in them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import zhao_plan as plans
import zhao_rows as tables
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter
from zhao_cases import LOST, SEED, Found, Lagged, Targets
from zhao_solve import smoothed

from ubl_graph.arrays import FloatArray
from ubl_graph.baselines import zhao_ekf
from ubl_graph.plots import COLOURS, GREY
from ubl_graph.sim import map_grid, zhao_runs, zhao_track
from ubl_graph.sim.zhao import TARGET_TIME
from ubl_graph.sim.zhao_fleet import NAMES

Draw = Callable[[Path], None]
#: Names in legends, colours and line styles.
STYLES: dict[str, dict[str, Any]] = {
    "plain": {"label": "plain (dead reckoning)", "color": GREY, "ls": ":"},
    "fused": {"label": "fused EKF", "color": COLOURS[1], "ls": "--"},
    "delayed": {"label": f"graph, {Lagged.lag:g} s late", "color": COLOURS[2], "ls": "-."},
    "graph": {"label": "graph, whole run", "color": COLOURS[0], "ls": "-"},
}
#: Errors of random targets are drawn larger so many times.
LARGER = 10.0
#: The whole of a run, s.
HOUR = 3600.0
#: Half the width of the maps, km.
WIDE = 10.0
#: Tracks are shown at the end within so far, m.
NEAR = 60.0


def figures(plan: plans.Plan, results: tables.Results) -> dict[str, Draw]:
    """Who draws each figure, by its name."""
    found = {name: results[case.group] for name, case in plans.groups(plan).items()}
    return {
        "fig5": tracks,
        "fig6": partial(own_errors, found),
        "fig7": partial(target_maps, found),
        "fig8": partial(two_masters, found),
        "fig9": partial(growth, found),
        "fig10": partial(random_targets, found),
    }


def tracks(path: Path) -> None:
    """Figure 5: one run's tracks, and their last minutes."""
    runs = zhao_runs(1, SEED, plans.SHORT)
    estimates = {name: zhao_ekf(runs.data, name) for name in ("plain", "fused")}
    result = smoothed(runs, 0, pairs=estimates["fused"].partner[0])
    figure = Figure(figsize=(10.0, 7.0), layout="constrained")
    panels = figure.subplot_mosaic("AAB;AAC;AAD")
    whole: Axes = panels["A"]
    for a, name in enumerate(NAMES):
        truth = runs.truth[:, a, :2]
        whole.plot(*truth.T / 1e3, color="black", lw=1.2)
        whole.plot(*truth[0] / 1e3, "o", color="black", ms=5)
        title = f"{name}, master" if a == 0 else name
        whole.annotate(title, truth[0] / 1e3, xytext=(8, 4), textcoords="offset points", fontsize=9)
        if a == 0:
            continue
        axes: Axes = panels["ABCD"[a]]
        places = {key: e.state[0, :, a, :2] for key, e in estimates.items()}
        places["graph"] = result.vehicles[name].trajectory.at(runs.data.t).position[:, :2]
        axes.plot(*(truth - truth[-1]).T, color="black", lw=2.0, label="truth")
        for key, place in places.items():
            axes.plot(*(place - truth[-1]).T, lw=1.2, **STYLES[key])
            axes.plot(*(place[-1] - truth[-1]), "o", color=STYLES[key]["color"], ms=4)
            whole.plot(*place.T / 1e3, lw=0.8, **({**STYLES[key], "label": None}))
        axes.set_xlim(-NEAR, NEAR)
        axes.set_ylim(-NEAR, NEAR)
        axes.set_aspect("equal")
        axes.set_title(f"{name}, about its end", fontsize=9, loc="left")
        axes.set_ylabel("north, m")
        axes.grid(alpha=0.3)
    panels["D"].set_xlabel("east, m")
    whole.set_aspect("equal", adjustable="datalim")
    whole.set_xlabel("east, km")
    whole.set_ylabel("north, km")
    whole.grid(alpha=0.3)
    handles, labels = panels["B"].get_legend_handles_labels()
    whole.legend(handles, labels, fontsize=9, loc="lower right")
    figure.suptitle(
        f"one run, ranging every {plans.SHORT.period:g} s with {plans.SHORT.range_sigma:g} m: "
        "tracks (dots: starts), and their ends",
        fontsize=10,
    )
    figure.savefig(path, dpi=130, format="png")


def own_errors(found: Mapping[str, Found], path: Path) -> None:
    """Figure 6: own errors over time, by system."""
    figure = Figure(figsize=(10.0, 6.5), layout="constrained")
    panels = figure.subplots(
        len(plans.BOTH), len(NAMES) - 1, sharex=True, sharey=True, squeeze=False
    )
    for line, settings in zip(panels, plans.BOTH, strict=True):
        title = plans.label(settings)
        filters = found[f"filters, {title}"]
        lagged, batch = found[f"lagged, {title}"], found[f"smoothed, {title}"]
        whole = settings.dt * np.arange(settings.steps + 1)
        epochs = np.arange(0.0, HOUR + 1.0, settings.period)
        late = epochs[epochs <= HOUR - Lagged.lag]
        curves = {
            "plain": (whole, filters.rms("own plain"), filters.runs),
            "fused": (whole, filters.rms("own fused"), filters.runs),
            "delayed": (late, lagged.rms("graph delayed"), lagged.runs),
            "graph": (whole, batch.rms("own graph"), batch.runs),
        }
        for a, axes in enumerate(line, start=1):
            for name, (t, errors, runs) in curves.items():
                label = f"{STYLES[name]['label']}, {runs} runs"
                axes.plot(t, errors[:, a], lw=1.3, **(STYLES[name] | {"label": label}))
            axes.set_title(
                f"{NAMES[a]}, every {settings.period:g} s with {settings.range_sigma:g} m",
                fontsize=9,
                loc="left",
            )
            axes.grid(alpha=0.3)
        line[0].set_ylabel("horizontal RMSE, m")
    for axes in panels[-1]:
        axes.set_xlabel("time, s")
    panels[0, 0].set_ylim(0.0, None)
    panels[0, 0].set_xlim(0.0, HOUR)
    panels[0, 0].legend(fontsize=8, loc="upper left")
    figure.savefig(path, dpi=130, format="png")


def target_maps(found: Mapping[str, Found], path: Path) -> None:
    """Figure 7: errors of a target, ranged once and each period."""
    filters = found[f"filters, {plans.label(plans.SHORT)}"]
    once, always = found["map, once"], found["map, always"]
    figure = Figure(figsize=(10.0, 9.0), layout="constrained")
    panels = figure.subplots(2, 3, sharex=True, sharey=True)
    draw_row(
        figure,
        panels[0],
        {
            f"plain, {filters.runs} runs": filters.rms("map plain"),
            f"fused EKF, {filters.runs} runs": filters.rms("map fused"),
            f"graph, {once.runs} runs": once.rms("graph"),
        },
        f"RMSE, ranged once at {TARGET_TIME:g} s, m",
    )
    theirs, ours = always.rms("filter"), always.rms("graph")
    draw_row(
        figure,
        panels[1, :2],
        {
            f"fused EKF, all ranging times, {always.runs} runs": theirs,
            f"graph, all ranging times, {always.runs} runs": ours,
        },
        "RMSE, ranged each period, m",
    )
    image = draw_map(panels[1, 2], theirs / ours, "EKF over graph", Normalize(), "times")
    figure.colorbar(image, ax=panels[1, 2], label="ratio of the two", location="bottom")
    finish_maps(panels)
    figure.suptitle(
        "RMSE of a target over where it is, each row with one scale; lines: the AUVs' tracks to "
        f"{TARGET_TIME:g} s",
        fontsize=10,
    )
    figure.savefig(path, dpi=130, format="png")


def two_masters(found: Mapping[str, Found], path: Path) -> None:
    """Figure 8: the same with two masters."""
    filters = found[f"two masters, {plans.label(plans.SHORT)}"]
    once = found["map, two masters"]
    figure = Figure(figsize=(10.0, 5.0), layout="constrained")
    panels = figure.subplots(1, 3, sharex=True, sharey=True, squeeze=False)
    draw_row(
        figure,
        panels[0],
        {
            f"EKF, {filters.runs} runs": filters.rms("map nearest_master"),
            f"EKF, the graph's {once.runs} runs": once.rms("filter"),
            f"graph, {once.runs} runs": once.rms("graph"),
        },
        f"RMSE, ranged once at {TARGET_TIME:g} s, m",
    )
    finish_maps(panels)
    figure.suptitle("two masters, AUV0 and AUV1; lines: the AUVs' tracks", fontsize=10)
    figure.savefig(path, dpi=130, format="png")


def draw_row(figure: Figure, panels: Any, maps: Mapping[str, FloatArray], label: str) -> None:
    """Maps side by side with one scale."""
    norm = Normalize(0.0, max(float(errors.max()) for errors in maps.values()))
    image = None
    for axes, (title, errors) in zip(panels, maps.items(), strict=True):
        image = draw_map(axes, errors, title, norm, "m")
    assert image is not None
    figure.colorbar(image, ax=panels, label=label, location="bottom", aspect=40)


def draw_map(axes: Axes, errors: FloatArray, title: str, norm: Normalize, unit: str) -> QuadMesh:
    """One map, its range in the title."""
    side = round(np.sqrt(len(errors)))
    places = map_grid(nodes=side).reshape(side, side, 2) / 1e3
    image = axes.pcolormesh(
        places[0, :, 0], places[:, 0, 1], errors.reshape(side, side), norm=norm, cmap="cividis"
    )
    axes.set_title(f"{title}\n{errors.min():.3g} to {errors.max():.3g} {unit}", fontsize=9)
    for a in range(len(NAMES)):
        track = zhao_track(a, round(TARGET_TIME / plans.SHORT.dt), plans.SHORT.dt)[:, :2] / 1e3
        axes.plot(*track.T, color="white", lw=1.0)
        axes.plot(*track[-1], "o", color="white", mec="black", ms=4)
    return image


def finish_maps(panels: Any) -> None:
    """Axes of maps."""
    for axes in panels.flat:
        axes.set_aspect("equal")
        axes.set_xlim(-WIDE, WIDE)
        axes.set_ylim(-WIDE, WIDE)
    for axes in panels[-1]:
        axes.set_xlabel("east, km")
    for axes in panels[:, 0]:
        axes.set_ylabel("north, km")


def growth(found: Mapping[str, Found], path: Path) -> None:
    """Figure 9: how errors grow with the noise of speed and yaw rate."""
    sweeps = (
        ("speed noise, m/s", plans.SPEEDS, "speed noise {:g} m/s"),
        ("yaw-rate noise, degrees/s", plans.YAW_RATES, "yaw-rate noise {:g} deg/s"),
    )
    figure = Figure(figsize=(10.0, 7.0), layout="constrained")
    panels = figure.subplots(2, 2, sharex="col")
    for (upper, lower), (label, x, name) in zip(panels.T, sweeps, strict=True):
        filters = [found[f"filters, {name.format(value)}"] for value in x]
        graph = [found[f"smoothed, {name.format(value)}"] for value in x]
        for system in ("plain", "fused"):
            errors = [tables.followers(f.rms(f"own {system}")).max() for f in filters]
            upper.plot(x, errors, marker="o", ms=4, **STYLES[system])
            maps = [f.rms(f"map {system}").max() for f in filters]
            lower.plot(x, maps, marker="o", ms=4, **STYLES[system])
            for value, error, here in zip(x, errors, filters, strict=True):
                lost = int((here.kept[f"largest {system}"] > LOST).sum())
                if lost and system == "fused":
                    text, place = f"{lost} lost", (value, 1.08 * error)
                    upper.annotate(text, place, fontsize=8, ha="center", va="bottom")
        errors = [tables.followers(f.rms("own graph")).max() for f in graph]
        upper.plot(x, errors, marker="o", ms=4, **STYLES["graph"])
        runs = f"{filters[0].runs} runs"
        upper.set_title(
            f"own position, largest RMSE; {runs}, graph {graph[0].runs}", fontsize=9, loc="left"
        )
        lower.set_title(
            f"target ranged once, largest RMSE on the map; {runs}", fontsize=9, loc="left"
        )
        lower.set_xlabel(label)
        for axes in (upper, lower):
            plain_logarithm(axes)
            low, high = axes.get_ylim()
            # Room for the legend.
            axes.set_ylim(low, high * (high / low) ** 0.35)
            axes.legend(fontsize=8, loc="upper left")
    for axes in panels[:, 0]:
        axes.set_ylabel("m")
    figure.savefig(path, dpi=130, format="png")


def plain_logarithm(axes: Axes) -> None:
    """A logarithmic axis upward with numbers that are no powers of ten."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    wide = high > 10.0 * low
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)) if wide else MaxNLocator(8))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3)


def random_targets(found: Mapping[str, Found], path: Path) -> None:
    """Figure 10: random targets, and how far off each is found."""
    figure = Figure(figsize=(11.0, 5.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    time = plans.TIMES[1]
    here = found[f"targets, {time:g} s"]
    targets = here.kept["graph"].shape[1]
    places = Targets(plans.NOISY, 0, 1, targets).places
    left.plot(*places.T / 1e3, "o", color="black", mfc="none", ms=7, label="target")
    for name, mark, size in (("plain", "^", 8), ("fused", "s", 6), ("graph", "o", 4)):
        drawn = places + LARGER * (here.kept[name][0] - places)
        style = STYLES[name]
        for place, there in zip(places, drawn, strict=True):
            left.plot(*np.array([place, there]).T / 1e3, color=style["color"], lw=0.8)
        label = "graph" if name == "graph" else style["label"]
        left.plot(*drawn.T / 1e3, mark, color=style["color"], ms=size, label=label)
    left.set_aspect("equal", adjustable="datalim")
    left.set_title(
        f"ranged once, at {time:g} s; one run, errors drawn {LARGER:g} times larger",
        fontsize=9,
        loc="left",
    )
    left.set_xlabel("east, km")
    left.set_ylabel("north, km")
    left.grid(alpha=0.3)
    left.legend(fontsize=8, ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.1))
    names = ("plain", "fused", "graph")
    for n, t in enumerate(plans.TIMES):
        errors = tables.target_errors(found[f"targets, {t:g} s"])
        for i, name in enumerate(names):
            style = STYLES[name]
            x = n + 0.25 * (i - 1)
            values = errors[name].ravel()
            jitter = np.linspace(-0.08, 0.08, len(values))
            right.plot(x + jitter, np.sort(values), ".", color=style["color"], ms=3)
            right.plot([x - 0.1, x + 0.1], [tables.rms(values)] * 2, color=style["color"], lw=2.5)
    plain_logarithm(right)
    # A few are found by chance to the centimetre.
    right.set_ylim(bottom=1.0)
    right.set_xticks(range(len(plans.TIMES)), [f"{t:g} s" for t in plans.TIMES])
    right.set_title("errors of all targets and runs, bars: rms", fontsize=9, loc="left")
    right.set_ylabel("horizontal error, m")
    figure.suptitle(
        f"random targets; noise {plans.NOISY.speed_sigma:g} m/s, "
        f"{plans.NOISY.yaw_rate_sigma_deg:g} degrees/s",
        fontsize=10,
    )
    figure.savefig(path, dpi=130, format="png")
