"""Records that come late, out of order, or twice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from online import moved, records_of, run, survey, with_options
from test_online_exact import linear_mission

from ubl_graph import Mission
from ubl_graph.online.buffer import entry_of
from ubl_graph.records import Records
from ubl_graph.sim import fixes

LAG = 30.0
KINDS = ("velocity", "attitude", "depth", "two_way_range", "position")


def shuffled(records: list[Records], seed: int, delay: float, share: float) -> list[Records]:
    """Records in the order of arrival where a share of them is late, by up to `delay` seconds."""
    rng = np.random.default_rng(seed)
    late = rng.uniform(0.0, delay, len(records)) * (rng.random(len(records)) < share)
    arrival = np.array([entry_of(r).t for r in records]) + late
    return [records[i] for i in np.argsort(arrival, kind="stable")]


def assert_all_count(result) -> None:
    """Every record counts in the end: one refused for want of those still to come came back."""
    assert all(o.accepted or not o.final for o in result.outcomes)
    gone = sum(not o.accepted for o in result.outcomes)
    gone += sum({"rejected": 1, "readmitted": -1}[e.kind] for e in result.events)
    assert gone == 0
    assert result.estimator.health()["clock_steps"] == 0


#: No shrinking: a run takes half a second.
PHASES = (Phase.explicit, Phase.generate)
orders = given(
    seed=st.integers(0, 10_000),
    delay=st.sampled_from([0.3, 2.0, 7.0]),
    share=st.sampled_from([0.1, 0.5, 1.0]),
)


@pytest.mark.parametrize("engine", ["lm", "isam2"])
@pytest.mark.parametrize("odometry", [True, False])
def test_linear_records_in_any_order_within_the_lag(engine, odometry):
    mission = linear_mission(1, duration=40.0, odometry=odometry, engine=engine)
    mission = with_options(mission, lag=12.0)
    records = records_of(mission.segments[0])
    ordered = run(mission, records, at_every=())
    assert_all_count(ordered)
    # The first records tell where the window begins: late ones before it are behind the start.
    end = 60.0
    expected = ordered.estimator.estimate(end)

    @settings(max_examples=12 if engine == "lm" else 4, phases=PHASES)
    @orders
    def check(seed, delay, share):
        result = run(mission, shuffled(records, seed, delay, share), at_every=())
        assert_all_count(result)
        got = result.estimator.estimate(end)
        assert np.abs(got.position - expected.position).max() < 1e-6
        assert np.abs(got.velocity - expected.velocity).max() < 1e-6
        scale = np.sqrt(np.diagonal(expected.covariance))
        gap = np.abs(got.covariance - expected.covariance) / np.outer(scale, scale)
        assert gap.max() < 1e-6

    check()


def short(lag: float, seed: int = 1, **more) -> tuple[Mission, list[Records]]:
    """A minute or so of a survey."""
    sizes = {"lines": 1, "length": 110.0, "dvl_rate": 2.0, "lag": lag, **more}
    mission, _ = survey(seed, **sizes)
    return mission, records_of(mission.segments[0])


@settings(max_examples=8, phases=PHASES)
@orders
def test_pings_in_any_order_while_nothing_leaves_the_window(seed, delay, share):
    mission, records = short(200.0)
    expected = run(mission, records, at_every=()).estimator
    result = run(mission, shuffled(records, seed, delay, share), at_every=())
    assert_all_count(result)
    t = entry_of(records[-1]).t
    got, whole = result.estimator.estimate(t + 1.0), expected.estimate(t + 1.0)
    assert np.abs(got.position - whole.position).max() < 1e-6
    assert np.abs(got.velocity - whole.velocity).max() < 1e-6
    times = np.linspace(5.0, t - 1.0, 30)
    back, before = result.estimator.smoothed(times), expected.smoothed(times)
    assert np.abs(back.position - before.position).max() < 1e-6


@settings(max_examples=8, phases=PHASES)
@orders
def test_pings_in_any_order_while_nodes_leave_the_window(seed, delay, share):
    mission, records = short(LAG)
    expected = run(mission, records, at_every=()).estimator
    result = run(mission, shuffled(records, seed, delay, share), at_every=())
    assert_all_count(result)
    t = entry_of(records[-1]).t + 1.0
    got, whole = result.estimator.estimate(t), expected.estimate(t)
    sigma = np.sqrt(np.diagonal(whole.covariance))
    assert (np.abs(got.position - whole.position) < 0.05 * sigma[:3]).all()
    assert (np.abs(got.velocity - whole.velocity) < 0.05 * sigma[3:]).all()


def mixed(engine: str = "lm") -> tuple[Mission, list[Records]]:
    """One with a fix every 5 s, and a heading that trembles."""
    rng = np.random.default_rng(7)
    mission, truth = survey(3, lines=1, length=110.0, dvl_rate=2.0, lag=LAG, engine=engine)
    segment = mission.segments[0]
    heading = segment.attitude.heading + 0.01 * rng.standard_normal(len(segment.attitude))
    segment = replace(
        segment,
        attitude=replace(segment.attitude, heading=heading),
        position=fixes(truth, np.arange(2.5, truth.span[1], 5.0), rng, sigma=0.3),
    )
    return replace(mission, segments=(segment,)), records_of(segment)


@pytest.mark.parametrize("engine", ["lm", "isam2"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_late_record_is_fused_at_its_own_time(kind, engine):
    mission, records = mixed(engine)
    at = next(i for i, r in enumerate(records) if entry_of(r).kind == kind and entry_of(r).t > 45.0)
    stop = next(i for i, r in enumerate(records) if entry_of(r).t > 45.0 + 0.5 * LAG)
    late = records[at]
    t = entry_of(late).t
    without_it = run(mission, [*records[:at], *records[at + 1 : stop]], at_every=())
    estimator = without_it.estimator
    before = estimator.smoothed(t)
    assert estimator.add(late).accepted
    in_order = run(mission, records[:stop], at_every=()).estimator
    times = np.array([t - 3.0, t, t + 3.0])
    got, expected = estimator.smoothed(times), in_order.smoothed(times)
    sigma = np.sqrt(np.einsum("kii->ki", expected.covariance))
    # Nodes that left meanwhile were linearised a little elsewhere.
    assert (np.abs(got.position - expected.position) < 0.01 * sigma).all()
    assert np.abs(got.covariance / expected.covariance - 1.0)[:, [0, 1, 2], [0, 1, 2]].max() < 0.01
    # It says something there, or the comparison would prove nothing.
    assert np.abs(before.position - got.position[1]).max() > 1e-7


@pytest.mark.parametrize("kind", KINDS)
def test_a_record_older_than_the_lag_is_refused_and_changes_nothing(kind):
    mission, records = mixed()
    estimator = run(mission, records, at_every=()).estimator
    now = estimator.health()["t"]
    old = next(r for r in records if entry_of(r).kind == kind and entry_of(r).t > 5.0)
    old = moved(old, 0.0123)
    estimator.window()
    before = estimator.core.moment(now)
    nodes = estimator.window()
    outcome = estimator.add(old)
    age = now - entry_of(old).begin
    assert not outcome.accepted
    assert outcome.reason.startswith("too old")
    assert f"{age:.1f} s" in outcome.reason
    after = estimator.core.moment(now)
    assert np.array_equal(before.mean, after.mean)
    assert np.array_equal(before.covariance, after.covariance)
    assert np.array_equal(nodes.position, estimator.window().position)
    assert estimator.health()["sensors"][kind]["rejected"]["too old"] == 1


@pytest.mark.parametrize("kind", KINDS)
def test_a_record_just_within_the_lag_is_taken(kind):
    mission, records = mixed()
    at = next(i for i, r in enumerate(records) if entry_of(r).kind == kind and entry_of(r).t > 20.0)
    begin = entry_of(records[at]).begin
    stop = next(i for i, r in enumerate(records) if entry_of(r).t > begin + LAG - 0.05)
    estimator = run(mission, [*records[:at], *records[at + 1 : stop]], at_every=()).estimator
    assert estimator.add(records[at]).accepted


@pytest.mark.parametrize("kind", KINDS)
def test_a_record_that_came_before_is_counted_once(kind):
    mission, records = mixed()
    stop = len(records) - 40
    estimator = run(mission, records[:stop], at_every=()).estimator
    again = [r for r in records[:stop] if entry_of(r).kind == kind][-2]
    now = estimator.health()["t"]
    accepted = estimator.health()["sensors"][kind]["accepted"]
    before = estimator.core.moment(now)
    column = {"position": "east", "two_way_range": "travel_time", "velocity": "forward"}
    name = column.get(kind, kind if kind == "depth" else "heading")
    other = replace(again, **{name: getattr(again, name) + 1e-4})
    for record in (again, moved(again, 0.0), other):
        outcome = estimator.add(record)
        assert not outcome.accepted
        assert outcome.reason.startswith("duplicate")
    after = estimator.core.moment(now)
    assert np.array_equal(before.mean, after.mean)
    report = estimator.health()["sensors"][kind]
    assert report["accepted"] == accepted
    assert report["rejected"]["duplicate"] == 3


def test_pings_of_two_beacons_with_the_same_stamps_are_two():
    mission, records = mixed()
    ping = next(r for r in records if entry_of(r).kind == "two_way_range")
    other = replace(ping, beacon="B4" if str(ping.beacon[0]) != "B4" else "B3")
    estimator = run(mission, records[:200], at_every=()).estimator
    assert estimator.core.tracker.buffer.twin(entry_of(ping)) is not None
    assert estimator.core.tracker.buffer.twin(entry_of(other)) is None


def test_several_records_at_once_are_taken_one_by_one():
    mission, records = mixed()
    segment = mission.segments[0]
    estimator = run(mission, records[:100], at_every=()).estimator
    now = estimator.health()["t"]
    batch = segment.depth[(segment.depth.t > now) & (segment.depth.t < now + 10.0)]
    assert len(batch) > 5
    assert estimator.add(batch).accepted
    mixed_batch = segment.depth[(segment.depth.t > now + 5.0) & (segment.depth.t < now + 15.0)]
    outcome = estimator.add(mixed_batch)
    assert not outcome.accepted
    assert outcome.reason.startswith("duplicate")
    assert estimator.health()["t"] == mixed_batch.t[-1]
