"""One function a figure. Every function takes a Result and gives a matplotlib Figure.

Colours are Okabe and Ito's, which colour-blind readers tell apart; line styles and marks differ
too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from ubl_graph.arrays import FloatArray
from ubl_graph.evaluation import evaluate
from ubl_graph.result import Result, SegmentResult
from ubl_graph.trajectory import Trajectory

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C6D1F")
GREY, RED = "#7F7F7F", "#B2182B"
#: Tracks by their name, to draw beside the smoothed one.
Beside = Mapping[str, Sequence[Trajectory]]
#: Axis label, factor from SI, per component of a slow state.
SLOW_LABELS = {
    "clock_offset": (("clock offset, ms", 1e3),),
    "clock_drift": (("clock drift, ppm", 1e6),),
    "current": (("current east, m/s", 1.0), ("current north, m/s", 1.0)),
}
#: 95 % of a two-dimensional normal distribution lie within so many standard deviations.
ELLIPSE_95 = 2.4477


def save_all(result: Result, folder: Path, beside: Beside | None = None) -> None:
    """Draw every figure that the result has data for into `folder` as PNG."""
    figures: dict[str, Figure] = {"track": track(result, beside)}
    if result.residuals is not None:
        figures["residuals"] = residuals(result)
    for name in dict.fromkeys(name for s in result.segments for name in s.slow):
        figures[name] = slow_state(result, name)
    if evaluate(result):
        figures["errors"] = errors(result)
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png", dpi=130)


def track(result: Result, beside: Beside | None = None) -> Figure:
    """Map of the smoothed track with 95 % ellipses, beacons, and the reference where known.

    Parameters
    ----------
    result : Result
        What to draw.
    beside : mapping of str to sequence of Trajectory, optional
        Further tracks by their name in the legend.
    """
    figure = Figure(figsize=(8.0, 7.0), layout="constrained")
    axes = figure.subplots()
    _draw_reference(axes, result)
    enlarged = _ellipse_factor(result)
    for i, segment in enumerate(result.segments):
        colour = COLOURS[i % len(COLOURS)]
        east, north = segment.trajectory.position[:, :2].T
        label = segment.name or "smoothed"
        axes.plot(east, north, color=colour, lw=1.4, label=label, zorder=3)
        _draw_ellipses(axes, segment, enlarged, colour)
    for name, tracks in (beside or {}).items():
        for i, other in enumerate(tracks):
            label = None if i else name
            axes.plot(*other.position[:, :2].T, color=RED, lw=1.0, ls="-.", label=label, zorder=2)
    _draw_beacons(axes, result)
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    drawn = "95 % ellipses" + (f", drawn {enlarged:g} times as large" if enlarged > 1 else "")
    axes.set_title(f"{_title(result)}\n{drawn}", fontsize=10)
    axes.legend(fontsize=8, loc="best")
    return figure


def residuals(result: Result) -> Figure:
    """Travel-time residuals over time, one panel a beacon; down-weighted pings are marked."""
    table = result.residuals
    assert table is not None
    names = list(dict.fromkeys(str(b) for b in result.mission.beacon_names if b in table.beacon))
    figure = Figure(figsize=(9.0, 1.2 + 1.6 * len(names)), layout="constrained")
    panels = figure.subplots(len(names), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for axes, name in zip(panels, names, strict=True):
        mine = table.beacon == name
        kept, out = mine & ~table.down_weighted, mine & table.down_weighted
        axes.plot(
            table.t_transmit[kept],
            1e3 * table.residual[kept],
            ".",
            color=COLOURS[0],
            ms=3,
            label="used",
        )
        axes.plot(
            table.t_transmit[out],
            1e3 * table.residual[out],
            "x",
            color=RED,
            ms=6,
            label="down-weighted",
        )
        rms = 1e3 * float(np.sqrt(np.mean(table.residual[kept] ** 2))) if kept.any() else 0.0
        axes.set_title(
            f"{name}: {int(mine.sum())} pings, {int(out.sum())} down-weighted, rms {rms:.3f} ms",
            fontsize=9,
            loc="left",
        )
        axes.axhline(0.0, color=GREY, lw=0.8)
        axes.set_ylabel("model - ping, ms", fontsize=8)
        axes.grid(alpha=0.3)
    panels[0].legend(fontsize=8, loc="upper right")
    panels[-1].set_xlabel("time, s")
    figure.suptitle(_title(result), fontsize=10)
    return figure


def slow_state(result: Result, name: str) -> Figure:
    """A slow state over time with its one-sigma band, one panel a component."""
    labels = SLOW_LABELS.get(name) or (("sound speed correction, m/s", -_mean_speed(result)),)
    figure = Figure(figsize=(9.0, 1.2 + 2.6 * len(labels)), layout="constrained")
    panels = figure.subplots(len(labels), 1, sharex=True, squeeze=False)[:, 0]
    for c, (axes, (label, factor)) in enumerate(zip(panels, labels, strict=True)):
        for i, segment in enumerate(result.segments):
            state = segment.slow[name]
            value, sigma = factor * state.value[:, c], abs(factor) * state.sigma[:, c]
            colour = COLOURS[i % len(COLOURS)]
            axes.fill_between(state.t, value - sigma, value + sigma, color=colour, alpha=0.25, lw=0)
            axes.plot(state.t, value, color=colour, lw=1.3, label=segment.name or None)
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    panels[-1].set_xlabel("time, s")
    if len(result.segments) > 1:
        panels[0].legend(fontsize=8, ncols=2)
    figure.suptitle(f"{_title(result)}: estimate and one standard deviation", fontsize=10)
    return figure


def errors(result: Result) -> Figure:
    """Errors against the reference over time, with the band of two standard deviations."""
    figure = Figure(figsize=(9.0, 5.0), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True)
    compared = evaluate(result)
    for i, segment in enumerate(s for s in result.segments if s.name in compared):
        found = compared[segment.name]
        sd = np.sqrt(np.einsum("nii->ni", segment.trajectory.at(found.t).covariance))
        colour = COLOURS[i % len(COLOURS)]
        for c, axes in enumerate(panels):
            axes.fill_between(found.t, -2 * sd[:, c], 2 * sd[:, c], color=colour, alpha=0.2, lw=0)
            axes.plot(found.t, found.error[:, c], color=colour, lw=1.0, label=segment.name or None)
    inner = np.concatenate([found.error[found.interior, :2] for found in compared.values()])
    scale = float(np.abs(inner).max()) if len(inner) else 1.0
    for axes, label in zip(panels, ("east", "north"), strict=True):
        axes.set_ylabel(f"{label} error, m")
        # A segment's ends are many times less certain; the scale is that of the interior.
        axes.set_ylim(-3.0 * scale, 3.0 * scale)
        axes.axhline(0.0, color=GREY, lw=0.8)
        axes.grid(alpha=0.3)
    panels[-1].set_xlabel("time, s")
    if len(result.segments) > 1:
        panels[0].legend(fontsize=8, ncols=4)
    figure.suptitle(f"{_title(result)}: error and two standard deviations", fontsize=10)
    return figure


def _title(result: Result) -> str:
    name = result.mission.name or "mission"
    return name if result.status == "converged" else f"{name} ({result.status})"


def _draw_reference(axes: Axes, result: Result) -> None:
    label: str | None = "reference"
    for segment in result.mission.segments:
        if segment.reference is not None and len(segment.reference.t):
            east, north = segment.reference.position[:, :2].T
            axes.plot(east, north, color="black", lw=0.9, ls="--", label=label, zorder=4)
            label = None


def _draw_beacons(axes: Axes, result: Result) -> None:
    for i, (name, beacon) in enumerate(result.beacons.items()):
        east, north = beacon.value[:2]
        axes.plot(east, north, "^", color="black", ms=8, label=None if i else "beacon", zorder=5)
        axes.annotate(name, (east, north), xytext=(6, 6), textcoords="offset points", fontsize=8)


def _draw_ellipses(axes: Axes, segment: SegmentResult, factor: float, colour: str) -> None:
    track = segment.trajectory
    chosen = np.unique(np.linspace(0, len(track.t) - 1, 25).astype(int))
    values, vectors = np.linalg.eigh(track.covariance[chosen][:, :2, :2])
    widths = 2.0 * ELLIPSE_95 * factor * np.sqrt(np.maximum(values, 0.0))
    for centre, width, axis in zip(track.position[chosen, :2], widths, vectors, strict=True):
        angle = float(np.rad2deg(np.arctan2(axis[1, 1], axis[0, 1])))
        place = (float(centre[0]), float(centre[1]))
        # add_artist leaves the map's limits alone: one unsure end must not shrink all the rest.
        axes.add_artist(
            Ellipse(place, width[1], width[0], angle=angle, fc=colour, alpha=0.25, lw=0, zorder=2)
        )


def _ellipse_factor(result: Result) -> float:
    """1, 2, 5, 10, 20, ...: how much ellipses are enlarged so that they can be seen on the map."""
    position = result.trajectory.position[:, :2]
    extent = max(float(np.ptp(position, axis=0).max()), 1.0)
    semi = ELLIPSE_95 * np.sqrt(_typical_variance(result.trajectory.covariance))
    wanted = 0.02 * extent / max(semi, 1e-9)
    if wanted <= 1.0:
        return 1.0
    decade = 10.0 ** np.floor(np.log10(wanted))
    return float(decade * max(step for step in (1.0, 2.0, 5.0) if step * decade <= wanted))


def _typical_variance(covariance: FloatArray) -> float:
    return float(np.median(np.linalg.eigvalsh(covariance[:, :2, :2])[:, 1]))


def _mean_speed(result: Result) -> float:
    """Harmonic-mean speed between the vehicle's typical depth and the beacons' mean depth."""
    depth = -float(np.median(result.trajectory.position[:, 2]))
    bottom = -float(np.mean([b.value[2] for b in result.beacons.values()]))
    return float(result.mission.sound_speed.harmonic_mean(depth, bottom))
