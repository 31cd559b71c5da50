"""One function a figure. Every function takes a Result and gives a matplotlib Figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ubl_graph.arrays import FloatArray
from ubl_graph.attitude import AttitudeTrack
from ubl_graph.drawing import (
    COLOURS,
    GREY,
    RED,
    draw_beacons,
    draw_ellipses,
    draw_residuals,
    ellipse_factor,
    residual_limit,
    residual_title,
    typical_sigma,
)
from ubl_graph.evaluation import evaluate
from ubl_graph.nodes import NOMINAL_SPEED
from ubl_graph.pose_trajectory import PoseStates, PoseTrajectory, mariners_angles
from ubl_graph.result import Result, SegmentResult
from ubl_graph.segment import Segment
from ubl_graph.trajectory import Trajectory

#: Tracks by their name, to draw beside the smoothed one.
Beside = Mapping[str, Sequence[Trajectory]]
#: Axis label, factor from SI, per component of a slow state.
SLOW_LABELS = {
    "clock_offset": (("clock offset, ms", 1e3),),
    "clock_drift": (("clock drift, ppm", 1e6),),
    "current": (("current east, m/s", 1.0), ("current north, m/s", 1.0)),
    "heading_bias": (("heading bias, degrees", 180.0 / np.pi),),
}
#: Ellipses along a segment's track.
ELLIPSES = 25
#: Readings of a compass that are drawn; more are thinned out evenly.
MOST_READINGS = 500


def save_all(result: Result, folder: Path, beside: Beside | None = None) -> None:
    """Draw every figure that the result has data for into `folder` as PNG."""
    figures: dict[str, Figure] = {"track": track(result, beside)}
    if result.residuals is not None:
        figures["residuals"] = residuals(result)
    if any(isinstance(s.trajectory, PoseTrajectory) for s in result.segments):
        figures["heading"] = heading(result)
    for name in dict.fromkeys(name for s in result.segments for name in s.slow):
        figures[name] = slow_state(result, name)
    if evaluate(result):
        figures["errors"] = errors(result)
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png", dpi=130)


def track(result: Result, beside: Beside | None = None) -> Figure:
    """Map of the smoothed track with 95 % ellipses, beacons, and the reference where known.

    Where other tracks fit, too, they are drawn beside it with their weights.

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
    whole = result.trajectory
    enlarged = ellipse_factor(whole.position, typical_sigma(whole.covariance))
    for i, segment in enumerate(result.segments):
        colour = COLOURS[i % len(COLOURS)]
        east, north = segment.trajectory.position[:, :2].T
        label = segment.name or "smoothed"
        if len(segment.hypotheses) > 1:
            label += f", weight {segment.hypotheses[0].weight:.2g}"
        axes.plot(east, north, color=colour, lw=1.4, label=label, zorder=3)
        _draw_others(axes, segment, colour)
        label = None if i else "start"
        axes.plot(east[0], north[0], "o", color=colour, mfc="white", label=label, zorder=3.5)
    for name, tracks in (beside or {}).items():
        for i, other in enumerate(tracks):
            label = None if i else name
            axes.plot(*other.position[:, :2].T, color=RED, lw=1.0, ls="-.", label=label, zorder=2)
    draw_beacons(axes, result.beacons)
    for i, segment in enumerate(result.segments):
        nodes, colour = segment.trajectory, COLOURS[i % len(COLOURS)]
        some = np.unique(np.linspace(0, len(nodes.t) - 1, ELLIPSES).astype(int))
        draw_ellipses(axes, nodes.position[some], nodes.covariance[some], enlarged, colour)
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    drawn = "95 % ellipses" + (f", drawn {enlarged:g} times as large" if enlarged > 1 else "")
    axes.set_title(f"{_title(result)}\n{drawn}", fontsize=10)
    axes.legend(fontsize=8, loc="best")
    return figure


def residuals(result: Result) -> Figure:
    """Range residuals over time, one panel a beacon; down-weighted pings are marked.

    Travel times are in milliseconds, slant ranges in metres.
    """
    table = result.residuals
    assert table is not None
    slant = table.kind == "slant"
    names = [str(b) for b in result.mission.beacon_names]
    parts = [
        (name, in_metres, (table.beacon == name) & (slant == in_metres))
        for name in names
        for in_metres in (False, True)
    ]
    parts = [part for part in parts if part[2].any()]
    figure = Figure(figsize=(9.0, 1.2 + 1.6 * len(parts)), layout="constrained")
    panels = figure.subplots(len(parts), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, in_metres, mine) in zip(panels, parts, strict=True):
        factor = NOMINAL_SPEED if in_metres else 1e3
        limit = factor * residual_limit(table, slant == in_metres)
        draw_residuals(axes, table, mine, factor, limit)
        unit, noun = ("m", "range") if in_metres else ("ms", "ping")
        title = residual_title(name, table, mine, factor, unit)
        axes.set_title(title, fontsize=9, loc="left")
        axes.set_ylabel(f"model - {noun}, {unit}", fontsize=8)
    drawn = {line.get_label(): line for axes in panels for line in axes.lines}
    marks = [line for label, line in drawn.items() if not str(label).startswith("_")]
    above = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.1}
    panels[0].legend(handles=marks, ncols=3, fontsize=8, frameon=False, **above)
    panels[-1].set_xlabel(_time_label(result))
    figure.suptitle(_title(result), fontsize=10)
    return figure


def heading(result: Result) -> Figure:
    """Heading of pose nodes over time, how sure it is, and what its reference reads too far.

    The lowest panel is there where the heading was measured. Bands are two standard deviations.
    """
    biased = "heading_bias" in result.shared
    biased |= any("heading_bias" in s.slow for s in result.segments)
    readings = [
        _readings(segment, found.trajectory.t)
        for segment, found in zip(result.mission.segments, result.segments, strict=True)
    ]
    measured = biased or any(len(t) for t, _ in readings)
    heights = [2.0, 1.0, 1.4][: 3 if measured else 2]
    figure = Figure(figsize=(9.0, 1.0 + 1.7 * sum(heights)), layout="constrained")
    panels = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[
        :, 0
    ]
    for i, segment in enumerate(result.segments):
        track, colour = segment.trajectory, COLOURS[i % len(COLOURS)]
        assert isinstance(track, PoseTrajectory)
        angle, sigma = np.rad2deg(track.attitude[:, 0]), np.rad2deg(track.attitude_sigma[:, 0])
        for piece in _unbroken(angle):
            label = None if piece.start or not segment.name else segment.name
            t, mean, sd = track.t[piece], angle[piece], sigma[piece]
            panels[0].fill_between(t, mean - 2 * sd, mean + 2 * sd, color=colour, alpha=0.25, lw=0)
            panels[0].plot(t, mean, color=colour, lw=1.2, label=label)
        panels[1].plot(track.t, 2.0 * sigma, color=colour, lw=1.2)
        if measured:
            _draw_bias(panels[2], result, segment, readings[i], colour)
    panels[0].set_ylabel("heading, degrees")
    panels[0].set_ylim(-5.0, 365.0)
    panels[0].set_yticks(range(0, 361, 90))
    panels[1].set_ylabel("two standard\ndeviations, degrees", fontsize=8)
    panels[1].set_ylim(0.0, 1.15 * panels[1].dataLim.y1 or 1.0)
    if measured:
        panels[2].set_ylabel("reading - heading,\ndegrees", fontsize=8)
        panels[2].axhline(0.0, color=GREY, lw=0.8)
        panels[2].legend(fontsize=8, ncols=2)
    for axes in panels:
        axes.grid(alpha=0.3)
    panels[-1].set_xlabel(_time_label(result))
    if len(result.segments) > 1:
        panels[0].legend(fontsize=8, ncols=4)
    figure.suptitle(f"{_title(result)}: heading, clockwise from north", fontsize=10)
    return figure


def slow_state(result: Result, name: str) -> Figure:
    """A slow state over time with its one-sigma band, one panel a component.

    What lengthens all travel times by a factor is drawn as a sound speed, or where ranges are
    distances as the share by which these are too long.
    """
    table = result.residuals
    stretched = name == "sound_speed" and table is not None and (table.kind == "slant").all()
    labels = SLOW_LABELS.get(name) or (("sound speed correction, m/s", -_mean_speed(result)),)
    labels = (("ranges too long by, %", 100.0),) if stretched else labels
    figure = Figure(figsize=(9.0, 1.2 + 2.6 * len(labels)), layout="constrained")
    panels = figure.subplots(len(labels), 1, sharex=True, squeeze=False)[:, 0]
    for c, (axes, (label, factor)) in enumerate(zip(panels, labels, strict=True)):
        for i, segment in enumerate(result.segments):
            state = segment.slow[name]
            value, sigma = state.value[:, c], state.sigma[:, c]
            if stretched:
                value, sigma = np.expm1(value), np.exp(value) * sigma
            value, sigma = factor * value, abs(factor) * sigma
            colour = COLOURS[i % len(COLOURS)]
            axes.fill_between(state.t, value - sigma, value + sigma, color=colour, alpha=0.25, lw=0)
            axes.plot(state.t, value, color=colour, lw=1.3, label=segment.name or None)
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    panels[-1].set_xlabel(_time_label(result))
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
    panels[-1].set_xlabel(_time_label(result))
    if len(result.segments) > 1:
        panels[0].legend(fontsize=8, ncols=4)
    figure.suptitle(f"{_title(result)}: error and two standard deviations", fontsize=10)
    return figure


def _title(result: Result) -> str:
    name = result.mission.name or "mission"
    return name if result.status == "converged" else f"{name} ({result.status})"


def _time_label(result: Result) -> str:
    """Data without stamps count their poses instead: 0, 1, 2, ..."""
    t = result.trajectory.t
    poses = result.mission.options.node != "point"
    counted = poses and np.array_equal(t, np.arange(len(t)))
    return "t, number of the pose" if counted else "time, s"


def _readings(segment: Segment, nodes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Times (s) and headings (rad) that a segment's references read, as the estimator saw them.

    Those of a compass are its own; an attitude reference is read at the nodes.
    """
    t, read = np.empty(0), np.empty(0)
    if segment.attitude is not None and len(segment.attitude):
        track = AttitudeTrack(segment.attitude)
        t = nodes[(nodes >= track.t[0]) & (nodes <= track.t[-1])]
        read = mariners_angles(track.at(t))[:, 0]
    if segment.heading is not None:
        compass = segment.heading
        inside = (compass.t >= nodes[0]) & (compass.t <= nodes[-1])
        t = np.concatenate([t, compass.t[inside]])
        read = np.concatenate([read, compass.heading[inside]])
    some = np.unique(np.linspace(0, max(len(t) - 1, 0), MOST_READINGS).astype(int))[: len(t)]
    return t[some], read[some]


def _draw_bias(
    axes: Axes,
    result: Result,
    segment: SegmentResult,
    readings: tuple[FloatArray, FloatArray],
    colour: str,
) -> None:
    """What the heading reference reads too far, as estimated and as its readings show it."""
    track = segment.trajectory
    t, read = readings
    first = segment is result.segments[0]
    if len(t):
        states = track.at(t)
        assert isinstance(states, PoseStates)
        off = read - mariners_angles(states.rotation)[:, 0]
        off = np.rad2deg(np.angle(np.exp(1j * off)))
        label = "reading minus estimated heading" if first else None
        axes.plot(t, off, ".", color=GREY, ms=3, label=label)
    if "heading_bias" in segment.slow:
        state = segment.slow["heading_bias"]
        at, bias, sigma = state.t, state.value[:, 0], state.sigma[:, 0]
    elif "heading_bias" in result.shared:
        shared = result.shared["heading_bias"]
        at, bias, sigma = track.t[[0, -1]], shared.value.repeat(2), shared.sigma.repeat(2)
    else:
        return
    bias, band = np.rad2deg(bias), np.rad2deg(2.0 * sigma)
    axes.fill_between(at, bias - band, bias + band, color=colour, alpha=0.25, lw=0)
    axes.plot(at, bias, color=colour, lw=1.3, label="heading bias" if first else None)


def _unbroken(angle: FloatArray) -> list[slice]:
    """Pieces of an angle (degrees) within which it does not jump from 360 to 0 or back."""
    cuts = np.flatnonzero(np.abs(np.diff(angle)) > 180.0) + 1
    ends = [0, *cuts.tolist(), len(angle)]
    return [slice(a, b) for a, b in pairwise(ends)]


def _draw_others(axes: Axes, segment: SegmentResult, colour: str) -> None:
    """Other tracks that fit, dotted, each with its weight."""
    for other in segment.hypotheses[1:]:
        east, north = other.trajectory.position[:, :2].T
        label = f"fits as well, weight {other.weight:.2g}"
        axes.plot(east, north, color=colour, lw=1.6, ls=":", label=label, zorder=3)
        axes.plot(east[0], north[0], "o", color=colour, mfc="white", alpha=0.6, zorder=3.5)


def _draw_reference(axes: Axes, result: Result) -> None:
    label: str | None = "reference"
    for segment in result.mission.segments:
        if segment.reference is not None and len(segment.reference.t):
            east, north = segment.reference.position[:, :2].T
            axes.plot(east, north, color="black", lw=0.9, ls="--", label=label, zorder=4)
            label = None


def _mean_speed(result: Result) -> float:
    """Harmonic-mean speed between the vehicle's typical depth and the beacons' mean depth."""
    depth = -float(np.median(result.trajectory.position[:, 2]))
    bottom = -float(np.mean([b.value[2] for b in result.beacons.values()]))
    return float(result.mission.sound_speed.harmonic_mean(depth, bottom))
