"""The figure of a replay: errors over time with statuses, and the tracks on a map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import replay_runs as runs
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ubl_graph.arrays import FloatArray
from ubl_graph.mission import Mission
from ubl_graph.plots import COLOURS, GREY, RED

#: Colour and mark of each status.
STATUSES = {
    "ok": (COLOURS[0], "."),
    "degraded": (COLOURS[4], "^"),
    "coasting": (COLOURS[5], "s"),
    "rebuilt": (COLOURS[1], "P"),
    "ambiguous": (COLOURS[3], "D"),
    "lost": (RED, "X"),
    "initialising": (GREY, "."),
}
HALF, SMOOTHED = COLOURS[2], "black"


def draw(mission: Mission, against: str, scores: Sequence[runs.Score], path: Path) -> None:
    """Draw errors and tracks into a PNG file.

    Parameters
    ----------
    mission : Mission
        Whose segments were run.
    against : str
        "reference" or "smoothed": what the errors are differences from.
    scores : sequence of Score
        One a segment.
    path : path
        Where it goes, whatever its suffix.
    """
    figure = Figure(figsize=(9.0, 11.0), layout="constrained")
    above, below = figure.subplots(2, 1, height_ratios=(2, 3))
    _errors(above, scores)
    above.set_ylabel(f"horizontal error, m (against the {against})")
    _map(below, mission, scores)
    options = mission.options
    figure.suptitle(
        f"{mission.name or 'mission'}: {options.engine}, lag {options.lag:g} s", fontsize=10
    )
    figure.savefig(path, dpi=130, format="png")


def _errors(axes: Axes, scores: Sequence[runs.Score]) -> None:
    for label, colour, style, rows in (
        ("half a lag later", HALF, "-", [(s.half_lag.t, s.half_lag.error) for s in scores]),
        ("smoothed", SMOOTHED, "--", [(s.newest.t, s.smoothed) for s in scores]),
    ):
        parts = [(t, error) for t, error in rows if error is not None]
        if parts:
            axes.semilogy(*_apart(parts), color=colour, ls=style, lw=1.0, label=label)
    for name, colour, mark, chosen in _by_status(scores):
        parts = [(s.newest.t[rows], s.newest.error[rows]) for s, rows in chosen]
        t, error = _apart(parts)
        axes.semilogy(t, error, mark, color=colour, ms=4, label=f"newest, {name}", zorder=3)
    axes.set_xlabel("time, s")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, ncols=3)


def _map(axes: Axes, mission: Mission, scores: Sequence[runs.Score]) -> None:
    references = [s.reference for s in mission.segments if s.reference is not None]
    if references:
        track = _apart([tuple(r.position[:, :2].T) for r in references])
        axes.plot(*track, color="black", lw=0.9, ls="--", label="reference", zorder=4)
    halves = _apart([tuple(s.run.half_lag.place.T) for s in scores])
    axes.plot(*halves, color=HALF, lw=1.2, label="half a lag later")
    for name, colour, mark, chosen in _by_status(scores):
        places = _apart([tuple(s.run.newest.place[rows].T) for s, rows in chosen])
        axes.plot(*places, mark, color=colour, ms=4, label=f"newest, {name}", zorder=3)
    for i, beacon in enumerate(mission.beacons):
        east, north = beacon.position[:2]
        axes.plot(east, north, "^", color="black", ms=8, label=None if i else "beacon", zorder=5)
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def _by_status(
    scores: Sequence[runs.Score],
) -> Iterator[tuple[str, str, str, list[tuple[runs.Score, np.ndarray]]]]:
    """Each status that was said of a position, and which pings of each segment it was said at."""
    for name, (colour, mark) in STATUSES.items():
        chosen = [
            (s, (s.run.status == name) & np.isfinite(s.run.newest.place[:, 0])) for s in scores
        ]
        if any(rows.any() for _, rows in chosen):
            yield name, colour, mark, chosen


def _apart(parts: Sequence[tuple[FloatArray, ...]]) -> list[FloatArray]:
    """Columns of all parts one after the other, a gap between them."""
    gap = np.array([np.nan])
    columns = zip(*parts, strict=True)
    return [np.concatenate([x for part in column for x in (part, gap)]) for column in columns]
