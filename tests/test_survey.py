"""Beacon surveys from a known track: simulated, against the truth and closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2
from survey import Water, straight_track, survey

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.beacon import Beacon
from ubl_graph.errors import ConfigurationError, DataError
from ubl_graph.frames import LeverArm, world_R_body
from ubl_graph.measurements import Attitude, Depth, PositionFix
from ubl_graph.mission import Mission, Segment, Vehicle
from ubl_graph.options import Options
from ubl_graph.sim import Clock, Sea, fixes, lawn_mower, one_way_pings, slant_ranges
from ubl_graph.survey import SurveyOptions, SurveyResult, calibrate
from ubl_graph.survey.known import known_pings
from ubl_graph.survey.model import SurveyModel
from ubl_graph.survey.track import FixTrack

STATED = SurveyOptions(fit_noise=False)
STILL = Water(0.0, 0.0, 0.0, 0.0)


def nees(result: SurveyResult, true: np.ndarray) -> float:
    error = (result.position - true).ravel()
    return float(error @ np.linalg.solve(result.covariance, error))


def within_bounds(values: list[float], size: int, share: float = 0.99) -> bool:
    """Whether the sum of NEES of `size` degrees of freedom each lies within two-sided bounds."""
    low, high = chi2.interval(share, size * len(values))
    return bool(low < sum(values) < high)


# Positions


@pytest.mark.parametrize(("beacons", "depth"), [(4, 1000.0), (1, 300.0)])
def test_exact_data_give_exact_positions(beacons, depth):
    mission, true = survey(1, beacons=beacons, depth=depth, noise=0.0, water=STILL, start_off=5.0)
    result = calibrate(mission, STATED)
    assert result.status == "converged" and result.method == "known track"
    np.testing.assert_allclose(result.position, true, atol=1e-5)
    assert np.abs(result.residuals.residual).max() < 1e-8


def test_a_constant_sound_speed_error_and_gradients_are_told_from_positions():
    mission, true = survey(2, noise=0.0, water=Water(2e-3, 0.0, 1e-7, 0.0))
    result = calibrate(mission, STATED)
    # The priors of the water pull a little, by less than its sigmas.
    assert np.abs(result.position - true).max() < 0.7 * result.sigma.min()
    without = calibrate(mission, SurveyOptions(fit_noise=False, gradients=False))
    assert np.abs(without.position - true).max() > 3.0 * np.abs(result.position - true).max()
    assert "vehicle_gradient" not in without.slow


def test_nees_with_gradients():
    found = [survey(seed, pings=250) for seed in range(12)]
    assert within_bounds([nees(calibrate(m, STATED), true) for m, true in found], 12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "fitted"),
    [({}, True), ({"beacons": 2}, True), ({"pings": 80}, True), ({"depth": 4000.0}, False)],
)
def test_nees_over_50_surveys(kind, fitted):
    values: list[float] = []
    for seed in range(50):
        mission, true = survey(100 + seed, **kind)
        values.append(nees(calibrate(mission, SurveyOptions(fit_noise=fitted)), true))
    assert within_bounds(values, 3 * kind.get("beacons", 4)), np.mean(values)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_starts_30_m_off_lead_to_the_same_answer(seed):
    near, true = survey(seed)
    off, _ = survey(seed, start_off=30.0)
    gap = np.array([b.position for b in off.beacons]) - true
    np.testing.assert_allclose(np.linalg.norm(gap, axis=1), 30.0)
    a, b = calibrate(near), calibrate(off)
    assert b.status == "converged"
    # Gradients count from the centre of what was given.
    assert np.abs(a.position - b.position).max() < 0.1 * a.sigma.min()


def test_outliers_are_named_and_do_little():
    clean, true = survey(4)
    result = calibrate(survey(4, outliers=0.3)[0])
    table = result.residuals
    wrong = np.abs(table.residual) > 2e-3
    assert 0.2 < wrong.mean() < 0.4 and table.down_weighted[wrong].all()
    assert any("are down-weighted" in warning for warning in result.warnings)
    assert np.abs(result.position - true).max() < 4.0 * calibrate(clean).sigma.max()


@settings(max_examples=4)
@given(st.tuples(*[st.floats(-3000.0, 3000.0)] * 2))
def test_moving_the_map_moves_the_answer(shift):
    mission, _ = survey(5, pings=120)
    (segment,) = mission.segments
    fix = segment.position
    moved = replace(fix, east=fix.east + shift[0], north=fix.north + shift[1])
    beacons = tuple(
        replace(b, position=b.position + np.append(shift, 0.0)) for b in mission.beacons
    )
    other = replace(mission, beacons=beacons, segments=(replace(segment, position=moved),))
    a, b = calibrate(mission, STATED), calibrate(other, STATED)
    np.testing.assert_allclose(b.position - a.position, [[*shift, 0.0]] * 4, atol=1e-5)
    np.testing.assert_allclose(b.covariance, a.covariance, rtol=1e-4, atol=1e-9)


# Priors


def test_a_given_sigma_is_fused_as_a_prior():
    """Against the information form, which puts together what ranges say and what was given."""
    sigma = 0.05
    mission, _ = survey(6, sigma=sigma, options=Options(loss="none"))
    free = replace(mission, beacons=tuple(replace(b, sigma=0.0) for b in mission.beacons))
    alone, both = calibrate(free, STATED), calibrate(mission, STATED)
    assert not both.check.named
    information = np.linalg.inv(alone.covariance)
    prior = np.eye(12) / sigma**2
    covariance = np.linalg.inv(information + prior)
    stated = np.concatenate([b.position for b in mission.beacons])
    mean = covariance @ (information @ alone.position.ravel() + prior @ stated)
    np.testing.assert_allclose(both.position.ravel(), mean, atol=5e-4)
    np.testing.assert_allclose(both.covariance, covariance, atol=0.01 * covariance.max())
    assert (both.sigma < alone.sigma).all()


def test_a_sigma_of_zero_is_no_prior():
    mission, _ = survey(7, pings=120, sigma=0.001)
    first = mission.beacons[0]
    off = replace(first, position=first.position + np.array([8.0, 0.0, 0.0]), sigma=0.0)
    result = calibrate(replace(mission, beacons=(off, *mission.beacons[1:])), STATED)
    assert abs(result.position[0, 0] - first.position[0]) < 4.0 * result.sigma[0, 0]
    assert result.sigma[0].min() > 0.005 > result.sigma[1:].max()


def test_a_moved_beacon_is_named_and_its_given_position_left_out():
    shift = 24.0 * np.array([0.6, -0.64, 0.48])
    mission, true = survey(8, sigma=3.0, moved={"M3": shift})
    result = calibrate(mission)
    assert result.check.named == ("M3",)
    (check,) = (c for c in result.check.checks if c.name == "M3")
    assert (np.abs(check.offset + shift) < 4.0 * check.sigma).all()
    assert "M3 seems off by" in result.verdict
    assert np.abs(result.position - true).max() < 5.0 * result.sigma.max()
    assert any("'M3'" in warning for warning in result.warnings)


@pytest.mark.slow
def test_clean_surveys_raise_few_alarms():
    alarms = 0
    for seed in range(100):
        result = calibrate(survey(500 + seed, sigma=3.0, pings=200)[0], STATED)
        alarms += bool(result.check.named)
    # 1 in 100 is meant; more than 4 has a chance of 0.4 %.
    assert alarms <= 4


def test_nothing_given_is_nothing_checked():
    result = calibrate(survey(9, pings=120)[0], STATED)
    assert not result.check.checks and "no position was given" in result.verdict


# What ranges leave open


def test_a_single_straight_line_leaves_beacons_open():
    mission, _ = survey(1, track=straight_track, duration=1300.0, pings=150)
    result = calibrate(mission, STATED)
    assert result.status == "unobservable" and "do not determine" in result.reason


def line_with_known_depths(east_north: float) -> tuple[Mission, np.ndarray]:
    """A line 100 m off the array's middle; depths are known to 5 cm, places to `east_north`."""
    mission, true = survey(2, beacons=1, track=straight_track, duration=1300.0, pings=200)
    place = true[0] + [0.0, 0.0, 0.02]
    sigma = [east_north, east_north, 0.05]
    return replace(mission, beacons=(Beacon("M1", place, sigma),)), true


def test_beside_a_straight_line_a_vague_position_is_ambiguous():
    mission, true = line_with_known_depths(400.0)
    result = calibrate(mission, STATED)
    assert result.status == "unobservable" and "ambiguous" in result.reason
    mission, true = line_with_known_depths(30.0)
    result = calibrate(mission, STATED)
    assert result.status == "converged"
    assert (np.abs(result.position - true) < 4.0 * result.sigma).all()


def test_never_heard_beacons_stay_as_given():
    mission, _ = survey(10, pings=120)
    far = Beacon("M9", [5e3, 5e3, -900.0], 2.0)
    result = calibrate(replace(mission, beacons=(*mission.beacons, far)), STATED)
    assert result.names == ("M1", "M2", "M3", "M4")
    assert result.beacons[-1].position.tolist() == [5e3, 5e3, -900.0]
    assert any("never heard" in warning and "M9" in warning for warning in result.warnings)


def test_errors_name_what_is_missing():
    mission, _ = survey(11, pings=60)
    (segment,) = mission.segments
    with pytest.raises(ConfigurationError, match="nothing says where the track is"):
        calibrate(
            replace(
                mission,
                beacons=mission.beacons[:4],
                segments=(
                    replace(
                        segment,
                        position=None,
                        two_way_range=segment.two_way_range[
                            np.isin(segment.two_way_range.beacon, ["M1", "M2"])
                        ],
                    ),
                ),
            )
        )
    with pytest.raises(DataError, match="holds no range"):
        calibrate(replace(mission, segments=(replace(segment, two_way_range=None),)))
    with pytest.raises(ConfigurationError, match="knot_spacing"):
        SurveyOptions(knot_spacing=0.0)
    with pytest.raises(ConfigurationError, match="gradient_length"):
        SurveyOptions(gradient_length=float("nan"))


def test_ranges_beyond_the_fixes_are_left_out():
    mission, true = survey(12)
    (segment,) = mission.segments
    fix = segment.position
    early = replace(segment, position=fix[fix.t < np.quantile(fix.t, 0.95)])
    result = calibrate(replace(mission, segments=(early,)), STATED)
    assert len(result.residuals) < len(segment.two_way_range)
    assert any("where no fix is near" in warning for warning in result.warnings)
    assert np.abs(result.position - true).max() < 5.0 * result.sigma.max()


# Noise


def test_the_noise_is_found():
    mission, _ = survey(13, pings=600)
    (segment,) = mission.segments
    rows = segment.two_way_range
    narrow = replace(segment, two_way_range=replace(rows, sigma=rows.sigma / 3.0))
    result = calibrate(replace(mission, segments=(narrow,)))
    assert result.noise.range_factor == pytest.approx(3.0, rel=0.15)
    few = calibrate(survey(13, pings=40)[0])
    assert few.noise.range_factor == 1.0
    assert any("too few" in warning for warning in few.warnings)


def test_range_biases():
    mission, true = survey(14, pings=600, options=Options(range_bias_sigma=1.0))
    (segment,) = mission.segments
    rows = segment.two_way_range
    late = rows.travel_time + 2.0 * 0.6 / 1500.0 * (rows.beacon == "M2")
    segment = replace(segment, two_way_range=replace(rows, travel_time=late))
    result = calibrate(replace(mission, segments=(segment,)), STATED)
    error = (result.position - true) / result.sigma
    assert np.abs(error).max() < 4.0
    for name, (value, sigma) in result.range_bias.items():
        assert abs(value - 0.6 * (name == "M2")) < 4.0 * sigma < 4.0


# Residuals and track


def test_jacobians_by_finite_differences():
    mission, _ = survey(15, pings=30, options=Options(range_bias_sigma=1.0))
    model = SurveyModel(mission, known_pings(mission)[0], SurveyOptions())
    problem = model.problem(model.noise, {})
    block = problem.blocks[0]
    rng = np.random.default_rng(1)
    x = model.start() + 3.0 * rng.standard_normal(model.layout.size)
    frozen = block.frozen(x)
    _, jacobian = block.evaluate(x, frozen)
    dense = np.zeros((len(block), model.layout.size))
    rows = np.broadcast_to(np.arange(len(block))[:, None], block.columns.shape)
    used = block.columns >= 0
    np.add.at(dense, (rows[used], block.columns[used]), jacobian[:, 0][used])
    for column in rng.permutation(model.layout.size)[:40]:
        step = np.zeros(model.layout.size)
        step[column] = 1e-3
        ends = [block.evaluate(x + s * step, frozen, jacobian=False)[0][:, 0] for s in (1, -1)]
        slope = (ends[0] - ends[1]) / 2e-3
        np.testing.assert_allclose(dense[:, column], slope, rtol=1e-5, atol=1e-6)


def test_fixes_by_the_second_are_interpolated():
    at_pings, true = survey(16, noise=0.0, water=STILL)
    by_second, _ = survey(16, noise=0.0, water=STILL, fixes_every=1.0)
    a, b = calibrate(at_pings, STATED), calibrate(by_second, STATED)
    np.testing.assert_allclose(a.position, true, atol=1e-5)
    np.testing.assert_allclose(b.position, true, atol=5e-3)


def test_a_track_is_known_at_fixes_and_near_them_only():
    t = np.array([0.0, 1.0, 2.0, 3.0, 10.0])
    fixes_ = PositionFix(t, t**3, 2.0 * t, -1.0 + 0.0 * t, sigma=0.1)
    track = FixTrack(Segment(position=fixes_), Vehicle())
    place, variance, known = track.at(np.array([0.0, 1.5, 3.0, 6.0, 10.0, 11.0]))
    assert known.tolist() == [True, True, True, False, True, False]
    np.testing.assert_allclose(place[:3, 0], [0.0, 1.5**3, 27.0], atol=1e-12)
    np.testing.assert_allclose(variance[known], 0.01)
    assert not FixTrack(Segment(), Vehicle()).at(t)[2].any()


def test_a_horizontal_fix_takes_its_height_from_the_depth():
    t = np.arange(5.0)
    heading = np.deg2rad(90.0)
    segment = Segment(
        position=PositionFix(t, 10.0 + t, 0.0 * t, sigma=0.1),
        depth=Depth(t, 7.0 + 0.0 * t, 0.2),
        attitude=Attitude(t, heading),
    )
    arms = {
        "transducer": LeverArm(forward=2.0, right=1.0, down=3.0),
        "antenna": LeverArm(forward=-4.0, down=-6.0),
        "depth_sensor": LeverArm(down=1.5),
    }
    place, variance, known = FixTrack(segment, Vehicle(**arms)).at(np.array([2.5]))
    turn = world_R_body(heading, 0.0, 0.0).reshape(3, 3)
    expected = turn @ (arms["transducer"].body - arms["antenna"].body) + [12.5, 0.0, 0.0]
    np.testing.assert_allclose(place[0, :2], expected[:2], atol=1e-12)
    np.testing.assert_allclose(place[0, 2], -7.0 + 1.5 - 3.0, atol=1e-12)
    np.testing.assert_allclose(variance[0], [0.01, 0.01, 0.04])
    assert known.all()
    blind = FixTrack(replace(segment, depth=None), Vehicle(**arms))
    assert not blind.at(t)[2].any()


# Other ranges


@pytest.mark.parametrize("kind", ["one_way", "slant"])
def test_other_kinds_of_ranges(kind):
    rng = np.random.default_rng(3)
    truth = lawn_mower([0, 0], depth=20.0, lines=5, length=300.0, spacing=60.0, speed=1.5)
    beacons = (Beacon("B1", [30.0, 160.0, -150.0]), Beacon("B2", [170.0, 120.0, -160.0]))
    profile = SoundSpeedProfile.constant(1500.0)
    end = truth.span[1] - 5.0
    sent = np.arange(3.0, end, 3.0)
    place = fixes(truth, np.arange(0.0, truth.span[1], 1.0), rng, sigma=0.02, horizontal=False)
    if kind == "slant":
        ranges = {"slant_range": slant_ranges(truth, beacons, sent, rng, sigma=0.05)}
    else:
        clock = Clock(0.3, 1e-6)
        rows = one_way_pings(truth, beacons, sent, Sea(profile), rng, clock=clock)
        ranges = {"one_way_range": rows}
    off = tuple(replace(b, position=b.position + np.array([10.0, -8.0, 5.0])) for b in beacons)
    mission = Mission((Segment(position=place, **ranges),), off, profile)
    result = calibrate(mission, STATED)
    assert result.status == "converged" and result.method == "known track"
    error = result.position - [b.position for b in beacons]
    assert (np.abs(error) < 4.0 * result.sigma).all() and result.sigma.max() < 1.5
    if kind == "one_way":
        assert result.slow["clock_offset"].value[0, 0] == pytest.approx(0.3, abs=2e-3)


# Clocks and single ranges


def test_a_clock_that_was_set_between_two_dives_is_two_clocks():
    truth = lawn_mower([-400.0, -400.0], depth=0.0, lines=5, length=800.0, spacing=200.0, speed=2.5)
    places = [
        Beacon(f"B{k}", [700.0 * np.cos(2 * k), 700.0 * np.sin(2 * k), -1e3]) for k in range(3)
    ]
    sea, times = Sea(SoundSpeedProfile.constant(1500.0)), np.arange(0.0, 1790.0)
    segments = []
    for k, offset in enumerate((0.5, 0.9)):
        rng = np.random.default_rng(k)
        heard = one_way_pings(
            truth, places, np.arange(2.0, 1780.0, 6.0), sea, rng, clock=Clock(offset, 1e-8)
        )
        fixed = fixes(truth, times, rng, sigma=0.05, horizontal=False)
        by = 86400.0 * k
        heard = replace(heard, t_transmit=heard.t_transmit + by, t_receive=heard.t_receive + by)
        segments.append(
            Segment(f"dive {k}", one_way_range=heard, position=replace(fixed, t=fixed.t + by))
        )
    mission = Mission(tuple(segments), tuple(places), sea.profile)
    result = calibrate(mission, STATED)
    true = np.array([b.position for b in places])
    assert result.status == "converged"
    assert nees(result, true) < chi2.ppf(0.999, 9)
    assert np.abs(result.position - true).max() < 3.0
    clock = result.slow["clock_offset"]
    assert clock.value[clock.t < 4e4].mean() == pytest.approx(0.5, abs=2e-3)
    assert clock.value[clock.t > 4e4].mean() == pytest.approx(0.9, abs=2e-3)


def test_a_single_range_leaves_its_beacon_open():
    truth = lawn_mower([0.0, 0.0], depth=0.0, lines=1, length=100.0, spacing=10.0, speed=1.0)
    rng, beacon = np.random.default_rng(1), Beacon("B", [300.0, 0.0, -100.0])
    segment = Segment(
        slant_range=slant_ranges(truth, [beacon], np.array([10.0]), rng, sigma=1.0),
        position=fixes(truth, np.array([10.0]), rng, sigma=0.1, horizontal=False),
    )
    mission = Mission((segment,), (beacon,), SoundSpeedProfile.constant(1500.0))
    result = calibrate(mission, STATED)
    assert result.status == "unobservable"
