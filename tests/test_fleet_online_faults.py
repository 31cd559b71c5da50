"""Online fleets under faults: bad, late and wrong records, jumps, failing solvers, silence."""

from dataclasses import replace

import numpy as np
import pytest

from ubl_graph.cooperative.fleet import Fleet, Member, Target
from ubl_graph.errors import DataError, SolverError, TimeError, UblGraphError
from ubl_graph.measurements import (
    Heading,
    Odometry,
    OneWayRange,
    PositionFix,
    SlantRange,
    TwoWayRange,
    Velocity,
)
from ubl_graph.online.fleet_estimator import FleetEstimator
from ubl_graph.online.fleet_replay import bare, stream
from ubl_graph.online.fleet_system import System
from ubl_graph.options import Options
from ubl_graph.segment import Segment, Start
from ubl_graph.sim.fleets import random_fleet


def fed(seed=0, vehicles=3, duration=150.0, lag=60.0, targets=0, **more):
    """An estimator that has seen a whole small mission, and the truth."""
    fleet, truths = random_fleet(seed, vehicles, duration, targets=targets, **more)
    estimator = FleetEstimator(bare(fleet), lag)
    for _, vehicle, record in stream(fleet):
        estimator.add(vehicle, record)
        if not isinstance(record, Odometry):
            estimator.update()
    estimator.update()
    return estimator, truths


def said(estimator, t=None):
    """All that an estimator says of positions."""
    out = []
    for name in estimator.fleet.vehicle_names:
        end = estimator.core.lines[name].end if t is None else t
        pose = estimator.smoothed(name, end)
        out += [*pose.position, *pose.covariance.ravel(), pose.heading, pose.heading_sigma]
    return np.array(out)


BAD = {
    "an unknown vehicle": lambda: ("V9", Heading(149.0, 0.0)),
    "an unknown end": lambda: ("V0", SlantRange(149.0, "V01", 10.0)),
    "itself": lambda: ("V0", SlantRange(149.0, "V0", 10.0)),
    "itself, two-way": lambda: ("V1", TwoWayRange("V1", 148.0, 149.0, 1.0)),
    "a kind that is not taken": lambda: ("V0", Velocity(149.0, 1.0, 0.0, 0.0)),
    "no record": lambda: ("V0", 3.0),
    "not finite": lambda: ("V0", SlantRange(149.0, "V1", np.nan)),
    "infinite odometry": lambda: ("V0", Odometry(149.0, 150.0, np.inf, 0.0)),
    "degrees": lambda: ("V0", Heading(149.0, 270.0)),
    "a negative travel time": lambda: ("V0", TwoWayRange("V1", 148.0, 149.0, -0.1)),
    "a time that is none": lambda: (
        "V0",
        SlantRange.unchecked(
            t=np.array([np.nan]),
            beacon=np.array(["V1"]),
            distance=np.array([10.0]),
            sigma=np.array([1.0]),
        ),
    ),
    "a value that is none": lambda: (
        "V0",
        SlantRange.unchecked(
            t=np.array([149.0]),
            beacon=np.array(["V1"]),
            distance=np.array([np.inf]),
            sigma=np.array([1.0]),
        ),
    ),
    "odometry that is none": lambda: (
        "V0",
        Odometry.unchecked(
            t_from=np.array([149.0]),
            t_to=np.array([150.0]),
            forward=np.array([np.nan]),
            right=np.array([0.0]),
            about_down=np.array([0.0]),
            covariance=np.eye(3)[None],
        ),
    ),
}


@pytest.fixture(scope="module")
def settled():
    return fed()[0]


@pytest.mark.parametrize("what", BAD)
def test_bad_input_is_refused_with_a_typed_error_and_changes_nothing(settled, what):
    before = said(settled)
    with pytest.raises(UblGraphError) as caught:
        settled.add(*BAD[what]())
    assert "\n" not in str(caught.value)
    settled.update()
    np.testing.assert_array_equal(said(settled), before)


def test_questions_that_have_no_answer(settled):
    with pytest.raises(DataError, match="did you mean 'V0'"):
        settled.estimate("V00")
    with pytest.raises(DataError, match="unknown target"):
        settled.target("T")
    with pytest.raises(TimeError):
        settled.estimate("V0", np.nan)
    with pytest.raises(TimeError):
        settled.estimate("V0", 1e5)
    with pytest.raises(TimeError):
        settled.smoothed("V0", -100.0)
    empty = FleetEstimator(Fleet((Member("A", Segment(), options=Options(node="pose2")),)))
    with pytest.raises(TimeError, match="no record yet"):
        empty.estimate("A")


def test_late_and_double_records_are_recognised(settled):
    before = said(settled)
    late = settled.add("V0", SlantRange(20.0, "V1", 100.0))
    assert not late.accepted
    assert "130.0 s old" in late.reason or "s old" in late.reason
    old = settled.add("V0", Odometry(10.0, 11.0, 1.0, 0.0, covariance=np.eye(3)))
    assert not old.accepted
    fix = settled.core.window.factors[-1].entry.record
    who = settled.core.window.factors[-1].line.member.name
    twin = settled.add(who, fix)
    assert (twin.accepted, twin.reason) == (False, "duplicate")
    piece = settled.core.lines["V0"].pieces[-1]
    again = Odometry(
        piece.t_from, piece.t_to, piece.way[0], -piece.way[1], covariance=piece.covariance
    )
    assert settled.add("V0", again).reason == "duplicate"
    settled.update()
    np.testing.assert_array_equal(said(settled), before)
    sensors = settled.health()["vehicles"]["V0"]["sensors"]
    assert sensors["slant_range"]["rejected"]["late"] == 1
    assert sensors["odometry"]["rejected"]["late"] == 1


def test_a_late_record_inside_the_lag_counts_at_its_own_time():
    fleet, _ = random_fleet(2, 2, 100.0)
    records = list(stream(fleet))
    late = next(r for r in records if r[0] > 60.0 and isinstance(r[2], SlantRange))
    with_it, without = FleetEstimator(bare(fleet), 80.0), FleetEstimator(bare(fleet), 80.0)
    for record in records:
        with_it.add(*record[1:])
        if record is not late:
            without.add(*record[1:])
    with_it.update()
    without.update()
    assert np.abs(said(with_it) - said(without)).max() > 1e-3
    assert without.add(*late[1:]).accepted
    without.update()
    np.testing.assert_allclose(said(without), said(with_it), atol=0.02)


def test_a_wrong_range_is_refused_and_reported():
    estimator, _ = fed(1)
    t = estimator.core.now
    before = said(estimator)
    truth = np.linalg.norm(
        estimator.smoothed("V0", t).position - estimator.smoothed("V1", t).position
    )
    assert estimator.add("V0", SlantRange(t, "V1", truth + 500.0, 2.0)).accepted
    events = estimator.update()
    assert [e.kind for e in events] == ["rejected"]
    assert "standard deviations" in events[0].reason
    np.testing.assert_allclose(said(estimator), before, atol=0.05)
    for name in ("V0", "V1"):
        rejected = estimator.health()["vehicles"][name]["sensors"]["slant_range"]["rejected"]
        assert rejected == {"gated": 1}


def test_a_vehicle_that_is_elsewhere_is_lost_and_found_anew():
    """Odometry that missed 400 m: all its ranges are refused till the gate opens again."""
    fleet, truths = random_fleet(3, 4, 600.0, every=3.0, fixed=2)
    estimator = FleetEstimator(bare(fleet), 200.0)
    statuses = []
    for t, vehicle, record in stream(fleet):
        if vehicle == "V3" and isinstance(record, Odometry) and record.t_from[0] == 150.0:
            record = replace(record, forward=record.forward + 400.0)
        estimator.add(vehicle, record)
        if not isinstance(record, Odometry):
            estimator.update()
            if t > 150.0:
                statuses.append(estimator.estimate("V3").status)
    assert "lost" in statuses
    found = estimator.estimate("V3")
    assert found.status in ("ok", "degraded"), found.reasons
    off = (found.position - truths["V3"].position(found.t)[0])[:2]
    assert np.linalg.norm(off) < 30.0
    for name in ("V0", "V1"):
        other = estimator.estimate(name)
        assert np.linalg.norm(other.position - truths[name].position(other.t)[0]) < 15.0


@pytest.mark.parametrize("failures", [1, 3, 50])
def test_a_solver_that_fails_does_not_end_it(monkeypatch, failures):
    fleet, truths = random_fleet(4, 3, 200.0)
    estimator = FleetEstimator(bare(fleet), 60.0)
    left = [0]
    solve = System.minimise

    def failing(self, point, factor=None):
        if left[0]:
            left[0] -= 1
            raise SolverError("broken on purpose")
        return solve(self, point, factor)

    monkeypatch.setattr(System, "minimise", failing)
    statuses = set()
    for t, vehicle, record in stream(fleet):
        if vehicle == "V0" and isinstance(record, Odometry) and record.t_from[0] == 100.0:
            left[0] = failures
        estimator.add(vehicle, record)
        if not isinstance(record, Odometry):
            estimator.update()
            if t > 100.0:
                statuses.add(estimator.estimate("V0").status)
    assert estimator.rebuilds >= 1
    if failures < 3:
        assert "rebuilt" in statuses
        for name in fleet.vehicle_names:
            estimate = estimator.estimate(name)
            off = (estimate.position - truths[name].position(estimate.t)[0])[:2]
            assert off @ np.linalg.solve(estimate.covariance[:2, :2], off) < 14.0
    else:
        # Nothing is left but to say so, and to look for the vehicle anew.
        assert "lost" in statuses


def test_a_stamp_far_ahead_is_held_back_until_others_agree():
    estimator, _ = fed(5)
    before = said(estimator)
    jump = estimator.add("V0", PositionFix(1e6, 0.0, 0.0))
    assert not jump.accepted
    assert not jump.final
    estimator.update()
    np.testing.assert_array_equal(said(estimator), before)
    assert estimator.health()["held"] == 1
    assert not estimator.add("V0", PositionFix(2000.0, 0.0, 0.0)).accepted
    assert not estimator.add(
        "V0", Odometry(1999.0, 2000.0, 1.0, 0.0, covariance=np.eye(3))
    ).accepted
    assert estimator.add("V1", Odometry(1999.0, 2000.0, 1.0, 0.0, covariance=np.eye(3))).accepted
    estimator.update()
    assert estimator.core.now == 2000.0
    later = estimator.estimate("V1", 2000.0)
    # Half an hour without a word: the covariance says so.
    assert np.sqrt(later.covariance[0, 0]) > 100.0


def test_odometry_may_come_in_one_piece_and_in_any_order():
    fleet, _ = random_fleet(5, 2, 100.0)
    estimator, other = FleetEstimator(bare(fleet), 40.0), FleetEstimator(bare(fleet), 40.0)
    steps = fleet.vehicles[0].segment.odometry
    for one, rows in ((estimator, slice(None)), (other, np.r_[99:9:-1])):
        one.add("V0", steps[:10])
        one.add("V1", steps[:10])
        assert one.add("V0", steps[10:][rows] if one is estimator else steps[rows]).accepted
        one.update()
        assert one.core.now == 100.0
    np.testing.assert_allclose(
        estimator.smoothed("V0", 100.0).position, other.smoothed("V0", 100.0).position
    )


def test_stamps_of_outputs_increase():
    estimator, _ = fed(6, duration=60.0)
    t = [estimator.estimate("V0", at).t for at in (60.0, 60.0, 10.0, 61.0)]
    assert (np.diff(t) > 0.0).all()


def test_silence_is_coasting_and_memory_stays_bounded():
    fleet, _ = random_fleet(7, 2, 60.0)
    estimator = FleetEstimator(bare(fleet), 40.0)
    for _, vehicle, record in stream(fleet):
        estimator.add(vehicle, record)
        if not isinstance(record, Odometry):
            estimator.update()
    sigma, sizes = [], []
    covariance = np.diag([0.1, 0.1, 1e-3]) ** 2
    for k in range(60, 1500):
        for name in fleet.vehicle_names:
            estimator.add(name, Odometry(k, k + 1.0, 1.0, 0.0, covariance=covariance))
        if k % 10 == 0:
            estimator.update()
            health = estimator.health()
            sizes.append(health["window"]["nodes"])
            estimate = estimator.estimate("V0")
            sigma.append(np.sqrt(estimate.covariance[0, 0]))
    assert estimate.status == "coasting"
    assert sigma[-1] > sigma[0]
    assert max(sizes[20:]) <= 20
    assert health["vehicles"]["V0"]["odometry_records"] < 60
    assert len(estimator.core.keys) == 0
    # The gate is open after the silence.
    truth = np.linalg.norm(
        estimator.smoothed("V0", 1500.0).position - estimator.smoothed("V1", 1500.0).position
    )
    estimator.add("V0", SlantRange(1500.0, "V1", truth + 5.0, 2.0))
    assert estimator.update() == ()


def test_odometry_that_is_missing_is_bridged_and_the_covariance_says_so():
    fleet, truths = random_fleet(8, 2, 120.0, fixed=0)
    estimator = FleetEstimator(bare(fleet), 100.0)
    whole = FleetEstimator(bare(fleet), 100.0)
    for _, vehicle, record in stream(fleet):
        gap = isinstance(record, Odometry) and vehicle == "V0" and 60.0 <= record.t_from[0] < 80.0
        whole.add(vehicle, record)
        if not gap:
            estimator.add(vehicle, record)
    estimator.update()
    whole.update()
    bridged, known = estimator.smoothed("V0", 120.0), whole.smoothed("V0", 120.0)
    assert np.trace(bridged.covariance) > 1.5 * np.trace(known.covariance)
    off = (bridged.position - truths["V0"].position(120.0)[0])[:2]
    assert off @ np.linalg.solve(bridged.covariance[:2, :2], off) < 14.0
    # The missing records come late, and all is as if they had not.
    for _, vehicle, record in stream(fleet):
        if isinstance(record, Odometry) and vehicle == "V0" and 60.0 <= record.t_from[0] < 80.0:
            assert estimator.add(vehicle, record).accepted
    estimator.update()
    np.testing.assert_allclose(said(estimator, 120.0), said(whole, 120.0), atol=0.02)


def test_reset_begins_anew():
    estimator, _ = fed(9, duration=60.0)
    last = estimator.estimate("V0").t
    estimator.reset()
    assert estimator.health()["window"]["nodes"] == 3
    estimator.add("V0", Odometry(0.0, 1.0, 1.0, 0.0, covariance=np.eye(3)))
    estimator.update()
    assert estimator.estimate("V0").t > last


def test_a_target_never_ranged_and_a_vehicle_never_heard_are_initialising():
    options = Options(node="pose2")
    start = Start(0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.01)
    members = (
        Member("A", Segment(start=start), options=options),
        Member("B", Segment(), options=options),
    )
    fleet = Fleet(members, targets=(Target("T"),), options=options)
    estimator = FleetEstimator(fleet)
    estimator.add("A", Odometry(0.0, 1.0, 1.0, 0.0, covariance=0.01 * np.eye(3)))
    estimator.update()
    assert estimator.estimate("A").position is not None
    assert estimator.estimate("B").status == "initialising"
    assert estimator.target("T").status == "initialising"


def test_clocks_that_differ_by_seconds_are_learned():
    rng = np.random.default_rng(10)
    options = Options(
        node="pose2",
        estimate_sound_speed=False,
        odometry_scale_sigma=0.0,
        odometry_turn_bias_sigma_deg=0.0,
        clock_offset_sigma=10.0,
        clock_drift_sigma=1e-5,
    )
    names, places = ("A", "B", "C"), np.array([[0.0, 0.0], [800.0, 0.0], [300.0, 700.0]])
    offsets = np.array([1.5, -2.0, 0.3])
    members = tuple(
        Member(n, Segment(start=Start(0.0, *p, 0.0, 1.0, 0.0, 0.01)), options=options)
        for n, p in zip(names, places, strict=True)
    )
    estimator = FleetEstimator(Fleet(members, options=options), 100.0)
    covariance = np.diag([0.05, 0.05, 1e-3]) ** 2
    north = np.zeros(3)
    for k in range(200):
        for i, name in enumerate(names):
            north[i] += i - 1.0
            step = Odometry(k, k + 1.0, i - 1.0, 0.0, covariance=covariance)
            estimator.add(name, step)
        if k % 5 == 4:
            i, j = rng.choice(3, 2, replace=False)
            t = k + 1.0
            here, there = (places[n] + [0.0, north[n]] for n in (i, j))
            tau = np.linalg.norm(here - there) / 1500.0 + 1e-4 * rng.standard_normal()
            sent, heard = t - tau + offsets[j], t + offsets[i]
            estimator.add(names[i], OneWayRange(names[j], sent, heard, 1e-4))
            estimator.update()
    for i, name in enumerate(names):
        estimate = estimator.estimate(name, 200.0)
        off = (estimate.position - [places[i, 0], places[i, 1] + north[i], 0.0])[:2]
        # Stamps that are seconds off place the nodes where the vehicle was then.
        assert np.linalg.norm(off) < 6.0
