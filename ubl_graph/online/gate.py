"""Gates: whether a record is near enough to what is expected of it to count.

A record's Mahalanobis distance from its prediction is compared with the quantile of the chi-square
distribution that a good record passes but once in two million. Sensors of motion (velocity,
attitude) are compared with their own last record, what says where the vehicle is with the estimate.
A gate never locks: after some refusals in a row it is for the estimate to prove itself
(`REOPENS`).
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median
from typing import Any

import numpy as np
from scipy.special import chdtri

from ubl_graph.arrays import FloatArray
from ubl_graph.builder import ODOMETRY_PSD
from ubl_graph.online.buffer import Entry

#: Share of good records that a gate refuses: five standard deviations.
REFUSED_SHARE = 5.7e-7
#: So many refusals in a row, or among twice as many records, put the estimate in doubt.
REOPENS = 5
#: Median of the square of a normal deviate.
MEDIAN_SQUARE = 0.4549
#: A few records.
FEW = 6
#: Judgements that are looked back on.
MEMORY = 20
#: Standard deviation of how fast a vehicle turns, rad/s, and of a sudden change, rad.
TURN_RATE, TURN = 0.5, 0.1
#: Velocities and attitudes are not compared over longer than this, s.
COMPARED = 30.0

#: The same of a turning rate, rad/s^2, and what odometry's noise is in a step, m.
TURN_CHANGE, SPEED_CHANGE = 0.5, 0.1

#: Components of what sensors of motion say.
_COMPONENTS = {"velocity": 3, "attitude": 3, "heading": 1, "angular_rate": 3, "odometry": 6}
_LIMITS = {dof: math.sqrt(chdtri(dof, REFUSED_SHARE)) for dof in (1, 2, 3, 4, 6)}


def limit(dof: int) -> float:
    """Largest Mahalanobis distance of a good record with `dof` components."""
    return _LIMITS[dof]


@dataclass
class Gate:
    """Judgements on one sensor.

    Attributes
    ----------
    accepted : int
        Records that count.
    rejected : Counter
        Records that do not, by reason.
    run : list of Entry
        The records refused since the last accepted one, in the order they came.
    refused : deque of Entry
        The records among the last ones that were refused.
    recent : deque of bool
        Whether each of the last records was refused.
    times : deque of float
        When the last accepted records were taken, s.
    surprises : deque of float
        Squared Mahalanobis distance per component of the last accepted records; 1 is expected.
    """

    accepted: int = 0
    rejected: Counter[str] = field(default_factory=Counter[str])
    run: list[Entry] = field(default_factory=list[Entry])
    refused: deque[Entry] = field(default_factory=lambda: deque(maxlen=MEMORY))
    recent: deque[bool] = field(default_factory=lambda: deque(maxlen=MEMORY))
    times: deque[float] = field(default_factory=lambda: deque(maxlen=MEMORY))
    surprises: deque[float] = field(default_factory=lambda: deque(maxlen=MEMORY))

    def accept(self, entry: Entry, surprise: float | None = None) -> None:
        """Note a record that counts, and its squared distance per component where it was judged."""
        if surprise is not None:
            self.surprises.append(surprise)
        self.accepted += 1
        self.run.clear()
        self.recent.append(False)
        self.times.append(entry.t)

    def refuse(self, entry: Entry) -> None:
        """Note a record that was gated."""
        self.rejected["gated"] += 1
        self.run.append(entry)
        self.refused.append(entry)
        del self.run[: -4 * REOPENS]
        self.recent.append(True)

    def change_mind(self, entry: Entry) -> None:
        """Note that a record's fate was turned: its `gated` says what holds now."""
        sign = 1 if entry.gated else -1
        self.rejected["gated"] += sign
        self.accepted -= sign
        if not entry.gated:
            self.run = [e for e in self.run if e is not entry]
            self.times.append(max(entry.t, *self.times) if self.times else entry.t)

    @property
    def last(self) -> float | None:
        """When the last accepted record was taken, s."""
        return max(self.times) if self.times else None

    @property
    def interval(self) -> float | None:
        """Time between accepted records that nine in ten keep, s; None where too few have come.

        Pings may come in bursts; what counts is when the next one is due.
        """
        if len(self.times) < 3:
            return None
        gaps = sorted(b - a for a, b in pairwise(sorted(self.times)))
        return gaps[int(0.9 * (len(gaps) - 1))]

    @property
    def surprise(self) -> float:
        """Median of `surprises` by that of a good sensor, 1 where there are too few to tell.

        A manoeuvre surprises for a while; sigmas that are too small do for good.
        """
        if len(self.surprises) < MEMORY // 2:
            return 1.0
        return median(self.surprises) / MEDIAN_SQUARE

    @property
    def is_doubtful(self) -> bool:
        """Whether so many of the last records were refused that the estimate is in doubt."""
        return len(self.run) >= REOPENS or sum(list(self.recent)[-2 * REOPENS :]) >= REOPENS

    @property
    def is_uneasy(self) -> bool:
        """Whether half of the last few records were refused."""
        return sum(list(self.recent)[-FEW:]) * 2 >= FEW

    @property
    def refused_share(self) -> float:
        """Share of the last records that were refused."""
        return sum(self.recent) / len(self.recent) if self.recent else 0.0

    def shift(self, by: float) -> None:
        """Move all times by so many seconds: the clock was set."""
        self.times = deque((t + by for t in self.times), maxlen=MEMORY)


def step_distance(entry: Entry, before: Entry) -> tuple[float, int]:
    """How far a record of motion is from the sensor's last one: distance and components."""
    dt, values, old = abs(entry.t - before.t), entry.values, before.values
    dof = _COMPONENTS[entry.kind]
    if dt > COMPARED:
        return 0.0, dof
    if entry.kind == "odometry":
        return _odometry_step(values, old, dt), dof
    at = {"velocity": 4, "attitude": 4, "heading": 2, "angular_rate": 4}[entry.kind]
    gap = [a - b for a, b in zip(values[1 : 1 + dof], old[1 : 1 + dof], strict=True)]
    noise = values[at] ** 2 + old[at] ** 2
    if entry.kind == "velocity":
        variance = noise + ODOMETRY_PSD * dt
    elif entry.kind == "angular_rate":
        variance = noise + (TURN_CHANGE * dt) ** 2 + TURN**2
    else:
        gap = [math.remainder(g, 2.0 * math.pi) for g in gap]
        variance = noise + (TURN_RATE * dt) ** 2 + TURN**2
    return math.sqrt(sum(g * g for g in gap) / variance), dof


def _odometry_step(values: Sequence[Any], old: Sequence[Any], dt: float) -> float:
    """The distance of two changes of pose, as speeds and turning rates, each in its own axes."""
    spans = [v[1] - v[0] for v in (values, old)]
    total = 0.0
    for own, density, least in (
        (slice(2, 5), ODOMETRY_PSD, SPEED_CHANGE),
        (slice(5, 8), TURN_CHANGE**2 * dt, TURN),
    ):
        rates = [
            [(c or 0.0) / span for c in v[own]]
            for v, span in zip((values, old), spans, strict=True)
        ]
        gap = sum((a - b) ** 2 for a, b in zip(*rates, strict=True))
        noise = sum((least / min(span, 1.0)) ** 2 for span in spans)
        total += gap / (density * dt + noise)
    return math.sqrt(total)


def distance(gap: FloatArray, covariance: FloatArray) -> float:
    """Mahalanobis distance of a gap (d,) with covariance (d, d)."""
    return math.sqrt(max(float(gap @ np.linalg.solve(covariance, gap)), 0.0))
