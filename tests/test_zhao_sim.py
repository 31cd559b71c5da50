"""Zhao's simulation: tracks against the model stepped on, noise against its sigmas, the fleet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ubl_graph import smooth
from ubl_graph.baselines import zhao_ekf
from ubl_graph.errors import ConfigurationError, DataError, TimeError
from ubl_graph.sim import (
    ZHAO_OPTIONS,
    ZhaoSettings,
    map_grid,
    zhao_fleet,
    zhao_map,
    zhao_runs,
    zhao_track,
)
from ubl_graph.sim.zhao import TRACKS

SHORT = ZhaoSettings(duration=600.0)
EXACT = replace(SHORT, noise=0.0)


# -- tracks --


@pytest.mark.parametrize("dt", [1.0, 0.25])
@pytest.mark.parametrize("vehicle", range(4))
def test_tracks_are_the_model_stepped_on(vehicle, dt):
    east, north, yaw, speed, rate = TRACKS[vehicle]
    yaw, track = np.deg2rad(yaw), zhao_track(vehicle, 3600, dt)
    for k in range(3601):
        assert np.abs(track[k] - [east, north, yaw]).max() < 1e-8
        east, north = east + speed * dt * np.cos(yaw), north + speed * dt * np.sin(yaw)
        yaw += rate * dt


def test_tracks_end_where_the_papers_do():
    ends = [zhao_track(a, 3600)[-1, :2].round().tolist() for a in range(4)]
    assert ends == [[3821, 6361], [5084, 2353], [861, 3213], [3475, -96]]


def test_there_are_four_tracks():
    with pytest.raises(ConfigurationError, match="no AUV 4"):
        zhao_track(4, 10)


# -- noise --


def test_noise_is_as_strong_as_stated():
    """Each standard deviation within 4.5 of its own, and nothing shared between pairs."""
    choice = ZhaoSettings(duration=1200.0, range_sigma=20.0, yaw_rate_sigma_deg=0.03, toa_sigma=9.0)
    runs = zhao_runs(40, 8, choice)
    data, there = runs.data, runs.truth[runs.data.ranging_steps, :, :2]
    speed, rate = np.array(TRACKS).T[3:]
    apart = np.hypot(*np.moveaxis(there[:, :, None] - there[:, None], -1, 0))
    upper = np.triu_indices(4, 1)
    pairs = (data.ranges - apart)[..., upper[0], upper[1]]
    for noise, sigma in (
        (data.speed - speed, 0.1),
        (data.yaw_rate - rate, np.deg2rad(0.03)),
        (pairs, 20.0),
        (runs.toa_noise, 9.0),
    ):
        assert noise.std() == pytest.approx(sigma, rel=4.5 / np.sqrt(2 * noise.size))
        assert abs(noise.mean()) < 4.5 * sigma / np.sqrt(noise.size)
    shared = np.corrcoef(pairs.reshape(-1, 6).T) - np.eye(6)
    assert np.abs(shared).max() < 4.5 / np.sqrt(pairs[..., 0].size)
    assert (data.ranges == np.swapaxes(data.ranges, 2, 3)).all()
    assert (np.diagonal(data.ranges, axis1=2, axis2=3) == 0.0).all()


def test_a_run_is_the_same_however_many_are_drawn():
    many, few = zhao_runs(5, 3, SHORT), zhao_runs(2, 3, SHORT, first=3)
    for name in ("speed", "yaw_rate", "ranges"):
        assert (getattr(many.data, name)[3:] == getattr(few.data, name)).all()
    assert (many.toa_noise[3:] == few.toa_noise).all()
    assert (zhao_runs(1, 4, SHORT).data.speed != many.data.speed[:1]).any()
    assert (many.data.speed[0] != many.data.speed[1]).any()


def test_choices_share_the_noise_of_speed_and_yaw_rate():
    one = zhao_runs(2, 3, SHORT)
    other = zhao_runs(2, 3, replace(SHORT, period=120.0, masters=(0, 1), speed_sigma=0.2))
    assert (one.data.yaw_rate == other.data.yaw_rate).all()
    speed = np.array(TRACKS).T[3]
    assert np.allclose(2.0 * (one.data.speed - speed), other.data.speed - speed)


def test_without_noise_measurements_are_the_truth():
    runs = zhao_runs(2, 1, EXACT)
    target = np.array([1500.0, -700.0])
    t = np.array([60.0, 600.0])
    place = np.array([*target, -30.0])
    expected = [
        [np.linalg.norm([*runs.truth[int(k), a, :2], -20.0] - place) for a in range(4)] for k in t
    ]
    assert np.abs(runs.slant_ranges(target, t) - expected).max() < 1e-9
    there = runs.truth[120, :, :2]
    assert runs.data.ranges[1, 1, 2, 3] == pytest.approx(np.linalg.norm(there[2] - there[3]))
    assert runs.data.range_sigma == 30.0


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"dt": 0.0}, "dt"),
        ({"dt": np.nan}, "dt"),
        ({"dt": "1"}, "dt"),
        ({"noise": True}, "noise"),
        ({"dt": 0.7}, "duration"),
        ({"duration": 100.5}, "duration"),
        ({"period": 1.5}, "period"),
        ({"period": 7200.0}, "period"),
        ({"range_sigma": 0.0}, "range_sigma"),
        ({"speed_sigma": -0.1}, "speed_sigma"),
        ({"yaw_rate_sigma_deg": np.inf}, "yaw_rate_sigma_deg"),
        ({"toa_sigma": 0.0}, "toa_sigma"),
        ({"noise": -1.0}, "noise"),
        ({"masters": ()}, "masters"),
        ({"masters": (0, 4)}, "masters"),
        ({"masters": (1, 1)}, "masters"),
        ({"masters": (0, 1, 2, 3)}, "masters"),
    ],
)
def test_bad_settings_are_refused(changes, field):
    with pytest.raises(ConfigurationError, match=f"field '{field}'"):
        ZhaoSettings(**changes)


@pytest.mark.parametrize(("runs", "first"), [(0, 0), (1.5, 0), (1, -1)])
def test_no_runs_are_refused(runs, first):
    with pytest.raises(ConfigurationError, match="field 'runs'"):
        zhao_runs(runs, 1, SHORT, first=first)


def test_targets_are_ranged_at_ranging_times_alone():
    runs = zhao_runs(1, 1, SHORT)
    assert runs.epochs([60.0, 600.0]).tolist() == [0, 9]
    for time in (0.0, 30.0, 660.0, np.nan):
        with pytest.raises(TimeError, match="no ranging time"):
            runs.slant_ranges([0.0, 0.0], time)
    with pytest.raises(DataError, match="target"):
        runs.slant_ranges([0.0, 0.0, -30.0], 60.0)


def test_maps_want_the_estimate_of_their_runs():
    runs, others = zhao_runs(2, 1, SHORT), zhao_runs(3, 1, SHORT)
    with pytest.raises(DataError, match="these runs"):
        zhao_map(runs, zhao_ekf(others.data), [[0.0, 0.0]], 600.0)


def test_a_grids_rows_run_east():
    grid = map_grid(100.0, 3)
    assert grid[:4].tolist() == [[-100, -100], [0, -100], [100, -100], [-100, 0]]


# -- as a fleet --


def test_a_fleets_odometry_adds_up_to_dead_reckoning():
    """Each follower alone, smoothed: the filter's states and covariances."""
    runs = zhao_runs(2, 4, SHORT)
    plain = zhao_ekf(runs.data, "plain")
    fleet = zhao_fleet(runs, 1, pairs=None)
    for a in (1, 2, 3):
        result = smooth(fleet.mission_of(f"AUV{a}"))
        track = result.trajectory
        assert result.status == "converged"
        assert (track.t == runs.data.t).all()
        assert np.abs(track.position[:, :2] - plain.state[1, :, a, :2]).max() < 1e-6
        assert track.position[-1, 2] == -20.0
        spread = plain.covariance[1, 60:, a, :2, :2]
        found = track.covariance[60:, :2, :2]
        largest = np.linalg.norm(spread, axis=(1, 2))[:, None, None]
        assert (np.abs(found - spread) < 1e-3 * largest).all()


@pytest.mark.parametrize("masters", [(0,), (0, 1)])
def test_without_noise_a_fleets_records_are_the_truth(masters):
    runs = zhao_runs(1, 1, replace(EXACT, masters=masters))
    fleet = zhao_fleet(runs, target=[3000.0, 100.0], times=[60.0, 540.0])
    for a, member in enumerate(fleet.vehicles):
        segment, truth = member.segment, runs.truth[:, a]
        start = segment.start
        assert (start.east, start.north, start.up) == (*truth[0, :2], -20.0)
        # Forward by the compass: north cos, east sin.
        step = segment.odometry.forward[0]
        assert truth[0, 0] + step * np.sin(start.heading) == pytest.approx(truth[1, 0])
        assert truth[0, 1] + step * np.cos(start.heading) == pytest.approx(truth[1, 1])
        assert segment.odometry.about_down.sum() == pytest.approx(truth[0, 2] - truth[-1, 2])
        assert (segment.reference.position[:, :2] == truth[:, :2]).all()
        assert (segment.position is not None) == (a in masters)
        if segment.position is not None:
            at = np.concatenate([[0], runs.data.ranging_steps])
            assert (segment.position.t == runs.data.t[at]).all()
            assert (segment.position.position == truth[at, :2]).all()
        for t, name, read, sigma in zip(
            segment.slant_range.t,
            segment.slant_range.beacon,
            segment.slant_range.distance,
            segment.slant_range.sigma,
            strict=True,
        ):
            here = np.array([*truth[int(t), :2], -20.0])
            there = np.array([3000.0, 100.0, -30.0])
            if name != "target":
                there = np.array([*runs.truth[int(t), int(name[-1]), :2], -20.0])
            assert read == pytest.approx(np.linalg.norm(here - there))
            assert sigma == (15.0 if name == "target" else 30.0)


def test_a_fleet_has_the_ranges_that_the_filter_used():
    runs = zhao_runs(3, 6, SHORT)
    estimate = zhao_ekf(runs.data)
    fleet = zhao_fleet(runs, 2, pairs=estimate.partner[2])
    used = {
        (t, frozenset((a, int(b))))
        for t, row in zip(60.0 * np.arange(1, 11), estimate.partner[2], strict=True)
        for a, b in enumerate(row)
        if b >= 0
    }
    found = {}
    for a, member in enumerate(fleet.vehicles):
        rows = member.segment.slant_range
        for i in range(0 if rows is None else len(rows)):
            other = int(rows.beacon[i][-1])
            found[rows.t[i], frozenset((a, other))] = rows.distance[i]
            epoch = int(rows.t[i] // 60) - 1
            assert rows.distance[i] == runs.data.ranges[2, epoch, a, other]
    assert set(found) == used
    assert len(found) == 30


def test_all_pairs_range_once_each_and_none_where_none_shall():
    runs = zhao_runs(1, 1, SHORT)
    counts = [
        0 if m.segment.slant_range is None else len(m.segment.slant_range)
        for m in zhao_fleet(runs).vehicles
    ]
    assert counts == [0, 10, 20, 30]
    assert all(m.segment.slant_range is None for m in zhao_fleet(runs, pairs=None).vehicles)


@settings(max_examples=20)
@given(st.integers(0, 10**6))
def test_a_pair_that_both_ends_name_ranges_once(seed):
    runs = zhao_runs(1, 1, replace(SHORT, duration=180.0))
    partner = np.random.default_rng(seed).integers(-1, 4, (3, 4))
    partner[partner == np.arange(4)] = -1
    pairs = {
        (e, frozenset((a, int(b)))) for e in range(3) for a, b in enumerate(partner[e]) if b >= 0
    }
    fleet = zhao_fleet(runs, pairs=partner)
    ranges = [m.segment.slant_range for m in fleet.vehicles]
    assert sum(len(r) for r in ranges if r is not None) == len(pairs)


def test_a_fleets_target_is_at_a_known_depth_and_anywhere():
    runs = zhao_runs(2, 1, SHORT)
    place, times = [-4000.0, 2500.0], [120.0, 600.0]
    fleet = zhao_fleet(runs, 1, pairs=None, target=place, times=times, guess=[0.0, 1.0])
    (target,) = fleet.targets
    assert target.position.tolist() == [0.0, 1.0, -30.0]
    assert target.sigma.tolist() == [1e5, 1e5, 0.0]
    read = runs.slant_ranges(place, times)[1]
    for a, member in enumerate(fleet.vehicles):
        assert (member.segment.slant_range.distance == read[:, a]).all()
        assert (member.segment.slant_range.t == times).all()
    unsaid = zhao_fleet(runs, 1, pairs=None, target=place, times=times)
    assert unsaid.targets[0].position.tolist() == [*place, -30.0]


def test_a_fleets_options_are_what_is_known_of_the_simulation():
    fleet = zhao_fleet(zhao_runs(1, 1, SHORT))
    assert fleet.options is ZHAO_OPTIONS
    assert all(m.options is ZHAO_OPTIONS for m in fleet.vehicles)
    assert zhao_fleet(
        zhao_runs(1, 1, SHORT), options=replace(ZHAO_OPTIONS, lag=300.0)
    ).options.lag == pytest.approx(300.0)


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        ({"run": 1}, ConfigurationError, "no run 1"),
        ({"run": -1}, ConfigurationError, "no run -1"),
        ({"pairs": "some"}, DataError, "'some' names no pairs"),
        ({"pairs": np.zeros((9, 4))}, DataError, "field 'pairs'"),
        ({"pairs": np.zeros((10, 4))}, DataError, "partners"),
        ({"pairs": np.full((10, 4), 4)}, DataError, "partners"),
        ({"pairs": np.full((10, 4), -2)}, DataError, "partners"),
        ({"pairs": np.full((10, 4), 0.5)}, DataError, "partners"),
        ({"target": [0.0, np.nan], "times": 60.0}, DataError, "target"),
        ({"target": [0.0, 0.0], "times": 61.0}, TimeError, "no ranging time"),
        ({"target": [0.0, 0.0], "times": 60.0, "guess": 1.0}, DataError, "guess"),
    ],
)
def test_fleets_that_cannot_be_are_refused(changes, error, text):
    with pytest.raises(error, match=text) as caught:
        zhao_fleet(zhao_runs(1, 1, SHORT), **changes)
    assert "\n" not in str(caught.value)
