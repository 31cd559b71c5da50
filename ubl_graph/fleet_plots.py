"""Figures of a fleet: one function a figure, from a FleetResult to a matplotlib Figure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ubl_graph.arrays import BoolArray, FloatArray
from ubl_graph.cooperative.fleet import UNKNOWN_PLACE
from ubl_graph.cooperative.result import FleetResiduals, FleetResult, TargetEstimate
from ubl_graph.drawing import (
    COLOURS,
    GREY,
    draw_beacons,
    draw_ellipses,
    draw_residuals,
    ellipse_factor,
    residual_limit,
    residual_title,
    typical_sigma,
)
from ubl_graph.nodes import NOMINAL_SPEED
from ubl_graph.result import RangeResiduals

#: Of tracks: the next one when all colours are taken.
STYLES = ("-", "--", "-.")
#: Ranges that are drawn on the map; more are thinned out evenly.
MOST_RANGES = 150
#: Ellipses along each vehicle's track.
ELLIPSES = 15
#: Panels of residuals; where pairs are more there is one a vehicle instead.
MOST_PAIRS = 15


def save_all(result: FleetResult, folder: Path) -> None:
    """Draw every figure that the result has data for into `folder` as PNG."""
    figures = {"map": fleet_map(result)}
    if result.residuals is not None:
        figures["residuals"] = fleet_residuals(result)
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png", dpi=130)


def fleet_map(result: FleetResult) -> Figure:
    """Map of all tracks, beacons and targets with 95 % ellipses, and of ranges between them.

    Parameters
    ----------
    result : FleetResult
        What to draw. What is unobservable has no ellipse: a vehicle's track is dotted then, a
        target's mark open, as is that of another place that fits as well.
    """
    figure = Figure(figsize=(8.6, 7.4), layout="constrained")
    axes = figure.subplots()
    enlarged = _enlargement(result)
    _draw_tracks(axes, result)
    _draw_ranges(axes, result)
    _draw_targets(axes, result)
    draw_beacons(axes, result.beacons)
    _draw_all_ellipses(axes, result, enlarged)
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    drawn = "95 % ellipses" + (f", drawn {enlarged:g} times as large" if enlarged > 1 else "")
    axes.set_title(f"{_title(result)}\n{drawn}", fontsize=10)
    axes.legend(fontsize=8, loc="best", ncols=1 if len(result.vehicles) < 8 else 2)
    return figure


def fleet_residuals(result: FleetResult) -> Figure:
    """Residuals of the ranges between vehicles and to targets over time, in metres one way.

    One panel a pair, whoever of the two measured; where pairs are many, one a measuring vehicle.
    Down-weighted ranges are marked.
    """
    assert result.residuals is not None
    table = _in_metres(result.residuals, _speed(result))
    parts = _panels(result.residuals, result.fleet.names)
    columns = 1 if len(parts) <= 6 else 2
    rows = -(-len(parts) // columns)
    figure = Figure(figsize=(9.0 * columns**0.5, 1.2 + 1.7 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
    # One scale where kinds are one: what differs between pairs can be seen then.
    for axes, (name, mine) in zip(panels, parts.items(), strict=False):
        alike = np.isin(table.kind, np.unique(table.kind[mine]))
        draw_residuals(axes, table, mine, 1.0, residual_limit(table, alike))
        axes.set_title(residual_title(name, table, mine, 1.0, "m"), fontsize=8, loc="left")
        axes.set_ylabel("model - range, m", fontsize=8)
    if len(parts) < len(panels):
        panels[-1].set_visible(False)
        panels[-1 - columns].tick_params(labelbottom=True)
    figure.supxlabel("time, s", fontsize=10)
    drawn = {line.get_label(): line for axes in panels for line in axes.lines}
    marks = [line for label, line in drawn.items() if not str(label).startswith("_")]
    figure.legend(handles=marks, ncols=3, fontsize=8, frameon=False, loc="outside upper right")
    figure.suptitle(_title(result), fontsize=10)
    return figure


def _draw_tracks(axes: Axes, result: FleetResult) -> None:
    label: str | None = "reference"
    for i, (name, vehicle) in enumerate(result.vehicles.items()):
        colour = COLOURS[i % len(COLOURS)]
        for segment in vehicle.mission.segments:
            if segment.reference is not None and len(segment.reference.t):
                place = segment.reference.position[:, :2].T
                axes.plot(*place, color="black", lw=0.9, ls="--", label=label, zorder=4)
                label = None
        track = vehicle.segments[0].trajectory
        sure = vehicle.status != "unobservable"
        east, north = track.position[:, :2].T
        style = STYLES[i // len(COLOURS) % len(STYLES)] if sure else ":"
        label_of = name if sure else f"{name} (unobservable)"
        axes.plot(east, north, ls=style, color=colour, lw=1.5, label=label_of, zorder=3)
        first = None if i else "start"
        axes.plot(east[0], north[0], "o", color=colour, mfc="white", label=first, zorder=3.5)


def _draw_all_ellipses(axes: Axes, result: FleetResult, enlarged: float) -> None:
    """Those of what is observable."""
    for i, vehicle in enumerate(result.vehicles.values()):
        if vehicle.status != "unobservable":
            track, colour = vehicle.segments[0].trajectory, COLOURS[i % len(COLOURS)]
            some = np.unique(np.linspace(0, len(track.t) - 1, ELLIPSES).astype(int))
            draw_ellipses(axes, track.position[some], track.covariance[some], enlarged, colour)
    for target in _placed(result):
        if target.status != "unobservable":
            draw_ellipses(axes, target.position[None], target.covariance[None], enlarged, "black")


def _title(result: FleetResult) -> str:
    name = result.fleet.name or "fleet"
    return name if result.status == "converged" else f"{name} ({result.status})"


def _enlargement(result: FleetResult) -> float:
    """How much all ellipses of a map are enlarged: so that the largest kind can be seen.

    Those of what is unobservable are large enough.
    """
    tracks = {name: vehicle.segments[0].trajectory for name, vehicle in result.vehicles.items()}
    shown = [track.position for track in tracks.values()]
    shown += [target.position[None] for target in _placed(result)]
    sigmas = [
        typical_sigma(track.covariance)
        for name, track in tracks.items()
        if result.vehicles[name].status != "unobservable"
    ]
    sigmas += [
        typical_sigma(t.covariance[None]) for t in _placed(result) if t.status != "unobservable"
    ]
    return ellipse_factor(np.concatenate(shown), max(sigmas, default=np.inf))


def _placed(result: FleetResult) -> list[TargetEstimate]:
    """Targets of which a place is known, however roughly."""
    targets = result.targets.values()
    return [t for t in targets if typical_sigma(t.covariance[None]) < UNKNOWN_PLACE]


def _draw_targets(axes: Axes, result: FleetResult) -> None:
    for i, target in enumerate(_placed(result)):
        east, north = target.position[:2]
        sure = target.status != "unobservable"
        axes.plot(
            *(east, north, "*"),
            color="black",
            mfc="black" if sure else "white",
            ms=9,
            label=None if i else "target",
            zorder=5,
        )
        name = target.name if sure else f"{target.name} (unobservable)"
        text = axes.annotate(name, (east, north), xytext=(7, 7), textcoords="offset points")
        text.set(fontsize=8, bbox={"fc": "white", "alpha": 0.7, "lw": 0, "pad": 1}, zorder=6)
        if target.rival is not None:
            both = np.stack([target.position, target.rival])[:, :2].T
            axes.plot(*both, "*:", color="black", mfc="white", ms=9, lw=0.8, zorder=4.5)
        if not np.isnan(target.t) and result.residuals is not None:
            way = target.at(_span_of(result.residuals, target.name))[0]
            axes.plot(*way[:, :2].T, color="black", lw=1.0, zorder=2.5)


def _span_of(residuals: FleetResiduals, name: str) -> FloatArray:
    t = residuals.t_receive[residuals.peer == name]
    return np.array([t.min(), t.max()]) if len(t) else np.empty(0)


def _draw_ranges(axes: Axes, result: FleetResult) -> None:
    """Thin lines between the two ends of some of the ranges that count."""
    r = result.residuals
    if r is None:
        return
    kept = np.flatnonzero(~r.down_weighted)
    spread = np.linspace(0, max(len(kept) - 1, 0), MOST_RANGES)
    some = kept[np.unique(spread.astype(int))[: len(kept)]]
    for k, i in enumerate(some):
        t = float(r.t_receive[i])
        here, there = (_place(result, str(name), t) for name in (r.vehicle[i], r.peer[i]))
        label = None if k else "ranges" + ("" if len(some) == len(kept) else ", some")
        axes.plot(
            *zip(here, there, strict=True), color=GREY, lw=0.4, alpha=0.5, label=label, zorder=1
        )


def _place(result: FleetResult, name: str, t: float) -> tuple[float, float]:
    """East and north of a vehicle, target or beacon at a time, as near as its track comes."""
    if name in result.targets:
        position = result.targets[name].at(t)[0][0]
    elif name in result.beacons:
        position = result.beacons[name].value
    else:
        track = result.vehicles[name].segments[0].trajectory
        inside = float(np.clip(t, track.t[0], track.t[-1]))
        position = track.at(inside).position[0]
    return float(position[0]), float(position[1])


def _panels(residuals: FleetResiduals, names: Sequence[str]) -> dict[str, BoolArray]:
    """Rows of each panel by its title, in the order of `names`."""
    number = {name: i for i, name in enumerate(names)}
    vehicle, peer = (np.array([number[n] for n in c]) for c in (residuals.vehicle, residuals.peer))
    first, second = np.minimum(vehicle, peer), np.maximum(vehicle, peer)
    pairs = sorted(set(zip(first.tolist(), second.tolist(), strict=True)))
    if len(pairs) > MOST_PAIRS:
        return {f"{names[i]} - all others": vehicle == i for i in np.unique(vehicle)}
    return {f"{names[a]} - {names[b]}": (first == a) & (second == b) for a, b in pairs}


def _speed(result: FleetResult) -> float:
    """Sound speed at the vehicles' typical depth, m/s."""
    tracks = [vehicle.segments[0].trajectory.position for vehicle in result.vehicles.values()]
    depth = -float(np.median(np.concatenate(tracks)[:, 2]))
    return float(result.fleet.sound_speed.speed_at(depth))


def _in_metres(residuals: FleetResiduals, speed: float) -> RangeResiduals:
    """Residuals as metres of a way: of two-way travel times half."""
    by_kind = {"two_way": speed / 2.0, "one_way": speed, "slant": NOMINAL_SPEED}
    factor = np.array([by_kind[str(kind)] for kind in residuals.kind])
    return RangeResiduals(
        kind=residuals.kind,
        beacon=residuals.peer,
        t_transmit=residuals.t_transmit,
        t_receive=residuals.t_receive,
        travel_time=residuals.travel_time,
        sigma=factor * residuals.sigma,
        residual=factor * residuals.residual,
        weight=residuals.weight,
        found=residuals.found,
    )
