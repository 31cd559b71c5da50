"""What the Cao 2017 study runs: the cases of each table, in full and in short.

Tables are named as the parts of the study: A1 closed forms, A2 the paper's simulation (its Figures
3 to 5), A3 the same with vague starts and noise, A4 what the sea trial may have been like (its
Figures 8 and 9).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from cao2017_cases import (
    CONVERGED,
    ERRORS,
    Case,
    GraphPasses,
    GraphTrack,
    MirrorMap,
    Passes,
    Trial,
    Unanchored,
    WindowMap,
    WindowPasses,
    Windows,
)

NEWTON = (("method", "gauss_newton"),)
METHODS = (
    ("gauss-newton", Windows(options=NEWTON)),
    ("lm", Windows()),
    ("lm converged", Windows(options=tuple(CONVERGED.items()))),
)
#: Of all errors and noise.
SEED = 1
#: A3: standard deviations of start and range, m, and what multiplies the noise.
SETTINGS = ((0.0, 0.1, 0.0), (1.0, 0.1, 1.0), (5.0, 0.1, 1.0), (20.0, 0.1, 1.0), (5.0, 1.0, 1.0))
#: A4: distance of the track from the beacon and calibration of the beacon, m.
TRIALS = ((0.0, 3.0), (800.0, 3.0), (0.0, 7.0), (800.0, 7.0))
#: A2: the ends of the axis are there, m.
AXIS_WIDTH, AXIS_ENDS = 300.0, 2000.0
#: A2: how LM's errors at the axis ends depend on window and stop.
DEPENDENCE = (
    *((f"{k} trials", Windows(options=(("max_iterations", k),))) for k in (2, 3, 4, 5, 10)),
    ("converged", Windows(options=tuple(CONVERGED.items()))),
    *(
        (
            f"stop at {tolerance:g} m",
            Windows(options=(("max_iterations", 500), ("tolerance", tolerance))),
        )
        for tolerance in (1.0, 0.1, 0.01)
    ),
    *(
        (f"{n} pings every {interval:g} s", Windows(n, interval))
        for n, interval in ((20, 5.0), (20, 10.0), (10, 20.0), (60, 1.5), (5, 10.0), (60, 10.0))
    ),
)


@dataclass(frozen=True)
class Plan:
    """How much is run.

    Attributes
    ----------
    map_north, map_east : tuple of float
        A2: nodes, m; north as distances from the beacon, for either side.
    draw_north, draw_east : tuple of float
        A3: the same.
    draws : int
        A3: of noise and starts, half of them on either side.
    runs : int
        A4: of either track.
    pings, stride : int
        A4: in a run, and of the fixes every so many are compared.
    passes : tuple of float
        Distances of passes without a start from the beacon, m.
    """

    map_north: tuple[float, ...]
    map_east: tuple[float, ...]
    draw_north: tuple[float, ...]
    draw_east: tuple[float, ...]
    draws: int
    runs: int
    pings: int
    stride: int
    passes: tuple[float, ...]


def span(first: float, last: float, step: float) -> tuple[float, ...]:
    """Numbers from first to last, both included."""
    return tuple(np.arange(first, last + step / 2.0, step).tolist())


FULL = Plan(
    map_north=span(0.0, 3000.0, 100.0),
    map_east=span(-3000.0, 3000.0, 200.0),
    draw_north=span(0.0, 3000.0, 300.0),
    draw_east=span(-2400.0, 3000.0, 600.0),
    draws=8,
    runs=30,
    pings=60,
    stride=2,
    passes=span(200.0, 3000.0, 400.0),
)
QUICK = Plan(
    map_north=(0.0, 100.0, 200.0, 300.0, 1000.0, 3000.0),
    map_east=(-3000.0, -2000.0, 0.0, 2000.0, 3000.0),
    draw_north=(0.0, 400.0, 1400.0, 3000.0),
    draw_east=(-500.0, 3000.0),
    draws=4,
    runs=2,
    pings=60,
    stride=8,
    passes=(200.0, 1000.0),
)


def either_side(north: Sequence[float]) -> tuple[float, ...]:
    """Distances from the beacon as places on both sides, from south to north."""
    return tuple(sorted({side * n for n in north for side in (-1.0, 1.0)}))


def cases(plan: Plan) -> list[Case]:
    """All cases of a plan, the longest ones first."""
    found: list[Case] = []
    for error in ("forward", "right"):
        parts: list[Passes] = []
        for setting in SETTINGS:
            drawn = drawn_tracks(plan, setting)
            every = tuple(track for tracks in drawn for track in tracks)
            parts.append(Passes(error, *setting, every, plan.draw_east))
            found += [GraphPasses(error, *setting, tracks, plan.draw_east) for tracks in drawn]
        found.insert(0, WindowPasses(tuple(parts)))
    for error in ERRORS:
        for north in plan.map_north:
            found.append(GraphTrack(error, north, plan.map_east))
            # To the right one side is not the mirror image of the other.
            if error == "right" and north > 0.0:
                found.append(GraphTrack(error, -north, plan.map_east))
    found += [Trial(*trial, plan.pings, plan.stride) for trial in TRIALS for _ in range(plan.runs)]
    nodes = (either_side(plan.map_north), plan.map_east)
    found += [WindowMap(error, *nodes, METHODS) for error in ERRORS]
    near, ends = span(-AXIS_WIDTH, AXIS_WIDTH, 100.0), axis_ends(100.0)
    for error in ERRORS:
        for interval in sorted({setting.interval for _, setting in DEPENDENCE}):
            some = tuple((n, s) for n, s in DEPENDENCE if s.interval == interval)
            found.append(WindowMap(error, near, ends, some))
    for step in (50.0, 100.0, 200.0):
        near = either_side(span(0.0, AXIS_WIDTH, step))
        for error in ("forward", "up"):
            name = f"Gauss-Newton, a grid of {step:g} m"
            setting = ((name, Windows(options=NEWTON)),)
            found.append(WindowMap(error, near, axis_ends(step), setting))
    found.append(MirrorMap())
    found += [Unanchored(north, noise) for north in plan.passes for noise in (0.0, 1.0)]
    return found


def drawn_tracks(
    plan: Plan, setting: tuple[float, float, float]
) -> list[tuple[tuple[float, int], ...]]:
    """A3: places, m north, and seeds of each draw's tracks, on either side of the beacon by turns.

    Without noise all draws are the same, but for the side.
    """
    return [
        tuple(
            (north if draw % 2 == 0 else -north, 1000 * draw + number + SEED)
            for number, north in enumerate(plan.draw_north)
        )
        for draw in range(plan.draws if setting[2] else 2)
    ]


def axis_ends(step: float) -> tuple[float, ...]:
    """Places on the axis, m east, that count as its ends."""
    return tuple(e for e in span(-3000.0, 3000.0, step) if abs(e) >= AXIS_ENDS)
