"""Hypotheses online: tracks carried side by side until their weights tell.

The oracles: the truth of simulated passes, and the smoother's own weights of the same records.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from online import Run, records_of, retimed, run, until, with_options
from sides import Pass, mission

from ubl_graph import (
    Beacon,
    FixedLagEstimator,
    Mission,
    Options,
    PositionFix,
    Segment,
    SoundSpeedProfile,
    Start,
    smooth,
)
from ubl_graph.online.buffer import entry_of
from ubl_graph.online.protocol import encoded, estimate_content
from ubl_graph.sim import Sea, Truth, dvl, pose_sensors, pressure, two_way_pings

#: A vehicle that turns by 30 degrees after 50 s.
TURN = Pass(float(np.deg2rad(30.0)), leg=100.0, off=40.0, above=20.0)
STRAIGHT = replace(TURN, angle=0.0)
#: Of the turn's beginning, s.
AT = 48.0


def made(way: Pass = TURN, seed: int = 1, **changes: object) -> tuple[Mission, Truth]:
    rng = np.random.default_rng(seed)
    options = {"lag": 40.0, "node_spacing": 1.0, **changes}
    return mission(way, rng, 0.2, 2.0, velocity_noise=1.0, **options)


def gaps(said: Run, truth: Truth) -> list[list[float]]:
    """Of each estimate, how far each of its places is from the truth, m."""
    return [
        [float(np.linalg.norm(p.position - truth.position(e.t)[0])) for p in e.hypotheses]
        for e in said.estimates
    ]


def confident_and_wrong(said: Run, truth: Truth) -> list[float]:
    """Times of estimates that lie beyond five sigmas and do not call it ambiguous."""
    out = []
    for e in said.estimates:
        if e.position is None or e.status in ("ambiguous", "lost"):
            continue
        gap = (e.position - truth.position(e.t)[0])[:2]
        if gap @ np.linalg.solve(e.covariance[:2, :2], gap) > 25.0:
            out.append(e.t)
    return out


@pytest.fixture(scope="module", params=[1, 2])
def turning(request) -> tuple[Mission, Truth, Run]:
    way = TURN if request.param == 1 else replace(TURN, side=-1.0)
    given, truth = made(way, request.param)
    return given, truth, run(given, records_of(given.segments[0]))


def test_both_places_are_told_until_the_turn(turning):
    _, truth, said = turning
    before = [e for e in said.estimates if 20.0 < e.t < AT]
    assert {e.status for e in before} == {"ambiguous"}
    for e, off in zip(said.estimates, gaps(said, truth), strict=True):
        assert bool(e.hypotheses) == (e.status == "ambiguous")
        if 20.0 < e.t < AT:
            assert len(off) == 2
            assert min(off) < 2.0
            assert max(off) > 50.0
            assert e.hypotheses[0].position == pytest.approx(e.position)
            assert sum(p.weight for p in e.hypotheses) == pytest.approx(1.0)
            assert min(p.weight for p in e.hypotheses) > 0.02


def test_the_turn_tells_and_the_right_place_stays(turning):
    _, truth, said = turning
    after = [e for e in said.estimates if e.t > AT + 20.0]
    assert {e.status for e in after} <= {"ok", "degraded"}
    assert not any(e.hypotheses for e in after)
    errors, _ = said.errors(truth, AT + 20.0)
    assert errors.max() < 2.0
    assert not confident_and_wrong(said, truth)
    assert said.estimator.core.rivals == []


def test_the_covariance_holds_the_other_place(turning):
    _, truth, said = turning
    for e in said.estimates:
        if e.status == "ambiguous" and e.t > 20.0:
            gap = (e.position - truth.position(e.t)[0])[:2]
            weight = min(p.weight for p in e.hypotheses)
            distance = gap @ np.linalg.solve(e.covariance[:2, :2], gap)
            assert distance < 1.2 / weight + 12.0


@pytest.mark.parametrize("t", [30.0, 47.0, 54.0])
def test_weights_are_those_of_the_smoother(t):
    """What has left the window counts as if it were still there."""
    for lag in (25.0, 200.0):
        given, _ = made(replace(TURN, angle=float(np.deg2rad(0.6))), 3, lag=lag)
        part = replace(given, segments=(until(given.segments[0], t),))
        said = run(given, records_of(part.segments[0]))
        whole = smooth(with_options(part, solver="banded")).segments[0].hypotheses
        last = said.estimates[-1]
        assert len(last.hypotheses) == len(whole) == 2
        ends = [h.trajectory.at(min(last.t, h.trajectory.t[-1])).position[0] for h in whole]
        nearest = min(range(2), key=lambda k: np.linalg.norm(ends[k] - last.position))
        assert last.hypotheses[0].weight == pytest.approx(whole[nearest].weight, abs=0.1)


@pytest.mark.parametrize("what", ["fix", "set", "beacon"])
def test_what_else_tells(what):
    given, truth = made(STRAIGHT, 4)
    records = records_of(given.segments[0])
    estimator = FixedLagEstimator.of(given)
    if what == "beacon":
        second = STRAIGHT.beacon("B2", 30.0, 25.0)
        both, _ = mission(STRAIGHT, np.random.default_rng(4), 0.2, 2.0, others=(second,), lag=40.0)
        late = both.segments[0]
        early = [r for r in records if entry_of(r).t < 60.0]
        records = early + [r for r in records_of(late) if entry_of(r).t >= 60.0]
        estimator = FixedLagEstimator.of(both)
    first = run(estimator, [r for r in records if entry_of(r).t < 60.0])
    assert first.estimates[-1].status == "ambiguous"
    east, north, _ = truth.position(60.0)[0]
    if what == "fix":
        assert estimator.add(PositionFix(60.0, east + 2.0, north, sigma=3.0)).accepted
    if what == "set":
        assert estimator.set_position(60.0, float(east) + 2.0, float(north), sigma=3.0).accepted
    said = run(estimator, [r for r in records if entry_of(r).t >= 60.0])
    after = [e for e in said.estimates if e.t > 72.0]
    assert "ambiguous" not in {e.status for e in after}
    errors, _ = said.errors(truth, 66.0)
    assert errors.max() < 3.0


def test_a_straight_track_is_never_told(tmp_path):
    """Four lags of it; and a checkpoint keeps both tracks."""
    way = replace(STRAIGHT, leg=160.0)
    given, truth = made(way, 5)
    records = records_of(given.segments[0])
    at = next(i for i, r in enumerate(records) if entry_of(r).t > 60.0)
    said = run(given, records[:at])
    said.estimator.checkpoint(tmp_path / "state")
    restored = FixedLagEstimator.restore(tmp_path / "state")
    more, again = run(said.estimator, records[at:]), run(restored, records[at:])
    for one, other in zip(more.estimates, again.estimates, strict=True):
        assert one.status == other.status == "ambiguous"
        weights = [[p.weight for p in e.hypotheses] for e in (one, other)]
        assert weights[0] == pytest.approx(weights[1], abs=1e-6)
    assert min(gaps(more, truth)[-1]) < 2.0


def test_the_protocol_says_both_places_while_they_fit():
    given, _ = made(STRAIGHT, 6)
    part = until(given.segments[0], 40.0)
    last = run(given, records_of(part)).estimates[-1]
    told = json.loads(encoded(estimate_content(last)))
    assert told["status"] == "ambiguous"
    assert len(told["hypotheses"]) == 2
    assert sum(h["weight"] for h in told["hypotheses"]) == pytest.approx(1.0)
    assert [told["hypotheses"][0][k] for k in ("east", "north", "up")] == [
        told[k] for k in ("east", "north", "up")
    ]
    assert {len(h["covariance"]) for h in told["hypotheses"]} == {36}
    sure = replace(last, hypotheses=())
    assert "hypotheses" not in estimate_content(sure)


def overhead(seed: int, off: float) -> tuple[Mission, Truth]:
    """A vehicle that knows its start and its turns, but no heading, and passes over its beacon.

    It turns by 30 degrees after 80 s.
    """
    rng = np.random.default_rng([seed, 3])
    side = float(rng.choice([-1.0, 1.0]))
    angle = float(np.deg2rad(30.0))
    way = Pass(angle, course=0.4, leg=160.0, off=off, above=50.0, side=side, site=(0.0, 0.0))
    truth = way.truth()
    beacon = Beacon("B1", [0.0, 0.0, -55.0])
    profile = SoundSpeedProfile.constant(1500.0)
    t = np.arange(0.0, 110.0, 0.5)
    begin = truth.position(0.0)[0]
    east, north = begin[:2] + 2.0 * rng.standard_normal(2)
    segment = Segment(
        two_way_range=two_way_pings(
            truth, (beacon,), np.arange(1.0, 106.0, 2.0), Sea(profile), rng
        ),
        velocity=dvl(truth, t, rng),
        depth=pressure(truth, t, rng),
        angular_rate=pose_sensors.gyro(truth, t, rng, planar=True),
        start=Start(0.0, float(east), float(north), -5.0, sigma=2.0),
    )
    options = Options(node="pose2", lag=100.0)
    return Mission((segment,), (beacon,), profile, options=options), truth


@pytest.mark.slow
@pytest.mark.parametrize("off", [8.0])
def test_a_pass_overhead_with_an_unknown_heading_is_not_taken_for_known(off):
    given, truth = overhead(1, off)
    said = run(given, records_of(given.segments[0]))
    assert not confident_and_wrong(said, truth)
    assert {e.status for e in said.estimates if 40.0 < e.t < 80.0} == {"ambiguous"}
    assert said.estimates[-1].status in ("ok", "degraded")
    errors, _ = said.errors(truth, 100.0)
    assert errors.max() < 5.0


@pytest.mark.parametrize("by", [-20.0, -60.0])
def test_a_clock_set_back_leaves_both_places(by):
    given, truth = made(replace(STRAIGHT, leg=150.0), 3)
    stream = retimed(records_of(given.segments[0]), by, 80.0)
    said = run(given, stream)
    assert said.estimator.health()["clock_steps"] == 1
    after = [e for e in said.estimates if e.t > 92.0 + by][-8:]
    assert {e.status for e in after} == {"ambiguous"}
    for e in after:
        off = [np.linalg.norm(p.position - truth.position(e.t - by)[0]) for p in e.hypotheses]
        assert min(off) < 15.0 and max(off) > 50.0


def test_noise_of_the_odometry_tells_no_side():
    """An hour's worth of chances in some minutes: ranges so good that the DVL's noise shows."""
    way = replace(STRAIGHT, leg=400.0)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        given, _ = mission(way, rng, 0.02, 2.0, velocity_noise=20.0, lag=40.0, node_spacing=1.0)
        segment = given.segments[0]
        loud = replace(segment.velocity, sigma=np.full(len(segment.velocity), 0.02))
        given = replace(given, segments=(replace(segment, velocity=loud),))
        said = run(given, records_of(given.segments[0]))
        late = [e for e in said.estimates if e.t > 30.0]
        assert {e.status for e in late} == {"ambiguous"}
