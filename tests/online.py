"""Streams for tests of the online estimator: a mission's records in the order they arrive."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace

import numpy as np

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.beacon import Beacon
from ubl_graph.measurements import ATTITUDE_SIGMA
from ubl_graph.mission import RECORD_KINDS, Mission, Segment
from ubl_graph.online.buffer import entry_of
from ubl_graph.online.estimator import Estimate, Event, FixedLagEstimator, Outcome
from ubl_graph.options import Options
from ubl_graph.records import Records
from ubl_graph.sim import sensors
from ubl_graph.sim.tracks import Truth, lawn_mower

#: Kinds that arrive first where stamps are equal: a ping finds the attitude that it needs.
RANK = {"attitude": 0, "velocity": 1, "depth": 2, "position": 3}

#: Columns that hold times.
STAMPS = ("t", "t_transmit", "t_receive")


def records_of(segment: Segment) -> list[Records]:
    """All records one by one, each at the time it is complete."""
    rows: list[tuple[float, int, int, Records]] = []
    for kind, records in segment.records().items():
        for i in range(len(records)):
            one = records[i]
            rows.append((entry_of(one).t, RANK.get(kind, 9), len(rows), one))
    return [row[-1] for row in sorted(rows, key=lambda row: row[:3])]


def with_options(mission: Mission, **changes) -> Mission:
    return replace(mission, options=replace(mission.options, **changes))


def until(segment: Segment, t: float) -> Segment:
    """The part of a segment that is complete at `t`, s."""
    kept = {}
    for kind, records in segment.records().items():
        done = np.array([entry_of(records[i]).t <= t for i in range(len(records))])
        kept[kind] = records[done] if done.any() else None
    return replace(segment, **kept, reference=None)


def without(
    records: Iterable[Records], kinds: Iterable[str], begin: float, end: float
) -> list[Records]:
    """Records but for those of some kinds with begin <= t < end."""
    gone = set(kinds)
    assert gone <= set(RECORD_KINDS)
    return [r for r in records if not (entry_of(r).kind in gone and begin <= entry_of(r).t < end)]


def moved(record: Records, by: float) -> Records:
    """A record stamped by a clock that is `by` seconds ahead."""
    columns = {
        f.name: getattr(record, f.name) + by if f.name in STAMPS else getattr(record, f.name)
        for f in fields(record)
        if f.name != "source"
    }
    return type(record)(**columns)


def retimed(
    records: Iterable[Records], by: float, begin: float, end: float = np.inf
) -> list[Records]:
    """Records in the same order, those with begin <= t < end stamped `by` seconds later."""
    return [moved(r, by) if begin <= entry_of(r).t < end else r for r in records]


@dataclass
class Run:
    """What an estimator said along a stream."""

    estimator: FixedLagEstimator
    estimates: list[Estimate] = field(default_factory=list)
    outcomes: list[Outcome] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)

    def errors(
        self,
        truth: Truth,
        after: float = -np.inf,
        status: str | None = None,
        *,
        before: float = np.inf,
        ahead: float = 0.0,
    ):
        """Horizontal errors (m) and squared Mahalanobis distances of two components.

        `ahead`: the clock that stamped the records is so many seconds ahead of the truth's.
        """
        errors, distances = [], []
        for e in self.estimates:
            if e.position is None or not after <= e.t < before:
                continue
            if status is not None and e.status != status:
                continue
            gap = (e.position - truth.position(e.t - ahead)[0])[:2]
            errors.append(np.hypot(*gap))
            distances.append(gap @ np.linalg.solve(e.covariance[:2, :2], gap))
        return np.array(errors), np.array(distances)

    def share(self, status: str, after: float = -np.inf) -> float:
        some = [e.status == status for e in self.estimates if e.t >= after]
        return float(np.mean(some))


def run(mission_or_estimator, records: Iterable[Records], at_every=("two_way_range",)) -> Run:
    """Feed records; an estimate after each accepted one of the kinds in `at_every`."""
    estimator = mission_or_estimator
    if isinstance(estimator, Mission):
        estimator = FixedLagEstimator.of(estimator)
    out = Run(estimator)
    for record in records:
        outcome = estimator.add(record)
        out.outcomes.append(outcome)
        out.events += outcome.others
        if outcome.accepted and entry_of(record).kind in at_every:
            out.estimates.append(estimator.estimate())
    return out


def survey(
    seed: int = 1,
    *,
    lines: int = 3,
    length: float = 250.0,
    ping: float = 2.0,
    dvl_rate: float = 5.0,
    outliers: float = 0.0,
    beacons: int = 4,
    one_way: bool = False,
    **options,
) -> tuple[Mission, Truth]:
    """A survey inside a net of beacons: DVL, attitude and depth with the errors they state."""
    rng = np.random.default_rng(seed)
    options = Options(**options)
    truth = lawn_mower(
        [0.0, 0.0], depth=60.0, lines=lines, length=length, spacing=50.0, speed=1.5, course=0.6
    )
    end = truth.span[1] - 5.0
    net = tuple(
        Beacon(f"B{i + 1}", place, turnaround=0.2)
        for i, place in enumerate(
            [[-180.0, 150.0, -118.0], [190.0, 170.0, -122.0], [200.0, -160.0, -120.0],
             [-170.0, -190.0, -124.0]][:beacons]
        )
    )  # fmt: skip
    profile = SoundSpeedProfile.constant(1490.0)
    sea = sensors.Sea(profile, log_scale=float(1e-3 * rng.standard_normal()))
    misalignment = np.deg2rad(options.dvl_misalignment_sigma_deg) * rng.standard_normal(3)
    errors = sensors.DvlErrors(
        float(options.dvl_scale_sigma * rng.standard_normal()),
        tuple(misalignment),
        tuple(options.dvl_bias_sigma * rng.standard_normal(3)),
    )
    heading = float(ATTITUDE_SIGMA * rng.standard_normal())
    sent = np.arange(1.0, end - 3.0, ping)
    times = np.arange(0.0, end, 1.0 / dvl_rate)
    pings = {}
    if one_way:
        clock = sensors.Clock(0.3, 2e-7)
        pings["one_way_range"] = sensors.one_way_pings(truth, net, sent, sea, rng, clock=clock)
    else:
        pings["two_way_range"] = sensors.two_way_pings(
            truth, net, sent, sea, rng, outliers=outliers
        )
    segment = Segment(
        **pings,
        velocity=sensors.dvl(truth, times, rng, errors=errors),
        attitude=sensors.ahrs(truth, times, error=(heading, 0.0, 0.0)),
        depth=sensors.pressure(truth, np.arange(0.0, end), rng),
        reference=truth.reference(sent),
    )
    return Mission((segment,), net, profile, options=options, name="survey"), truth
