"""Figures of a survey: map, residuals, and the water."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ubl_graph.arrays import FloatArray
from ubl_graph.drawing import (
    COLOURS,
    GREY,
    RED,
    draw_ellipses,
    draw_residuals,
    ellipse_factor,
    residual_limit,
    residual_title,
    typical_sigma,
)
from ubl_graph.nodes import NOMINAL_SPEED
from ubl_graph.survey import SurveyResult

#: Places of the track that are drawn, at the most.
MOST_PLACES = 5000


def save_all(result: SurveyResult, folder: Path) -> None:
    """Draw every figure that the result has data for into `folder` as PNG."""
    figures = {"survey": survey_map(result), "residuals": residuals(result)}
    if "sound_speed" in result.slow:
        figures["sound_speed"] = water(result)
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png", dpi=130)


def survey_map(result: SurveyResult) -> Figure:
    """Map of the track and the beacons, with 95 % ellipses, enlarged so that they can be seen."""
    figure = Figure(figsize=(8.0, 7.0), layout="constrained")
    axes = figure.subplots()
    step = max(1, len(result.track) // MOST_PLACES)
    axes.plot(*result.track[::step, :2].T, ".", color=GREY, ms=1.5, label="vehicle")
    places = np.concatenate([result.track, [b.position for b in result.mission.beacons]])
    starts = range(0, 3 * len(result.names), 3)
    own = np.array([result.covariance[i : i + 3, i : i + 3] for i in starts]).reshape(-1, 3, 3)
    factor = ellipse_factor(places, typical_sigma(own)) if len(own) else 1.0
    by_name = {b.name: b for b in result.beacons}
    for i, name in enumerate(by_name):
        given = next(b.position for b in result.mission.beacons if b.name == name)
        label = None if i else "given"
        axes.plot(*given[:2], "+", color=RED, ms=9, mew=1.5, label=label, zorder=4)
    for i, place in enumerate(result.position):
        east, north = place[:2]
        axes.plot(east, north, "^", color="black", ms=6, label=None if i else "found", zorder=5)
    for name, beacon in by_name.items():
        text = axes.annotate(
            name, beacon.position[:2], xytext=(8, 8), textcoords="offset points", zorder=6
        )
        text.set(fontsize=9, bbox={"fc": "white", "alpha": 0.7, "lw": 0, "pad": 1})
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    draw_ellipses(axes, result.position, own, factor, COLOURS[0])
    drawn = f"\n95 % ellipses, drawn {factor:g} times as large" if len(result.names) else ""
    axes.set_title(f"{_title(result)}{drawn}", fontsize=10)
    axes.legend(fontsize=8, loc="best")
    return figure


def residuals(result: SurveyResult) -> Figure:
    """Range residuals over time, one panel a beacon; down-weighted ranges are marked.

    Travel times are in milliseconds, slant ranges in metres.
    """
    table = result.residuals
    names = [n for n in result.mission.beacon_names if (table.beacon == n).any()]
    slant = bool((table.kind == "slant").all())
    factor, unit = (NOMINAL_SPEED, "m") if slant else (1e3, "ms")
    limit = factor * residual_limit(table, np.full(len(table), True))
    figure = Figure(figsize=(9.0, 1.2 + 1.6 * len(names)), layout="constrained")
    panels = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for axes, name in zip(panels, names, strict=True):
        mine = table.beacon == name
        draw_residuals(axes, table, mine, factor, limit)
        title = residual_title(name, table, mine, factor, unit)
        axes.set_title(title, fontsize=9, loc="left")
        axes.set_ylabel(f"model - {'range' if slant else 'ping'}, {unit}", fontsize=8)
    panels[0].legend(
        ncols=2, fontsize=8, frameon=False, loc="lower right", bbox_to_anchor=(1.0, 1.0)
    )
    panels[-1].set_xlabel("time, s")
    figure.suptitle(_title(result), fontsize=10)
    return figure


def water(result: SurveyResult) -> Figure:
    """Sound speed and its horizontal gradients over time, each with one standard deviation."""
    speed = _mean_speed(result)
    parts: list[tuple[str, str, float, tuple[str, ...]]] = [
        ("sound_speed", "correction,\nm/s", -speed, ("",)),
        ("vehicle_gradient", "gradient by vehicle,\nm/s per km", -1e3 * speed, ("east", "north")),
        ("beacon_gradient", "gradient by beacon,\nm/s per km", -1e3 * speed, ("east", "north")),
    ]
    parts = [part for part in parts if part[0] in result.slow]
    figure = Figure(figsize=(9.0, 1.0 + 2.1 * len(parts)), layout="constrained")
    panels = figure.subplots(len(parts), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, label, factor, components) in zip(panels, parts, strict=True):
        state = result.slow[name]
        for c, component in enumerate(components):
            for piece in _unbroken(state.t, result.options.knot_spacing):
                t, value = state.t[piece], factor * state.value[piece, c]
                sigma = abs(factor) * state.sigma[piece, c]
                text = component if component and not piece.start else None
                colour = COLOURS[c]
                axes.fill_between(t, value - sigma, value + sigma, color=colour, alpha=0.25, lw=0)
                axes.plot(t, value, color=colour, lw=1.2, ls="-" if c == 0 else "--", label=text)
        axes.set_ylabel(label, fontsize=8)
        axes.axhline(0.0, color=GREY, lw=0.8)
        axes.grid(alpha=0.3)
        if len(components) > 1:
            axes.legend(fontsize=8, ncols=2)
    panels[-1].set_xlabel("time, s")
    figure.suptitle(
        f"{_title(result)}: sound speed, estimate and one standard deviation", fontsize=10
    )
    return figure


def _unbroken(t: FloatArray, spacing: float) -> list[slice]:
    """Runs of knots between which there is no gap."""
    cuts = np.flatnonzero(np.diff(t) > 1.5 * spacing) + 1
    ends = [0, *cuts.tolist(), len(t)]
    return [slice(a, b) for a, b in pairwise(ends)]


def _mean_speed(result: SurveyResult) -> float:
    """Harmonic-mean speed between the vehicle's typical depth and the beacons', m/s."""
    depth = -float(np.median(result.track[:, 2]))
    bottom = -float(np.mean([b.position[2] for b in result.beacons]))
    return float(result.mission.sound_speed.harmonic_mean(depth, bottom))


def _title(result: SurveyResult) -> str:
    name = f"{result.mission.name or 'mission'}: beacon survey"
    return name if result.status == "converged" else f"{name} ({result.status})"
