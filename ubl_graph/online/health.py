"""How far to trust an estimate: statuses and what they rest on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.online.buffer import ABSOLUTE
from ubl_graph.online.gate import Gate

Status = Literal["initialising", "ok", "coasting", "degraded", "ambiguous", "lost", "rebuilt"]

#: A sensor is silent after so many of its usual intervals,
SILENT_INTERVALS = 5.0
#: but not before this, s.
SILENT_LEAST = 2.0
#: Known worse than this share of the distance to the beacons the vehicle is lost,
LOST_SHARE = 0.1
#: but never where it is known better than this, m.
LOST_LEAST = 50.0
#: Where more than this share of the last pings and fixes, so many at the least, is refused the
#: vehicle is somewhere else.
LOST_REFUSED, LEAST_JUDGED = 0.8, 8
#: Chi-square of a window's pings, per ping, that the sigmas explain.
CHI_SQUARE = 4.0
#: Median squared distance of a sensor's records from what is expected, 1 by right: with twenty of
#: them it passes this once in five hundred.
SURPRISE = 3.5
#: Latencies that are looked back on.
MEMORY = 1000


@dataclass
class Latency:
    """How long updates take, s."""

    count: int = 0
    most: float = 0.0
    overruns: int = 0
    recent: list[float] = field(default_factory=list[float])

    def note(self, seconds: float, available: float) -> None:
        """Note an update that had `available` seconds of the vehicle's time."""
        self.count += 1
        self.most = max(self.most, seconds)
        self.overruns += seconds > available > 0.0
        if len(self.recent) < MEMORY:
            self.recent.append(seconds)
        else:
            self.recent[self.count % MEMORY] = seconds

    def summary(self) -> dict[str, float | int | None]:
        """Milliseconds: median and 99th percentile of the last updates, the longest of all."""
        some = np.array(self.recent) * 1e3 if self.recent else None
        return {
            "updates": self.count,
            "latency_p50_ms": None if some is None else round(float(np.median(some)), 3),
            "latency_p99_ms": None if some is None else round(float(np.percentile(some, 99)), 3),
            "latency_max_ms": round(1e3 * self.most, 3),
            "overruns": self.overruns,
        }


@dataclass(frozen=True)
class Facts:
    """What a status is judged by.

    Attributes
    ----------
    t : float
        Of the estimate, s.
    located : bool
        Whether there is a position.
    rebuilt : bool
        Whether the estimate was begun anew since the last output.
    waiting : str
        Why there is no position, or why it is doubtful; empty where it is not.
    ambiguous : str
        Why the position is not unique; empty where it is.
    warm_until : float
        Until when the window is shorter than the lag, s.
    notes : mapping of str to float
        What happened, and until when it matters, s.
    distance : float
        To the beacons, m.
    chi_square : float
        Of the window's pings, per ping.
    """

    t: float
    located: bool
    rebuilt: bool
    waiting: str
    ambiguous: str
    warm_until: float
    notes: Mapping[str, float]
    distance: float
    chi_square: float


def judge(
    facts: Facts, gates: Mapping[str, Gate], covariance: FloatArray | None
) -> tuple[Status, tuple[str, ...]]:
    """Status of an estimate, and why it is not ok.

    Parameters
    ----------
    facts : Facts
        What is known of the estimate.
    gates : mapping of str to Gate
        By sensor.
    covariance : array, shape (6, 6), or None
        Of the estimate.
    """
    if not facts.located or covariance is None:
        return "initialising", (facts.waiting or "waiting for ranges or a position",)
    sigma = math.sqrt(max(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]), 0.0))
    silent = silences(facts.t, gates)
    reasons = [facts.ambiguous, *_doubts(facts, gates), *silent.values()]
    lost = sigma > max(LOST_LEAST, LOST_SHARE * facts.distance)
    if lost:
        reasons.insert(0, f"horizontal standard deviation {sigma:.0f} m")
    lost = lost or _contradicted(gates)
    given = tuple(r for r in reasons if r)
    if facts.ambiguous:
        return "ambiguous", given
    if lost or facts.waiting:
        return "lost", tuple(filter(None, (facts.waiting, *given)))
    if facts.rebuilt:
        return "rebuilt", ("begun anew from the records of the last lag", *given)
    absolute = [kind for kind in ABSOLUTE if gates[kind].last is not None]
    if all(kind in silent for kind in absolute):
        return "coasting", given
    if facts.t < facts.warm_until:
        wait = facts.warm_until - facts.t
        return "degraded", (f"{wait:.0f} s until the window is full", *given)
    return ("degraded", given) if given else ("ok", ())


def _contradicted(gates: Mapping[str, Gate]) -> bool:
    """Whether all but all that tells of the position is refused."""
    heard = [gates[kind] for kind in ABSOLUTE if gates[kind].recent]
    judged = sum(len(gate.recent) for gate in heard)
    return judged >= LEAST_JUDGED and sum(sum(g.recent) for g in heard) > LOST_REFUSED * judged


def silences(t: float, gates: Mapping[str, Gate]) -> dict[str, str]:
    """Sensors that have been heard and are silent now, with what to say of it."""
    out: dict[str, str] = {}
    for kind, gate in gates.items():
        last = gate.last
        if last is None:
            continue
        interval = gate.interval
        patience = SILENT_LEAST if interval is None else SILENT_INTERVALS * interval
        if t - last <= max(patience, SILENT_LEAST):
            continue
        # A sensor that spoke but once or twice (a fix at the start) has no rhythm to miss.
        if interval is not None or kind in ABSOLUTE:
            out[kind] = f"{kind}: nothing accepted for {t - last:.1f} s"
    # Ranges and fixes stand in for each other: one that goes on excuses the others.
    absolute = [k for k in ABSOLUTE if gates[k].last is not None]
    if any(k not in out for k in absolute):
        out = {k: text for k, text in out.items() if k not in ABSOLUTE}
    return out


def _doubts(facts: Facts, gates: Mapping[str, Gate]) -> list[str]:
    doubts = [note for note, until in facts.notes.items() if facts.t < until]
    for kind, gate in gates.items():
        if kind in ABSOLUTE and gate.recent and gate.recent[-1]:
            doubts.append(f"{kind}: the last record was refused")
        elif gate.is_uneasy:
            doubts.append(f"{kind}: {100 * gate.refused_share:.0f} % of the last records refused")
        if gate.surprise > SURPRISE:
            doubts.append(
                f"{kind}: {gate.surprise:.1f} times the squared distance from what is expected"
            )
    if facts.chi_square > CHI_SQUARE:
        doubts.append(f"chi-square per ping is {facts.chi_square:.1f}: sigmas are too small")
    return doubts


def sensor_report(t: float | None, gates: Mapping[str, Gate]) -> dict[str, Any]:
    """Counts and ages by sensor, ready for JSON."""
    silent = {} if t is None else silences(t, gates)
    return {
        kind: {
            "accepted": gate.accepted,
            "rejected": {reason: n for reason, n in gate.rejected.items() if n},
            "age_s": None if t is None or gate.last is None else round(t - gate.last, 6),
            "interval_s": None if gate.interval is None else round(gate.interval, 6),
            "silent": kind in silent,
        }
        for kind, gate in gates.items()
        if gate.accepted or gate.rejected
    }
