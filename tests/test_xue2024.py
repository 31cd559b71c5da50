"""Xue 2024: windows against independent formulas, simulations against the paper's numbers."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import brentq, least_squares

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.baselines.xue2024 import Windows, xue2024
from ubl_graph.beacon import Beacon
from ubl_graph.errors import ConfigurationError, DataError, UnobservableError
from ubl_graph.frames import LeverArm
from ubl_graph.io.mission_file import load_mission
from ubl_graph.measurements import Depth, PositionFix
from ubl_graph.mission import Mission, Segment, Vehicle
from ubl_graph.sim import Sea, Truth, ahrs, constant_acceleration, pressure, two_way_pings
from ubl_graph.sim.xue2024 import munk_profile, xue_pass, xue_track, xue_wandering

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

import replay_runs as runs

SPEED = 1500.0
BEACONS = tuple(
    Beacon(f"B{i}", place, turnaround=0.4)
    for i, place in enumerate(
        [
            [0.0, 700.0, -2400.0],
            [-800.0, 50.0, -2500.0],
            [30.0, -750.0, -2450.0],
            [760.0, 0.0, -2550.0],
        ]
    )
)


def exact(truth: Truth, vehicle: Vehicle | None = None, pings: int = 30) -> Mission:
    """Pings without noise in water of one speed; depth is known whenever it is asked for."""
    vehicle = vehicle or Vehicle()
    rng = np.random.default_rng(0)
    sent = 10.0 * np.arange(pings)
    sea = Sea(SoundSpeedProfile.constant(SPEED))
    ranges = two_way_pings(truth, BEACONS, sent, sea, rng, arm=vehicle.transducer, noise=0.0)
    fine = np.arange(0.0, sent[-1] + 20.0, 0.5)
    segment = Segment(
        two_way_range=ranges,
        attitude=ahrs(truth, fine),
        depth=pressure(truth, fine, rng, arm=vehicle.depth_sensor, noise=0.0),
        reference=truth.reference(fine),
    )
    return Mission((segment,), BEACONS, sea.profile, vehicle)


def off(windows: Windows, truth: Truth) -> float:
    """Largest distance of any fix from the truth, m."""
    gaps = [
        np.abs(f.position - truth.position(f.t))
        for f in (windows.centre, windows.current, windows.newest)
    ]
    return float(np.max(gaps))


def rms(fixes, truth: Truth) -> float:
    gap = (fixes.position - truth.position(fixes.t))[:, :2]
    return float(np.sqrt((gap**2).sum(axis=1).mean()))


component = st.floats(-4.0, 4.0)


@settings(max_examples=25)
@given(component, component, st.floats(-0.02, 0.02), st.floats(-0.02, 0.02), st.integers(2, 3))
def test_a_noiseless_polynomial_is_recovered_exactly(east, north, bend_east, bend_north, order):
    truth = constant_acceleration(
        [-300.0, 40.0, -900.0], [east, north, -0.3], [bend_east, bend_north, 0.0], (0.0, 330.0)
    )
    mission = exact(truth)
    (segment,) = mission.segments
    # The start is the truth 20 m off: no start may matter.
    start = replace(segment.reference, position=segment.reference.position + 20.0)
    windows = xue2024(mission, order, window=12, starts={"": start})[""]
    assert windows.centre.solved.all()
    assert off(windows, truth) < 2e-5
    middle = windows.coefficients[:, :, 1] - truth.velocity(windows.centre.t)[:, :2]
    assert np.abs(middle).max() < 1e-6
    np.testing.assert_allclose(
        windows.coefficients[:, :, 2], [[bend_east / 2, bend_north / 2]] * 19, atol=1e-7
    )


def test_the_start_is_found_in_the_pings_alone():
    truth = constant_acceleration(
        [-600.0, 140.0, -900.0], [2.5, -1.0, 0.0], [0.0, 0.004, 0.0], (0.0, 330.0)
    )
    mission = exact(truth)
    (segment,) = mission.segments
    blind = replace(mission, segments=(replace(segment, reference=None),))
    windows = xue2024(blind, "constant_acceleration")[""]
    assert len(windows) == 23
    assert off(windows, truth) < 1e-4


def test_lever_arms_and_attitude_count():
    truth = constant_acceleration(
        [-600.0, 140.0, -900.0], [2.5, -1.0, 0.1], [0.0, 0.0, 0.0], (0.0, 330.0)
    ).with_attitude(heading=0.7, pitch=0.1, roll=-0.2)
    vehicle = Vehicle(transducer=LeverArm(3.0, -1.0, 12.0), depth_sensor=LeverArm(-2.0, 1.0, -3.0))
    windows = xue2024(exact(truth, vehicle), "constant_velocity")[""]
    assert off(windows, truth) < 1e-5
    without = replace(exact(truth, vehicle), vehicle=Vehicle())
    assert off(xue2024(without, "constant_velocity")[""], truth) > 1.0


def window_of(mission: Mission, number: int, size: int = 8):
    """Times (m, 2), beacons (m, 3), lengths (m,) and relative slowness of a window, by hand."""
    pings = mission.segments[0].two_way_range
    rows = slice(number, number + size)
    t = np.stack([pings.t_transmit, pings.t_receive], axis=1)[rows]
    beacon = np.array([b.position for b in mission.beacons])[mission.beacon_numbers(pings.beacon)][
        rows
    ]
    speed_at = mission.sound_speed.speed_at
    time = quad(lambda z: 1.0 / float(speed_at(z)), 1000.0, 2500.0, limit=1000, epsabs=1e-12)[0]
    return t, beacon, pings.travel_time[rows] * 1500.0 / time


def lengths(theta, elapsed, beacon, order: int):
    """Both legs of each ping for coefficients (2 (q + 1)), m: the definition, row by row."""
    out = np.zeros(len(beacon))
    for i, (place, times) in enumerate(zip(beacon, elapsed, strict=True)):
        for s in times:
            east, north = (np.polyval(c[::-1], s) for c in theta.reshape(2, order + 1))
            out[i] += np.linalg.norm([east - place[0], north - place[1], 1500.0])
    return out


@pytest.mark.parametrize("track", ["straight", "spiral"])
@pytest.mark.parametrize("order", [1, 2])
def test_scipy_finds_the_same_coefficients(track, order):
    mission, truth = xue_pass(track, seed=4, sigma=1.15e-3)
    windows = xue2024(mission, order)[""]
    for number in (0, 47, 89, 93):
        t, beacon, length = window_of(mission, number)
        epoch = 0.5 * (t[0, 0] + t[-1, 1])
        assert windows.centre.t[number] == pytest.approx(epoch, abs=1e-9)
        start = np.zeros((2, order + 1))
        start[:, 0], start[:, 1] = truth.position(epoch)[0, :2], truth.velocity(epoch)[0, :2]
        found = least_squares(
            lambda x, at=t - epoch, b=beacon, le=length: lengths(x, at, b, order) - le,
            start.ravel(),
            x_scale=np.tile(40.0 ** -np.arange(order + 1.0), 2),
            xtol=1e-14,
            ftol=1e-14,
            gtol=1e-14,
            max_nfev=1000,
        )
        mine = windows.coefficients[number]
        scale = 40.0 ** np.arange(order + 1)
        np.testing.assert_allclose(
            mine * scale, found.x.reshape(2, order + 1) * scale, atol=1e-2 if order == 1 else 1e-3
        )
        cost = ((lengths(mine.ravel(), t - epoch, beacon, order) - length) ** 2).sum()
        assert cost <= 2.0 * found.cost * (1.0 + 1e-6)


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_trdop_is_that_of_differenced_ranges(order):
    mission, _ = xue_pass("accelerating", seed=2)
    windows = xue2024(mission, order, window=10)[""]
    for number in (0, 40, 90):
        t, beacon, _ = window_of(mission, number, 10)
        elapsed = t - windows.centre.t[number]
        x = windows.coefficients[number].ravel()
        steps = np.tile(0.1 * 40.0 ** -np.arange(order + 1.0), 2)
        columns = [
            (
                lengths(x + h * unit, elapsed, beacon, order)
                - lengths(x - h * unit, elapsed, beacon, order)
            )
            / (2.0 * h)
            for h, unit in zip(steps, np.eye(len(x)), strict=True)
        ]
        design = np.array(columns).T * (0.5 if order == 0 else 1.0)
        variance = np.diag(np.linalg.inv(design.T @ design)).reshape(2, order + 1)
        np.testing.assert_allclose(windows.dop[number], np.sqrt(variance.sum(axis=0)), rtol=1e-5)
        assert windows.trdop[number] == pytest.approx(np.sqrt(variance.sum()), rel=1e-5)


def test_errors_grow_with_the_noise():
    small, large = (xue_pass("straight", seed=5, sigma=sigma)[0] for sigma in (1e-5, 1e-4))
    truth = xue_track("straight")
    still = xue2024(xue_pass("straight", seed=5, noise=0.0)[0], 1)[""].centre.position
    a, b = (xue2024(m, 1)[""].centre.position - still for m in (small, large))
    np.testing.assert_allclose(10.0 * a, b, atol=2e-3)
    assert np.abs(still - truth.position(xue2024(small, 1)[""].centre.t)).max() < 0.02


def test_windows_in_seconds_hold_what_was_sent_and_heard_in_them():
    mission, truth = xue_pass("straight", seed=1, noise=0.0)
    windows = xue2024(mission, 1, window_seconds=80.0)[""]
    pings = mission.segments[0].two_way_range
    # From the ninth ping on: its reply comes more than 80 s after the first emission.
    assert len(windows) == 93
    assert (windows.count == 8).all()
    np.testing.assert_allclose(windows.newest.t, pings.t_receive[8:])
    np.testing.assert_allclose(windows.current.t, pings.t_transmit[8:])
    assert rms(windows.centre, truth) < 0.02


def test_a_window_with_too_few_pings_is_left_unsolved():
    mission, truth = xue_pass("straight", seed=1, noise=0.0)
    (segment,) = mission.segments
    pings = segment.two_way_range
    keep = np.ones(101, dtype=bool)
    keep[40:46] = False
    gappy = replace(mission, segments=(replace(segment, two_way_range=pings[keep]),))
    windows = xue2024(gappy, "constant_velocity", window_seconds=80.0)[""]
    few = windows.count <= 4
    assert few.any()
    assert (windows.centre.solved == ~few).all()
    assert np.isnan(windows.centre.position[few]).all()
    assert np.isnan(windows.trdop[few]).all()
    assert np.isnan(windows.coefficients[few]).all()
    errors = windows.centre.errors(truth.reference(np.arange(0.0, 1010.0)))
    assert np.isnan(errors[few]).all()
    assert np.nanmax(errors) < 0.05


def test_a_singular_window_is_left_unsolved():
    """All pings to one beacon, along a line through it: nothing tells left from right."""
    truth = xue_track("straight")
    mission, _ = xue_pass(truth, seed=1, noise=0.0)
    (segment,) = mission.segments
    sea = Sea(mission.sound_speed, "eigenray")
    pings = two_way_pings(
        truth,
        [mission.beacons[1]],
        np.arange(0.0, 200.0, 10.0),
        sea,
        np.random.default_rng(0),
        noise=0.0,
    )
    single = replace(mission, segments=(replace(segment, two_way_range=pings),))
    start = {"": truth.reference(np.arange(0.0, 220.0))}
    windows = xue2024(single, "constant_velocity", starts=start)[""]
    assert not windows.centre.solved.any()


def no_depth(mission: Mission) -> Mission:
    return replace(mission, segments=(replace(mission.segments[0], depth=None),))


def no_pings(mission: Mission) -> Mission:
    fixes = PositionFix([0.0, 10.0], 0.0, 0.0)
    only = replace(mission.segments[0], two_way_range=None, position=fixes)
    return replace(mission, segments=(only,))


BAD = {
    "as many pings as parameters": (None, {"window": 4}, ConfigurationError, "4 parameters"),
    "as many in seconds": (None, {"window_seconds": 40.0}, UnobservableError, "4 parameters"),
    "no such model": (None, {"model": "cubic"}, ConfigurationError, "'cubic'"),
    "negative order": (None, {"model": -1}, ConfigurationError, "'-1'"),
    "no order": (None, {"model": True}, ConfigurationError, "'True'"),
    "no length": (None, {"window_seconds": 0.0}, ConfigurationError, "0.0 s"),
    "no number": (None, {"window_seconds": float("nan")}, ConfigurationError, "nan s"),
    "longer than the mission": (None, {"window": 102}, DataError, "101 two-way pings"),
    "longer in seconds": (None, {"window_seconds": 2000.0}, DataError, "2000 s"),
    "no depth": (no_depth, {}, DataError, "no depth"),
    "no pings": (no_pings, {}, DataError, "no two_way_range"),
}


@pytest.mark.parametrize(("change", "asked", "error", "named"), BAD.values(), ids=BAD)
def test_what_cannot_be_is_said_in_one_line(change, asked, error, named):
    mission, _ = xue_pass("straight", seed=1)
    mission = mission if change is None else change(mission)
    with pytest.raises(error, match=named) as caught:
        xue2024(mission, **{"model": "constant_velocity", **asked})
    assert "\n" not in str(caught.value)


def test_what_the_windows_do_not_use_does_not_matter():
    mission, _ = xue_pass("spiral", seed=3)
    (segment,) = mission.segments
    other = replace(
        segment,
        reference=None,
        position=PositionFix([100.0, 200.0], 5000.0, 5000.0),
        two_way_range=replace(segment.two_way_range, sigma=0.1),
    )
    plain, changed = (
        xue2024(replace(mission, segments=(s,)), 2)[""].centre.position for s in (segment, other)
    )
    # The search weighs pings by their sigmas: Gauss-Newton begins elsewhere, and ends there.
    np.testing.assert_allclose(plain, changed, atol=1e-6)


# -- the simulation --


def layered_time(profile: SoundSpeedProfile, away: float) -> float:
    """Travel time from 1000 to 2500 m over a horizontal distance, by the paper's layer formulas."""
    inside = (profile.depth >= 1000.0) & (profile.depth <= 2500.0)
    z, c = profile.depth[inside], profile.speed[inside]
    g = np.diff(c) / np.diff(z)

    def layers(p: float) -> tuple[float, float]:
        q = np.sqrt(1.0 - (p * c) ** 2)
        dx = (q[:-1] - q[1:]) / (p * g)
        dt = np.abs(np.log(c[1:] / c[:-1] * (1.0 + q[:-1]) / (1.0 + q[1:])) / g)
        return float(dx.sum()), float(dt.sum())

    p = brentq(lambda p: layers(p)[0] - away, 1e-9, 0.999999 / c.max(), xtol=1e-16, rtol=1e-14)
    return layers(p)[1]


@pytest.mark.parametrize("track", ["straight", "accelerating", "spiral"])
def test_travel_times_are_those_of_the_layer_formulas(track):
    mission, truth = xue_pass(track, seed=1, noise=0.0)
    pings = mission.segments[0].two_way_range
    places = dict(zip(mission.beacon_names, (b.position for b in mission.beacons), strict=True))
    for i in range(0, 101, 9):
        beacon = places[str(pings.beacon[i])]
        legs = [
            layered_time(mission.sound_speed, float(np.hypot(*(truth.position(t)[0] - beacon)[:2])))
            for t in (pings.t_transmit[i], pings.t_receive[i])
        ]
        # Differences of square roots cost the formulas some digits.
        assert pings.travel_time[i] == pytest.approx(sum(legs), abs=2e-9)
        assert pings.t_receive[i] - pings.t_transmit[i] == pytest.approx(pings.travel_time[i])


def test_the_scene_is_the_papers():
    mission, truth = xue_pass("spiral", seed=1, sigma=1e-3)
    pings = mission.segments[0].two_way_range
    assert pings.beacon[:6].tolist() == ["N", "W", "S", "E", "N", "W"]
    np.testing.assert_array_equal(pings.t_transmit, 10.0 * np.arange(101))
    assert (pings.sigma == 1e-3).all()
    for b in mission.beacons:
        assert np.hypot(*b.position[:2]) == pytest.approx(750.0)
        assert b.position[2] == -2500.0
    radius = np.hypot(*truth.position([250.0, 500.0])[:, :2].T)
    np.testing.assert_allclose(radius, [437.5, 875.0])
    # Counter-clockwise: north a quarter of a turn after east.
    np.testing.assert_allclose(truth.position(125.0)[0, :2], [0.0, 218.75], atol=1e-9)
    t = np.linspace(1.0, 999.0, 50)
    slope = (truth.position(t + 1e-3) - truth.position(t - 1e-3)) / 2e-3
    np.testing.assert_allclose(truth.velocity(t), slope, atol=1e-6)
    assert munk_profile().harmonic_mean(1000.0, 2500.0) == pytest.approx(1503.435, abs=5e-4)


def test_seeds_repeat_and_differ():
    a, b, c = (xue_pass("straight", seed=s)[0].segments[0].two_way_range for s in (1, 1, 2))
    np.testing.assert_array_equal(a.travel_time, b.travel_time)
    assert (a.travel_time != c.travel_time).all()
    first, again = (xue_wandering(7).position([900.0]) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    with pytest.raises(ConfigurationError, match="no track 'circle'"):
        xue_pass("circle")


# -- the paper's numbers --

TRACKS = ("straight", "accelerating", "spiral")
SPACE = {"straight": 107.6066, "accelerating": 114.8206, "spiral": 431.0249}
DOPS = {
    0: dict(zip(TRACKS, (1.5000, 1.5029, 1.4982), strict=True)),
    1: dict(zip(TRACKS, (0.7975, 0.8006, 0.7867), strict=True)),
    2: dict(zip(TRACKS, (1.6857, 1.6747, 1.4260), strict=True)),
}
#: Centre and current of the paper's Table 4, m.
PRINTED = {
    (1, "straight"): (1.3893, 2.4948),
    (1, "accelerating"): (1.5879, 2.9749),
    (1, "spiral"): (34.8994, 85.3297),
    (2, "straight"): (2.8209, 7.7028),
    (2, "accelerating"): (2.3941, 6.0391),
    (2, "spiral"): (4.1545, 11.7369),
}


@pytest.mark.parametrize("track", TRACKS)
def test_the_papers_tables_come_out_again(track):
    """Space intersections and TRDOPs hang on the geometry alone; the rest is noise of 1.15 ms."""
    found: dict[int, list[Windows]] = {0: [], 1: [], 2: []}
    truth = xue_track(track)
    start = {"": truth.reference(np.arange(0.0, 1020.0))}
    for seed in (1, 2, 3, 4):
        mission, _ = xue_pass(track, seed, sigma=1.15e-3)
        for order, windows in found.items():
            windows.append(xue2024(mission, order, starts=start)[""])
    for order, windows in found.items():
        assert all(w.centre.solved.all() and len(w) == 94 for w in windows)
        dop = np.mean([w.trdop.mean() for w in windows])
        assert dop == pytest.approx(DOPS[order][track], rel=0.02 if order == 2 else 0.01)
        centre, current = (
            np.sqrt(np.mean([rms(getattr(w, epoch), truth) ** 2 for w in windows]))
            for epoch in ("centre", "current")
        )
        if order == 0:
            assert current == pytest.approx(SPACE[track], rel=0.01)
        else:
            assert (centre, current) == pytest.approx(PRINTED[order, track], rel=0.25)


def test_the_stated_noise_is_ten_times_too_small_for_the_papers_errors():
    mission, truth = xue_pass("straight", seed=1, sigma=1e-4)
    windows = xue2024(mission, 1)[""]
    assert rms(windows.centre, truth) == pytest.approx(0.117, rel=0.2)
    assert rms(windows.current, truth) == pytest.approx(0.198, rel=0.2)


@pytest.fixture(scope="module")
def straight_lines(tmp_path_factory, saga) -> Mission:
    """The seven straight lines of SAGA.1903, with the beacons as garpos solves them."""
    path = tmp_path_factory.mktemp("saga") / "mission.toml"
    lines = [f"S01/L0{i}" for i in (1, 2, 4)] + [f"S02/L0{i}" for i in (6, 7, 8, 9)]
    path.write_text(
        '[mission]\nname = "SAGA.1903"\n[data]\nformat = "garpos"\n'
        f'observations = "{saga}/SAGA.1903.kaiyo_k4-obs.csv"\n'
        f'config = "{saga}/SAGA.1903.kaiyo_k4-initcfg.ini"\n'
        f'sound_speed = "{saga}/SAGA.1903.kaiyo_k4-svp.csv"\n'
        f'beacons = "{saga}/SAGA.1903-garpos-solution.json"\n'
        f"lines = {lines}\n".replace("'", '"')
    )
    return load_mission(path)


@pytest.mark.parametrize(
    ("model", "blind", "centre", "newest"),
    [
        ("static", False, None, 82.0),
        ("constant_velocity", True, 1.36, 2.38),
        ("constant_acceleration", False, 1.18, 1.85),
    ],
)
def test_real_lines(straight_lines, model, blind, centre, newest):
    """Against the ship's GNSS; started from the pings alone, or from the reference to save time."""
    starts = None if blind else {s.name: s.reference for s in straight_lines.segments}
    found = xue2024(straight_lines, model, window_seconds=80.0, starts=starts)
    truths = {s.name: runs.of_reference(s.reference) for s in straight_lines.segments}

    def error(epoch: str) -> float:
        gaps = []
        for name, windows in found.items():
            fixes = getattr(windows, epoch)
            gaps.append((fixes.position[:, :2] - truths[name](fixes.t)) ** 2)
        return float(np.sqrt(np.nanmean(np.concatenate(gaps).sum(axis=1))))

    assert all(w.centre.solved.all() for w in found.values())
    assert error("newest") == pytest.approx(newest, rel=0.05)
    if centre is not None:
        assert error("centre") == pytest.approx(centre, rel=0.05)


def test_depth_records_in_any_order():
    mission, _ = xue_pass("straight", seed=2)
    (segment,) = mission.segments
    depth = segment.depth
    mixed = Depth(depth.t[::-1], depth.depth[::-1], depth.sigma[::-1])
    again = replace(mission, segments=(replace(segment, depth=mixed),))
    a, b = (xue2024(m, 1)[""].centre.position for m in (mission, again))
    np.testing.assert_array_equal(a, b)
