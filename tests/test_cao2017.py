"""Cao 2017's solvers against closed forms and scipy; a mission's fixes against the solvers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from ubl_graph import (
    Beacon,
    ConfigurationError,
    DataError,
    LeverArm,
    Mission,
    Segment,
    SoundSpeedProfile,
    Start,
    TimeError,
    UnobservableError,
    Vehicle,
    smooth,
)
from ubl_graph.acoustics import straight
from ubl_graph.baselines.cao2017 import cao2017, converged_position, virtual_beacons
from ubl_graph.baselines.range_windows import (
    Windows,
    gauss_newton,
    levenberg_marquardt,
    linear_difference,
)
from ubl_graph.mission import Reference
from ubl_graph.sim import (
    Sea,
    SeaTrial,
    ahrs,
    cao_pass,
    cao_sea_trial,
    dvl,
    lawn_mower,
    one_way_pings,
    pressure,
    two_way_pings,
)
from ubl_graph.sim.cao2017 import PASS_OPTIONS

ERRORS = {"forward": (0.005, 0.0, 0.0), "right": (0.0, 0.002, 0.0), "up": (0.0, 0.0, 0.002)}
CONVERGED = {"max_iterations": 300, "tolerance": 1e-9}
#: Ten pings, 10 s apart; seconds before the last.
BEFORE = 10.0 * np.arange(9, -1, -1)


def windows(east, north, error=(0.0, 0.0, 0.0), height=100.0) -> Windows:
    """Windows of an eastward track at 1 m/s under a beacon at the frame's zero."""
    east, north = np.broadcast_arrays(np.atleast_1d(east), np.atleast_1d(north))
    forward, right, up = error
    way = np.stack([(1.0 + forward) * BEFORE, -right * BEFORE, up * BEFORE], axis=1)
    beacons = np.broadcast_to(way, (len(east), 10, 3))
    there = east[:, None] - BEFORE
    ranges = np.sqrt(there**2 + north[:, None] ** 2 + height**2)
    return Windows(beacons, ranges, np.full(len(east), -height))


def grid(step=500.0):
    """Places off the axis and off the beacon's meridian, east and north."""
    places = np.arange(-3000.0, 3001.0, step)
    east, north = (a.ravel() for a in np.meshgrid(places, places))
    off = (north != 0.0) & (east != 0.0)
    return east[off], north[off]


@pytest.mark.parametrize("error", ERRORS)
def test_converged_solvers_end_at_the_closed_form(error):
    east, north = grid()
    truth = np.stack([east, north], axis=1)
    given_ = windows(east, north, ERRORS[error])
    expected = converged_position(east, north, **{error: max(ERRORS[error])})
    off = np.hypot(*(expected - truth).T)
    for found in (gauss_newton(given_, truth), levenberg_marquardt(given_, truth, **CONVERGED)):
        assert found.solved.all()
        assert (np.hypot(*(found.position - expected).T) <= 0.01 * off).all()


@pytest.mark.parametrize("error", ERRORS)
def test_the_closed_forms_first_order_is_the_papers_picture(error):
    """Hyperbolas, circles, and hyperbolas again: within 5 % far from the beacon."""
    east, north = np.array([2500.0, -2500.0, 1500.0]), np.array([1500.0, -2000.0, 3000.0])
    found = converged_position(east, north, length=0.0, **{error: max(ERRORS[error])})
    moved = found - np.stack([east, north], axis=1)
    if error == "forward":
        assert moved[:, 0] == pytest.approx(-0.005 * east, rel=0.05)
        assert moved[:, 1] == pytest.approx(0.005 * east**2 / north, rel=0.05)
    elif error == "right":
        assert np.hypot(*moved.T) == pytest.approx(0.002 * np.hypot(east, north), rel=0.05)
        assert moved[0, 0] > 0.0 > moved[0, 1]  # clockwise
    else:
        assert moved[:, 1] == pytest.approx(-0.002 * east * 100.0 / north, rel=0.05)


def test_no_closed_form_where_the_line_misses_the_circle():
    assert np.isnan(converged_position([3000.0], [20.0], up=0.002)).all()
    assert np.isfinite(converged_position([-3000.0], [20.0], up=0.002)).all()


@given(
    st.floats(-2500.0, 2500.0),
    st.floats(100.0, 2500.0),
    st.integers(0, 2**31),
    st.sampled_from([-1.0, 1.0]),
)
def test_solvers_agree_with_scipy(east, north, seed, side):
    """Any window with noise, off the axis: the minimum nearest to a start that is 5 m off."""
    rng = np.random.default_rng(seed)
    given_ = windows(east, side * north, (0.003, 0.001, 0.001))
    given_ = replace(given_, ranges=given_.ranges + 0.001 * rng.standard_normal((1, 10)))
    start = np.array([east, side * north]) + 5.0

    def residual(x):
        gap = np.array([*x, given_.up[0]]) - given_.beacons[0]
        return np.linalg.norm(gap, axis=1) - given_.ranges[0]

    oracle = least_squares(residual, start, xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac")
    found = levenberg_marquardt(given_, start[None], max_iterations=500, tolerance=1e-9)
    cost = float(np.sum(residual(found.position[0]) ** 2))
    assert cost <= 2.0 * oracle.cost * (1.0 + 1e-6) + 1e-12
    newton = gauss_newton(given_, found.position, max_iterations=200, tolerance=1e-9)
    if newton.solved[0]:
        assert np.hypot(*(newton.position - found.position)[0]) < 1e-3


def test_lm_makes_the_papers_trials():
    """Table 1 written out for one window, in plain loops."""
    given_ = windows(2800.0, 200.0, ERRORS["forward"])
    x, damping, accepted = np.array([2800.0, 200.0]), 1e-3, []

    def linearised(x):
        gap = np.array([*x, -100.0]) - given_.beacons[0]
        f = np.linalg.norm(gap, axis=1)
        return given_.ranges[0] - f, gap[:, :2] / f[:, None]

    for most in range(1, 9):
        e, j = linearised(x)
        d = np.linalg.solve(j.T @ j + damping * np.eye(2), j.T @ e)
        better = np.sum(linearised(x + d)[0] ** 2) < np.sum(e**2)
        accepted.append(bool(better))
        x, damping = (x + d, damping / 10.0) if better else (x, damping * 10.0)
        found = levenberg_marquardt(given_, np.array([[2800.0, 200.0]]), max_iterations=most)
        assert found.position[0] == pytest.approx(x, abs=1e-6)
        assert found.iterations.tolist() == [most]
    # A rejected trial raises the damping, and is counted.
    assert not all(accepted)


def test_gauss_newton_fails_on_the_axis_and_lm_does_not():
    east = np.array([-3000.0, -1000.0, 2000.0])
    for error in (ERRORS["forward"], ERRORS["up"], (0.0, 0.0, 0.0)):
        given_, truth = windows(east, 0.0, error), np.stack([east, 0.0 * east], axis=1)
        newton = gauss_newton(given_, truth)
        assert not newton.solved.any()
        assert np.isnan(newton.position).all()
        found = levenberg_marquardt(given_, truth)
        assert found.solved.all()
        assert np.abs(found.position - truth).max() < 0.5


def test_what_begins_on_the_wrong_side_ends_there():
    """600 nodes: the converged methods find the mirror image 600 times; the three trials 288."""
    places = np.arange(-3000.0, 3001.0, 250.0)
    east, north = (a.ravel() for a in np.meshgrid(places, places[places != 0.0]))
    given_, start = windows(east, north), np.stack([east + 20.0, -0.9 * north], axis=1)

    def near(found, side):
        return int(
            (np.hypot(found.position[:, 0] - east, found.position[:, 1] - side * north) < 1).sum()
        )

    for found in (gauss_newton(given_, start), levenberg_marquardt(given_, start, **CONVERGED)):
        assert (near(found, -1.0), near(found, 1.0)) == (600, 0)
    three = levenberg_marquardt(given_, start)
    assert (near(three, -1.0), near(three, 1.0)) == (288, 0)


@given(st.floats(-1500.0, 1500.0), st.floats(-1500.0, 1500.0), st.integers(0, 2**31))
def test_the_linear_solution_recovers_a_track_that_turns(east, north, seed):
    rng = np.random.default_rng(seed)
    way = rng.uniform(-100.0, 100.0, (1, 6, 3))
    way[:, -1] = 0.0
    gap = np.array([east, north, -100.0]) - way
    found = linear_difference(Windows(way, np.linalg.norm(gap, axis=2), np.array([-100.0])))
    assert found.solved.all()
    spread = np.linalg.svd(np.diff(way[0, :, :2], axis=0), compute_uv=False)
    assert found.position[0] == pytest.approx([east, north], abs=1e-6 * 100.0 / spread[1])


def test_the_linear_solution_leaves_straight_windows_out():
    bent = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [20.0, 5.0, 0.0], [30.0, 20.0, 0.0]])
    line = bent * [1.0, 0.0, 0.0]
    both = np.stack([bent, line])
    ranges = np.linalg.norm(np.array([40.0, 30.0, -9.0]) - both, axis=2)
    found = linear_difference(Windows(both, ranges, np.full(2, -9.0)))
    assert found.solved.tolist() == [True, False]
    assert found.position[0] == pytest.approx([40.0, 30.0])
    with pytest.raises(UnobservableError, match="tracks are straight"):
        linear_difference(Windows(both[1:], ranges[1:], np.full(1, -9.0)))


def test_solvers_refuse_what_they_cannot_solve():
    one = Windows(np.zeros((1, 1, 3)), np.ones((1, 1)), np.zeros(1))
    start = np.zeros((1, 2))
    for solve in (gauss_newton, levenberg_marquardt):
        with pytest.raises(DataError, match="windows of 1 ranges"):
            solve(one, start)
        with pytest.raises(DataError, match="start positions of shape"):
            solve(windows(10.0, 20.0), np.zeros((2, 2)))
        with pytest.raises(ConfigurationError, match="no number of iterations"):
            solve(windows(10.0, 20.0), start, max_iterations=0)
        with pytest.raises(ConfigurationError, match="a tolerance of -1"):
            solve(windows(10.0, 20.0), start, tolerance=-1.0)
    with pytest.raises(ConfigurationError, match="factor"):
        levenberg_marquardt(windows(10.0, 20.0), start, factor=1.0)
    with pytest.raises(DataError, match="windows of 2 ranges"):
        linear_difference(Windows(np.zeros((1, 2, 3)), np.ones((1, 2)), np.zeros(1)))
    with pytest.raises(DataError, match="have shapes"):
        Windows(np.zeros((1, 2, 3)), np.ones((1, 3)), np.zeros(1))
    with pytest.raises(DataError, match="not all numbers are finite"):
        Windows(np.zeros((1, 2, 3)), np.full((1, 2), np.nan), np.zeros(1))


# -- the front door --


@pytest.mark.parametrize("error", ERRORS)
def test_a_missions_windows_are_those_of_the_formula(error):
    mission, _ = cao_pass(north=700.0, dvl_error=ERRORS[error], noise=0.0, start_sigma=0.0)
    (segment,) = mission.segments
    east = -3000.0 + 10.0 * np.arange(9, 601)
    expected = windows(east, 700.0, ERRORS[error])
    made = virtual_beacons(mission, segment, 10)
    above = np.array([0.0, 0.0, 4000.0])
    assert made.beacons + above == pytest.approx(expected.beacons, abs=1e-8)
    assert made.ranges == pytest.approx(expected.ranges, abs=1e-6)
    assert made.up + 4000.0 == pytest.approx(expected.up)
    truth = np.stack([east, np.full(len(east), 700.0)], axis=1)
    for method, solve in (("lm", levenberg_marquardt), ("gauss_newton", gauss_newton)):
        fixes = cao2017(mission, method=method, seeds={"": segment.reference})[""]
        assert fixes.position[:, :2] == pytest.approx(solve(expected, truth).position, abs=1e-3)
        assert fixes.t == pytest.approx(10.0 * np.arange(9, 601))
        assert fixes.position[:, 2] == pytest.approx(np.full(592, -4100.0))


def test_the_papers_figures():
    """LM within 22.4, 3.7 and 1.6 m at the axis ends, Gauss-Newton 220 m off there."""
    worst = {}
    for error, values in ERRORS.items():
        for north in (100.0, 200.0, 300.0):
            mission, _ = cao_pass(
                north=north, east=(-3090.0, 3000.0), dvl_error=values, noise=0.0, start_sigma=0.0
            )
            (segment,) = mission.segments
            for method in ("lm", "gauss_newton"):
                fixes = cao2017(mission, method=method, seeds={"": segment.reference})[""]
                errors = fixes.errors(segment.reference)[::10]
                ends = np.abs(np.arange(-3000.0, 3001.0, 100.0)) >= 2000.0
                key = (error, method)
                worst[key] = max(worst.get(key, 0.0), float(errors[ends].max()))
    assert worst["forward", "lm"] == pytest.approx(22.4, rel=0.01)
    assert worst["right", "lm"] == pytest.approx(3.7, rel=0.02)
    assert worst["up", "lm"] == pytest.approx(1.6, rel=0.02)
    assert worst["forward", "gauss_newton"] == pytest.approx(220.0, rel=0.01)


def test_each_window_begins_at_the_fix_before_dead_reckoned():
    mission, _ = cao_pass(north=400.0, east=(-3000.0, -2000.0))
    (segment,) = mission.segments
    made = virtual_beacons(mission, segment, 10)
    fixes = cao2017(mission)[""]
    start, step = segment.start, np.array([1.005 * 10.0, 0.0])
    begin = np.array([start.east, start.north]) + 9 * step
    for k in range(len(made)):
        found = levenberg_marquardt(made[k : k + 1], begin[None])
        assert fixes.position[k, :2] == pytest.approx(found.position[0], abs=0.01)
        begin = fixes.position[k, :2] + step
    elsewhere = Start(0.0, start.east, -start.north)
    assert cao2017(mission, {"": elsewhere})[""].position[0, 1] < 0.0 < fixes.position[0, 1]


def turning(two_way: bool, noise=0.0) -> Mission:
    """A survey with lever arms everywhere, in water with a gradient: nothing but noise is wrong."""
    rng = np.random.default_rng(4)
    truth = lawn_mower([0.0, 0.0], depth=160.0, lines=4, length=200.0, spacing=60.0)
    vehicle = Vehicle(
        transducer=LeverArm(forward=0.8, down=-0.3),
        dvl=LeverArm(forward=-0.6, right=0.3),
        depth_sensor=LeverArm(forward=0.2, down=0.5),
    )
    beacon = Beacon("B1", [40.0, 150.0, -220.0], turnaround=0.1)
    profile = SoundSpeedProfile(np.array([0.0, 150.0, 250.0]), np.array([1520.0, 1495.0, 1490.0]))
    make = two_way_pings if two_way else one_way_pings
    end = truth.span[1]
    times = np.arange(0.0, end, 0.1)
    pings = make(
        truth, (beacon,), np.arange(1.0, end - 3.0, 5.0), Sea(profile), rng,
        arm=vehicle.transducer, noise=noise,
    )  # fmt: skip
    segment = Segment(
        velocity=dvl(truth, times, rng, arm=vehicle.dvl, noise=noise),
        attitude=ahrs(truth, times),
        depth=pressure(truth, times, rng, arm=vehicle.depth_sensor, noise=noise),
        start=Start(0.0, *truth.position(0.0)[0, :2].tolist()),
        reference=truth.reference(times),
        **{"two_way_range" if two_way else "one_way_range": pings},
    )
    return Mission((segment,), (beacon,), profile, vehicle)


@pytest.mark.parametrize("two_way", [False, True])
def test_recovers_a_turning_track_without_noise(two_way):
    """Two-way ranges are halved and put in the middle: good to a millimetre or so at 1.5 m/s."""
    mission = turning(two_way)
    for method, options in (("lm", CONVERGED), ("gauss_newton", {})):
        fixes = cao2017(mission, method=method, window=20, **options)[""]
        assert fixes.solved.mean() > 0.95
        errors = fixes.errors(mission.segments[0].reference)[fixes.solved]
        # Corners of 90 degrees in 30 m, sampled at 10 Hz, cost the DVL's integral some millimetres.
        assert np.median(errors) < 0.01
    linear = cao2017(mission, method="linear", window=40)[""]
    assert np.nanmedian(linear.errors(mission.segments[0].reference)) < 0.1


def test_ranges_take_the_profiles_harmonic_mean():
    mission = turning(two_way=False)
    (segment,) = mission.segments
    made = virtual_beacons(mission, segment, 5)
    truth = segment.reference
    # The last ping of a window is to the real beacon, seen from the transducer.
    at = np.stack([np.interp(segment.one_way_range.t_receive[4:], truth.t, truth.position[:, i])
                   for i in range(3)], axis=1)  # fmt: skip
    gap = np.linalg.norm(at - made.beacons[:, -1], axis=1)
    assert made.ranges[:, -1] == pytest.approx(gap, abs=0.02)
    seconds = straight(mission.sound_speed, at, made.beacons[:, -1]).time
    assert segment.one_way_range.travel_time[4:] == pytest.approx(seconds, abs=2e-5)


def test_the_linear_solution_is_refused_on_a_straight_pass():
    mission, _ = cao_pass(noise=0.0)
    with pytest.raises(UnobservableError, match="straight"):
        cao2017(mission, method="linear")


def test_windows_over_a_gap_of_the_dvl_have_no_fix():
    mission, _ = cao_pass(noise=0.0, east=(-3000.0, -1000.0))
    (segment,) = mission.segments
    silent = (segment.velocity.t > 905.0) & (segment.velocity.t < 1105.0)
    segment = replace(segment, velocity=segment.velocity[~silent])
    fixes = cao2017(replace(mission, segments=(segment,)))[""]
    begin = fixes.t - 90.0
    spanning = (fixes.t > 901.0) & (begin < 1109.0)
    assert (fixes.solved == ~spanning).all()
    assert np.isnan(fixes.position[spanning]).all()


def test_segments_are_solved_as_if_each_were_alone():
    parts = [cao_pass(i, north=n, east=(-3000.0, e))[0] for i, n, e in
             ((1, 300.0, -2000.0), (2, -900.0, -2500.0))]  # fmt: skip
    segments = tuple(replace(p.segments[0], name=name) for p, name in zip(parts, "ab", strict=True))
    together = cao2017(replace(parts[0], segments=segments), max_iterations=5)
    for part, name in zip(parts, "ab", strict=True):
        alone = cao2017(part, max_iterations=5)[""]
        assert together[name].position == pytest.approx(alone.position, abs=1e-9)
        assert len(alone) == len(together[name])


def test_the_front_door_refuses():
    mission, _ = cao_pass(noise=0.0, east=(-3000.0, -2800.0))
    (segment,) = mission.segments

    def changed(**what):
        return replace(mission, segments=(replace(segment, **what),))

    cases = [
        (changed(start=None), {}, UnobservableError, "has no start"),
        (mission, {"seeds": {}}, UnobservableError, "has no seeds"),
        (mission, {"window": 22}, DataError, "21 pings for windows of 22"),
        (mission, {"window": 1}, ConfigurationError, "windows of 1 pings"),
        (mission, {"window": 2, "method": "linear"}, ConfigurationError, "give 3 or more"),
        (mission, {"method": "magic"}, ConfigurationError, "'magic' is not one of"),
        (mission, {"max_iterations": 0}, ConfigurationError, "no number of iterations"),
        (changed(velocity=None), {}, DataError, "no velocities over the bottom"),
        (changed(depth=None), {}, DataError, "has no depth"),
        (
            mission,
            {"seeds": {"": Reference(np.array([0.0, 50.0]), np.zeros((2, 3)))}},
            TimeError,
            "do not cover",
        ),
    ]
    for given_, options, kind, text in cases:
        with pytest.raises(kind, match=text):
            cao2017(given_, **options)


# -- the scenarios --


def test_a_pass_is_what_it_says():
    mission, truth = cao_pass(3, north=-200.0, dvl_error=(0.005, 0.002, 0.001), range_sigma=0.5)
    (segment,) = mission.segments
    assert segment.one_way_range.t_receive == pytest.approx(10.0 * np.arange(601), abs=0.01)
    gap = np.linalg.norm(
        truth.position(segment.one_way_range.t_receive) - [0.0, 0.0, -4000.0], axis=1
    )
    noise = 1500.0 * segment.one_way_range.travel_time - gap
    assert np.std(noise) == pytest.approx(0.5, rel=0.1)
    assert segment.one_way_range.sigma * 1500.0 == pytest.approx(np.full(601, 0.5))
    body = (segment.velocity.forward, segment.velocity.right, segment.velocity.down)
    assert [b[0] for b in body] == pytest.approx([1.005, 0.002, -0.001])
    again, _ = cao_pass(3, north=-200.0, dvl_error=(0.005, 0.002, 0.001), range_sigma=0.5)
    assert (again.segments[0].one_way_range.t_receive == segment.one_way_range.t_receive).all()
    assert again.segments[0].start == segment.start
    exact = cao_pass(north=-200.0, start_sigma=0.0)[0].segments[0].start
    assert (exact.east, exact.north) == (-3000.0, -200.0)
    assert cao_pass(start_sigma=None)[0].segments[0].start is None
    with pytest.raises(ConfigurationError, match="eastward"):
        cao_pass(east=(1.0, -1.0))


def test_a_trials_errors_have_the_spread_they_are_said_to_have():
    trial = SeaTrial(calibration_sigma=5.0, white_noise=1e-4, range_sigma=1e-3, sound_speed_sigma=0)
    forward, right, missed = [], [], []
    for seed in range(150):
        mission, truth = cao_sea_trial(seed, north=800.0, pings=12, trial=trial)
        (segment,) = mission.segments
        forward.append(segment.velocity.forward.mean() - 1.0)
        right.append(segment.velocity.right.mean())
        t = segment.one_way_range.t_receive
        gap = truth.position(t) - mission.beacons[0].position
        # A range is too short by the beacon's offset along the line of sight.
        off = np.linalg.norm(gap, axis=1) - 1500.0 * segment.one_way_range.travel_time
        missed.append(off[0])
        assert mission.options.dvl_bias_sigma == trial.right_sigma
    assert np.std(forward) == pytest.approx(0.005, rel=0.15)
    assert np.std(right) == pytest.approx(0.002, rel=0.15)
    assert np.std(missed) == pytest.approx(5.0, rel=0.15)


def test_the_graph_begins_where_the_paper_ends():
    """A tenth of LM's error on the same data, from the same start."""
    mission, truth = cao_pass(5, north=300.0, options=replace(PASS_OPTIONS, solver="banded"))
    (segment,) = mission.segments
    result = smooth(mission)
    assert result.status == "converged"
    t = cao2017(mission)[""].t
    off = np.hypot(*(result.trajectory.at(t).position - truth.position(t))[:, :2].T)
    lm = cao2017(mission)[""].errors(segment.reference)
    assert np.mean(off) < 0.1 * np.mean(lm)


def test_without_a_start_the_graph_says_that_two_tracks_fit():
    mission, _ = cao_pass(2, north=1500.0, dvl_error=(0.0, 0.0, 0.0), start_sigma=None)
    result = smooth(mission)
    assert result.status == "unobservable"
    assert result.reason.startswith("ambiguous")


@pytest.mark.parametrize("north", [30.0, 100.0, 400.0, 1500.0])
def test_a_pass_without_a_start_is_ambiguous(north):
    """Which side of the beacon it went by nothing tells: DVL and heading do not."""
    mission, _ = cao_pass(1, north=north, range_sigma=0.1, start_sigma=None)
    result = smooth(mission)
    assert result.status == "unobservable"
    assert result.reason.startswith("ambiguous: another track")


def test_two_passes_without_a_start_are_ambiguous_each():
    passes = [cao_pass(seed, north=150.0, range_sigma=0.1, start_sigma=None)[0] for seed in (1, 2)]
    segments = [replace(m.segments[0], name=str(i)) for i, m in enumerate(passes)]
    result = smooth(replace(passes[0], segments=tuple(segments)))
    assert [s.reason[:9] for s in result.segments] == ["ambiguous", "ambiguous"]


def test_a_start_that_the_dvl_does_not_reach_is_refused():
    mission, _ = cao_pass(1, north=500.0)
    start = Start(-5000.0, 0.0, 500.0, sigma=1.0)
    with pytest.raises(DataError, match="does not cover the time from the start"):
        cao2017(mission, {"": start})
