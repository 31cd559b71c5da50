"""Online fleets under faults: bad, late and wrong records, jumps, failing solvers, silence."""

from dataclasses import replace

import numpy as np
import pytest

from ubl_graph.cooperative.fleet import Fleet, Member, Target
from ubl_graph.errors import (
    ConfigurationError,
    DataError,
    SolverError,
    TimeError,
    UblGraphError,
)
from ubl_graph.measurements import (
    Depth,
    Heading,
    Odometry,
    OneWayRange,
    PositionFix,
    SlantRange,
    TwoWayRange,
    Velocity,
)
from ubl_graph.online.fleet_estimator import FleetEstimator
from ubl_graph.online.fleet_finder import Seen, known_of, target_residuals
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


#: How far a wrong clock is ahead, s.
WRONG = 7200.0


def pair(more=(), targets=(), node="pose2"):
    """A boat that goes east at 1.5 m/s and a vehicle 50 m deep that goes north; others beside."""
    starts = {
        "boat": Start(0.0, 0.0, 0.0, 0.0, 1.0, np.pi / 2, 0.01),
        "auv": Start(0.0, 100.0, -200.0, -50.0, 5.0, 0.0, 0.01),
    }
    for name in more:
        starts[name] = Start(0.0, 0.0, 300.0, 0.0, 1.0, np.pi / 2, 0.01)
    options = Options(node=node)
    members = (Member(n, Segment(start=s), options=options) for n, s in starts.items())
    return FleetEstimator(Fleet(tuple(members), targets=targets, options=options), lag=120.0)


def sail(estimator, begin, end, shift=None, order=("boat", "auv"), at=None):
    """Odometry every second, fixes of the boat and ranges to it every ten; all outcomes."""
    shift, out = shift or {}, {name: [] for name in order}
    for t in np.arange(begin, end + 1.0):
        boat, auv = np.array([1.5 * t, 0.0, 0.0]), np.array([100.0, 1.5 * t - 200.0, -50.0])
        for name in order:
            own = t + shift.get(name, 0.0)
            step = Odometry(own - 1.0, own, 1.5, 0.0, about_down=0.0)
            out[name].append(estimator.add(name, step))
            if t % 10 == 0 and name == "boat":
                out[name].append(estimator.add(name, PositionFix(own, *boat, sigma=1.0)))
            if t % 10 == 0 and name == "auv":
                length = np.linalg.norm(boat - auv)
                out[name].append(estimator.add(name, SlantRange(own, "boat", length)))
        if at is not None:
            at(t)
        if t % 10 == 0:
            estimator.update()
    return out


def test_a_clock_that_jumps_ahead_leaves_out_its_vehicle_alone():
    estimator, clean = pair(), pair()
    sail(estimator, 1, 120)
    out = sail(estimator, 121, 240, {"auv": WRONG})
    sail(clean, 1, 240)
    assert all(o.accepted for o in out["boat"])
    assert not any(o.accepted for o in out["auv"])
    assert out["auv"][-1].reason == "its clock is 7200 s ahead of the others'"
    assert estimator.core.now == 240.0
    boat = estimator.estimate("boat")
    assert boat.status == "ok"
    np.testing.assert_allclose(boat.position, clean.estimate("boat").position, atol=0.5)
    auv = estimator.estimate("auv", 240.0)
    assert auv.status != "ok"
    assert any("ahead of the others'" in reason for reason in auv.reasons)
    rejected = estimator.health()["vehicles"]["auv"]["sensors"]["odometry"]["rejected"]
    assert rejected == {"ahead": 120}
    # The clock is set right: all is well again, and nothing is said of it any more.
    sail(estimator, 241, 300)
    auv = estimator.estimate("auv", 300.0)
    assert not any("clock" in reason for reason in auv.reasons)
    assert np.linalg.norm((auv.position - [100.0, 250.0, -50.0])[:2]) < 10.0


@pytest.mark.parametrize("order", [("boat", "auv"), ("auv", "boat")])
def test_a_clock_that_is_ahead_from_the_first_record_on(order):
    estimator = pair()
    out = sail(estimator, 1, 120, {"auv": WRONG}, order)
    # The first three may have to win against the one that came before.
    assert all(o.accepted for o in out["boat"][2:])
    assert estimator.core.now == 120.0
    boat = estimator.estimate("boat")
    assert boat.status == "ok"
    np.testing.assert_allclose(boat.position[:2], [180.0, 0.0], atol=1.0)
    assert "ahead of the others'" in " ".join(estimator.estimate("auv", 120.0).reasons)


def test_two_vehicles_win_against_one_that_has_long_gone_on_with_a_wrong_clock():
    estimator = pair(("ship",))
    sail(estimator, 1, 300, {"auv": WRONG}, ("auv",))
    assert estimator.core.now == WRONG + 300.0
    late = estimator.add("boat", Odometry(300.0, 301.0, 1.5, 0.0, about_down=0.0))
    assert not late.accepted
    assert estimator.add("ship", Odometry(300.0, 301.0, 1.5, 0.0, about_down=0.0)).accepted
    assert estimator.core.now == 301.0
    assert len(estimator.core.lines["boat"].pieces) == 1
    out = sail(estimator, 302, 400, {"auv": WRONG})
    assert all(o.accepted for o in out["boat"])
    assert estimator.core.now == 400.0


def test_one_vehicle_does_not_win_against_one_that_has_long_gone_on():
    estimator = pair()
    sail(estimator, 1, 300, {"auv": WRONG}, ("auv",))
    out = sail(estimator, 1, 300, order=("boat",))
    assert not any(o.accepted for o in out["boat"])
    assert estimator.core.now == WRONG + 300.0


def test_two_vehicles_agree_on_a_later_time():
    estimator = pair(("ship",))
    sail(estimator, 1, 60)
    out = sail(estimator, 601, 620, order=("auv", "boat"))
    assert [o.accepted for o in (out["auv"] + out["boat"])].count(False) == 2
    assert estimator.core.now == 620.0


def test_a_vehicle_is_believed_where_there_is_but_one_or_the_others_are_silent():
    options = Options(node="pose2")
    start = Start(0.0, 0.0, 0.0, 0.0, 1.0, np.pi / 2, 0.01)
    one = Fleet((Member("boat", Segment(start=start), options=options),), options=options)
    alone = FleetEstimator(one, lag=120.0)
    sail(alone, 1, 10, order=("boat",))
    assert [o.accepted for o in sail(alone, 1001, 1004, order=("boat",))["boat"]] == [
        False,
        False,
        True,
        True,
    ]
    estimator = pair()
    sail(estimator, 1, 60)
    out = sail(estimator, 601, 800, order=("auv",))["auv"]
    believed = [o.accepted for o in out]
    assert not any(believed[:120])
    assert all(believed[140:])
    assert not any("clock" in reason for reason in estimator.estimate("auv").reasons)


def test_a_wrong_clock_does_not_take_over_while_the_others_are_silent():
    estimator = pair()
    sail(estimator, 1, 150, {"auv": WRONG})
    assert not any(o.accepted for o in sail(estimator, 151, 400, {"auv": WRONG}, ("auv",))["auv"])
    assert estimator.core.now == 150.0
    # Nor does it speak against those who come back.
    out = sail(estimator, 401, 450, {"auv": WRONG})
    assert all(o.accepted for o in out["boat"][2:])
    assert not any(o.accepted for o in out["auv"])
    assert estimator.core.now == 450.0


def test_one_batch_of_odometry_does_not_make_a_wrong_clock_right():
    estimator = pair()
    sail(estimator, 1, 60)
    t = np.arange(WRONG, WRONG + 300.0)
    same = np.full(len(t), 1.5)
    zero = np.zeros(len(t))
    assert not estimator.add("auv", Odometry(t, t + 1.0, same, zero, about_down=zero)).accepted
    assert all(o.accepted for o in sail(estimator, 61, 90, order=("boat",))["boat"])
    assert estimator.core.now == 90.0


def test_a_fix_that_is_refused_does_not_move_the_depth():
    def bad(t):
        if t == 150.0:
            estimator.add("auv", PositionFix(t - 0.5, 5000.0, 5000.0, 400.0, sigma=1.0))

    estimator, clean = pair(), pair()
    sail(estimator, 1, 240, at=bad)
    sail(clean, 1, 240)
    sensors = estimator.health()["vehicles"]["auv"]["sensors"]
    assert sensors["position"]["rejected"] == {"gated": 1}
    assert sensors["slant_range"]["rejected"] == {}
    np.testing.assert_allclose(
        estimator.estimate("auv").position, clean.estimate("auv").position, atol=1e-6
    )


def test_a_fix_that_is_accepted_says_the_depth_of_ranges_that_come_with_it():
    """The vehicle has dived to 80 m since its start; only a fix knows."""
    estimator = pair()
    sail(estimator, 1, 39, order=("boat",))
    for t in range(39):
        estimator.add("auv", Odometry(t, t + 1.0, 1.5, 0.0, about_down=0.0))
    boat, auv = np.array([58.5, 0.0, 0.0]), np.array([100.0, -141.5, -80.0])
    estimator.add("auv", PositionFix(39.0, *auv, sigma=0.5))
    estimator.add("boat", PositionFix(39.0, *boat, sigma=0.5))
    estimator.add("auv", SlantRange(39.0, "boat", np.linalg.norm(boat - auv), 0.2))
    assert estimator.update() == ()
    np.testing.assert_allclose(estimator.estimate("auv").position, auv, atol=0.5)


@pytest.mark.parametrize("node", ["pose2", "pose3"])
def test_one_wrong_depth_is_refused(node):
    outcomes = {}

    def depths(t):
        if t % 5 == 0:
            outcomes[t] = estimator.add("auv", Depth(t, 450.0 if t == 150.0 else 50.0, 0.1))

    estimator = pair(node=node)
    sail(estimator, 1, 200, at=depths)
    assert [t for t, o in outcomes.items() if not o.accepted] == [150.0]
    assert "from the depth" in outcomes[150.0].reason
    sensors = estimator.health()["vehicles"]["auv"]["sensors"]
    assert sensors["depth"]["rejected"] == {"gated": 1}
    assert sensors["slant_range"]["rejected"] == {}
    np.testing.assert_allclose(estimator.smoothed("auv", 150.0).position[2], -50.0, atol=0.5)


def test_a_depth_that_persists_is_let_in_again():
    estimator = pair()
    sail(estimator, 1, 10)
    said = [(10.0, 450.0), (11.0, 50.0), (12.0, 50.1), (13.0, 50.2), (14.0, 50.1)]
    out = [estimator.add("auv", Depth(t, depth, 0.1)).accepted for t, depth in said]
    assert out == [True, False, False, True, True]
    # The one that began was outvoted, and nothing remembers it.
    estimator.add("auv", Odometry(13.0, 14.0, 1.5, 0.0, about_down=0.0))
    estimator.update()
    np.testing.assert_allclose(estimator.estimate("auv", 14.0).position[2], -50.1)
    sensors = estimator.health()["vehicles"]["auv"]["sensors"]
    assert sensors["depth"]["accepted"] == 5
    assert sensors["depth"]["rejected"].get("gated", 0) == 0


def test_wrong_depths_among_right_ones_do_not_add_up():
    estimator = pair()
    out = [
        estimator.add("auv", Depth(0.5 * k, 450.0 if k % 2 else 50.0, 0.1)).accepted
        for k in range(20)
    ]
    assert out == [True, False] * 10


def test_batches_of_nothing_are_nothing(settled):
    none = np.empty(0)
    before = said(settled)
    for records in (SlantRange(none, "V1", none), Odometry(none, none, none, none)):
        assert settled.add("V0", records).accepted
    settled.update()
    np.testing.assert_array_equal(said(settled), before)


@pytest.mark.parametrize("wrong", ["3", None, [3.0]])
def test_what_is_no_number_is_told_so(settled, wrong):
    with pytest.raises(ConfigurationError, match="lag"):
        FleetEstimator(settled.fleet, lag=wrong)
    with pytest.raises(TimeError):
        settled.smoothed("V0", wrong)
    if wrong is not None:
        with pytest.raises(TimeError):
            settled.estimate("V0", wrong)
        with pytest.raises(DataError, match="unknown vehicle"):
            settled.estimate(wrong)


def carried(target, epoch):
    """Covariance of position and velocity at a time, from those stated: E of products, by hand."""
    dt = epoch - target.t
    place, motion = np.diag(target.sigma**2), np.diag(target.velocity_sigma**2)
    return np.block([[place + dt**2 * motion, dt * motion], [dt * motion, motion]])


def test_a_moving_targets_place_and_velocity_are_known_jointly():
    target = Target("T", [10.0, 20.0, -5.0], [3.0, 4.0, 0.5], [0.2, 0.3, 0.1], t=100.0)
    seen = [Seen(350.0, np.zeros(3), 0.0, 30.0, 1.0)]
    mean, _, _ = known_of(target, 400.0)
    np.testing.assert_allclose(mean, [10.0, 20.0, -5.0, 0.0, 0.0, 0.0])
    residuals = target_residuals(target, seen, 400.0)
    at = residuals(mean[None])[0, 1:]
    np.testing.assert_allclose(at, 0.0, atol=1e-12)
    slope = (residuals(mean + np.eye(6))[:, 1:] - at).T
    covariance = np.linalg.inv(slope.T @ slope)
    np.testing.assert_allclose(covariance, carried(target, 400.0), rtol=1e-9, atol=1e-9)


def test_a_moving_targets_prior_in_the_window_is_joint():
    """Ranges that say next to nothing leave what was known, carried to the window's epoch."""
    target = Target("T", [150.0, 50.0, -5.0], [3.0, 4.0, 0.5], [0.1, 0.2, 0.05], t=-100.0)
    estimator = pair(targets=(target,))
    sail(estimator, 1, 20)
    for t in (18.0, 19.0, 20.0):
        estimator.add("boat", SlantRange(t, "T", 130.0, 1e4))
    estimator.update()
    estimator.update()
    fix = estimator.target("T")
    assert fix.status == "ok"
    expected = carried(target, estimator.core.now)
    np.testing.assert_allclose(fix.covariance, expected[:3, :3], rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(fix.velocity_covariance, expected[3:, 3:], rtol=1e-3, atol=1e-5)
