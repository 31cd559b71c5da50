"""Feed a recorded segment to the online estimator in order of arrival, and score what it says."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from ubl_graph.arrays import FloatArray
from ubl_graph.errors import TimeError
from ubl_graph.mission import Mission, Reference, Segment, Setup
from ubl_graph.online.estimator import Estimate, FixedLagEstimator, Outcome
from ubl_graph.records import Records
from ubl_graph.trajectory import Trajectory

#: Kinds in the order in which records of the same time arrive: pings last.
ORDER = ("attitude", "velocity", "depth", "position", "two_way_range", "one_way_range")
PINGS = ("two_way_range", "one_way_range")

#: East and north (M, 2) at some times (M,); nan where nothing is known.
Truth = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, eq=False)
class Track:
    """Horizontal positions, one row a ping; nan where there was none.

    Attributes
    ----------
    t : array, shape (M,)
        s.
    place : array, shape (M, 2)
        East, north, m.
    covariance : array, shape (M, 2, 2)
        m^2.
    """

    t: FloatArray
    place: FloatArray
    covariance: FloatArray

    def __getitem__(self, rows: Any) -> Track:
        return Track(self.t[rows], self.place[rows], self.covariance[rows])


@dataclass(frozen=True, eq=False)
class Run:
    """What the estimator said of a segment, and how long it took; one row a ping.

    Attributes
    ----------
    name : str
        Of the segment.
    scored : array of bool, shape (M,)
        Pings received later than one lag after the first one.
    newest, half_lag : Track
        At the ping's receive time, and half a lag before it, right after the ping.
    estimates : list of Estimate
        What `newest` is of, with statuses and reasons.
    latency : array, shape (M,)
        Time that `add` took, s.
    rejected : int
        Pings that did not count in the end.
    behind : float
        In real time: how late a record was taken at the most, s.
    """

    name: str
    scored: np.ndarray
    newest: Track
    half_lag: Track
    estimates: list[Estimate]
    latency: FloatArray
    rejected: int
    behind: float

    @property
    def status(self) -> np.ndarray:
        """Status of each newest estimate, shape (M,)."""
        return np.array([e.status for e in self.estimates], dtype=np.str_)


@dataclass
class Pace:
    """Waits until a record's time has come.

    Attributes
    ----------
    factor : float or None
        So many times as fast as it was recorded; None does not wait.
    behind : float
        The longest that a record had to wait for the estimator, s.
    """

    factor: float | None = None
    behind: float = 0.0
    _begin: tuple[float, float] | None = None

    def wait(self, t: float) -> None:
        """Sleep until the record of time `t` is due; the first one is due at once."""
        if self.factor is None:
            return
        if self._begin is None:
            self._begin = (t, time.perf_counter())
        due = self._begin[1] + (t - self._begin[0]) / self.factor
        rest = due - time.perf_counter()
        if rest > 0.0:
            time.sleep(rest)
        self.behind = max(self.behind, -rest)


@dataclass
class _Tally:
    """Pings that do not count, as outcomes and events say."""

    refused: set[Records] = field(default_factory=set[Records])

    def note(self, record: Records, outcome: Outcome) -> None:
        if not outcome.accepted:
            self.refused.add(record)
        for event in outcome.others:
            self.turn(event.record, event.kind == "rejected")

    def turn(self, record: Any, refused: bool) -> None:
        (self.refused.add if refused else self.refused.discard)(record)

    def pings(self, made: set[Records]) -> int:
        return len(self.refused & made)


def arrivals(segment: Segment) -> Iterator[tuple[float, bool, Records]]:
    """Records one by one as they arrive: time, whether it is a ping, record.

    A ping arrives at its receive time, all else at its own. Of what comes at the same time the
    pings come last, so that attitude and depth of that time are there.
    """
    records = segment.records()
    stamps = [
        (float(t), rank, i)
        for rank, kind in enumerate(ORDER)
        if kind in records
        for i, t in enumerate(_stamps(records[kind]))
    ]
    for t, rank, i in sorted(stamps):
        yield t, ORDER[rank] in PINGS, records[ORDER[rank]][i]


def _stamps(records: Any) -> FloatArray:
    return records.t_receive if hasattr(records, "t_receive") else records.t


def count(segment: Segment) -> int:
    """Number of records of a segment."""
    return sum(len(rows) for rows in segment.records().values())


def run(segment: Segment, setup: Setup, pace: Pace, done: Callable[[], None] = lambda: None) -> Run:
    """Feed a segment to an estimator of its own.

    Parameters
    ----------
    segment : Segment
        With ranges.
    setup : Setup
        Of the mission; the segment's start is put in.
    pace : Pace
        Of this run alone.
    done : callable, optional
        Called after each record.
    """
    estimator = FixedLagEstimator.of(replace(setup, start=segment.start))
    half = 0.5 * setup.options.lag
    tally, pings = _Tally(), set[Records]()
    estimates: list[Estimate] = []
    halves: list[Track] = []
    latency: list[float] = []
    for t, is_ping, record in arrivals(segment):
        pace.wait(t)
        begin = time.perf_counter()
        outcome = estimator.add(record)
        taken = time.perf_counter() - begin
        tally.note(record, outcome)
        if is_ping:
            pings.add(record)
            latency.append(taken)
            estimates.append(estimator.estimate(t))
            halves.append(_smoothed(estimator, t - half))
        done()
    for event in estimator.flush():
        tally.turn(event.record, event.kind == "rejected")
    t = np.array([e.t for e in estimates])
    return Run(
        segment.name,
        t > t[0] + setup.options.lag if len(t) else np.zeros(0, dtype=bool),
        _joined([_newest(e) for e in estimates]),
        _joined(halves),
        estimates,
        np.array(latency),
        tally.pings(pings),
        pace.behind,
    )


def _newest(estimate: Estimate) -> Track:
    if estimate.position is None or estimate.covariance is None:
        return _nowhere(estimate.t)
    covariance = estimate.covariance[None, :2, :2]
    return Track(np.array([estimate.t]), estimate.position[None, :2], covariance)


def _smoothed(estimator: FixedLagEstimator, t: float) -> Track:
    try:
        states = estimator.smoothed(t)
    except TimeError:
        return _nowhere(t)
    return Track(states.t, states.position[:, :2], states.covariance[:, :2, :2])


def _nowhere(t: float) -> Track:
    return Track(np.array([t]), np.full((1, 2), np.nan), np.full((1, 2, 2), np.nan))


def _joined(tracks: Sequence[Track]) -> Track:
    empty = _nowhere(0.0)[:0]
    parts = [empty, *tracks]
    return Track(*(np.concatenate([getattr(p, n) for p in parts]) for n in Track.__annotations__))


def of_reference(reference: Reference) -> Truth:
    """A reference track at any time of its span.

    Between its times it is interpolated by monotone cubics (PCHIP), east and north each for
    itself: they do not overshoot where the reference has a gap. What that is worth on SAGA.1903,
    where pings are 1 to 10 s apart: against the ship's own position at the receive times, 0.12 to
    0.19 m RMS by line and 0.54 m at the most. Straight lines give 0.13 to 0.24 and 1.1 m, a cubic
    spline 0.13 to 0.32 and 3.9 m. Much of it is the transducer swinging under the rolling ship.
    """
    t, first = np.unique(reference.t, return_index=True)
    place = reference.position[first, :2]
    if len(t) < 2:
        return lambda times: np.full((len(times), 2), np.nan)
    return PchipInterpolator(t, place, extrapolate=False)


def of_trajectory(trajectory: Trajectory) -> Truth:
    """A smoothed track at any time of its span."""

    def at(times: FloatArray) -> FloatArray:
        place = np.full((len(times), 2), np.nan)
        inside = (times >= trajectory.t[0]) & (times <= trajectory.t[-1])
        place[inside] = trajectory.at(times[inside]).position[:, :2]
        return place

    return at


@dataclass(frozen=True, eq=False)
class Errors:
    """Horizontal errors of a track.

    Attributes
    ----------
    t, error : array, shape (M,)
        s, m; nan where track or truth is unknown.
    nees : array, shape (M,)
        Squared Mahalanobis length: 2 on average where the covariance is true.
    """

    t: FloatArray
    error: FloatArray
    nees: FloatArray

    def __getitem__(self, rows: Any) -> Errors:
        return Errors(self.t[rows], self.error[rows], self.nees[rows])


def errors_of(track: Track, truth: Truth) -> Errors:
    """Compare a track with the truth, row by row."""
    gap = track.place - truth(track.t)
    nees = np.full(len(gap), np.nan)
    known = np.isfinite(gap).all(axis=1)
    solved = np.linalg.solve(track.covariance[known], gap[known][..., None])[..., 0]
    nees[known] = np.einsum("mi,mi->m", gap[known], solved)
    return Errors(track.t, np.hypot(*gap.T), nees)


@dataclass(frozen=True, eq=False)
class Score:
    """A run against the truth; one row a ping.

    Attributes
    ----------
    run : Run
        What is scored.
    newest, half_lag : Errors
        Of the two tracks.
    smoothed : array, shape (M,), or None
        Horizontal error of the track smoothed over the whole segment, at the receive times, m.
    """

    run: Run
    newest: Errors
    half_lag: Errors
    smoothed: FloatArray | None


def score(run: Run, truth: Truth, smoothed: Truth | None) -> Score:
    """Score a run against the truth; `smoothed`, where given, is scored beside it."""
    offline = None
    if smoothed is not None:
        offline = np.hypot(*(smoothed(run.newest.t) - truth(run.newest.t)).T)
    newest, half_lag = (errors_of(track, truth) for track in (run.newest, run.half_lag))
    return Score(run, newest, half_lag, offline)


def summary(scores: Sequence[Score]) -> dict[str, float | int | None]:
    """The numbers of some runs together; docs/replay.md says what each means."""

    def scored(values: Callable[[Score], Any]) -> Any:
        return np.concatenate([values(s)[s.run.scored] for s in scores])

    newest, nees = scored(lambda s: s.newest.error), scored(lambda s: s.newest.nees)
    half, half_nees = scored(lambda s: s.half_lag.error), scored(lambda s: s.half_lag.nees)
    ok = scored(lambda s: s.run.status) == "ok"
    located = scored(lambda s: np.isfinite(s.run.newest.place[:, 0]))
    smoothed = [s.smoothed[s.run.scored] for s in scores if s.smoothed is not None]
    latency = 1e3 * np.concatenate([s.run.latency for s in scores])
    return {
        "newest_rmse_m": _rms(newest),
        "newest_median_m": _of(np.median, newest),
        "newest_max_m": _of(np.max, newest),
        "newest_rmse_ok_m": _rms(newest[ok]),
        "half_lag_rmse_m": _rms(half),
        "half_lag_median_m": _of(np.median, half),
        "half_lag_max_m": _of(np.max, half),
        "smoothed_rmse_m": _rms(np.concatenate(smoothed)) if smoothed else None,
        "mean_nees": _of(np.mean, nees),
        "mean_nees_ok": _of(np.mean, nees[ok]),
        "half_lag_mean_nees": _of(np.mean, half_nees),
        "latency_p50_ms": _of(np.median, latency),
        "latency_p99_ms": _of(lambda x: np.percentile(x, 99), latency),
        "latency_max_ms": _of(np.max, latency),
        "rejected": sum(s.run.rejected for s in scores),
        "share_ok": _of(np.mean, ok),
        "updates": len(latency),
        "scored": int(np.isfinite(newest).sum()),
        "half_lag_scored": int(np.isfinite(half).sum()),
        "unanswered": int((~located).sum()),
        "segments": len(scores),
    }


def _of(what: Callable[[Any], Any], values: Any) -> float | None:
    known = values[np.isfinite(values)]
    return float(what(known)) if len(known) else None


def _rms(values: FloatArray) -> float | None:
    return _of(lambda x: np.sqrt(np.mean(x**2)), values)


def chosen(mission: Mission, names: Sequence[str]) -> Mission:
    """The mission with some of its segments alone, in its own order; all where none is named."""
    if not names:
        return mission
    return replace(mission, segments=tuple(s for s in mission.segments if s.name in names))
