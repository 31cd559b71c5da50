"""Held-out pings say whether sigmas are true, and by how much not: docs/consistency.md."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

import ubl_graph.consistency as consistency_module
import ubl_graph.solved as solved_module
from ubl_graph import (
    Beacon,
    ConfigurationError,
    Consistency,
    FixedLagEstimator,
    Fleet,
    Member,
    Mission,
    Options,
    Segment,
    SoundSpeedProfile,
    Start,
    smooth,
)
from ubl_graph.consistency import assess, calibrated, inflated, whiteness_of
from ubl_graph.evaluation import evaluate
from ubl_graph.held_out import LEAST_BLOCK, held_out, time_blocks
from ubl_graph.io.result_files import summary
from ubl_graph.noise_sources import SOURCES, STATED, pings_of, source_of, track_shares
from ubl_graph.result import RangeResiduals, Result
from ubl_graph.sim import (
    Sea,
    ahrs,
    demo_survey,
    dvl,
    lawn_mower,
    planar_vehicle,
    pressure,
    sampled,
    slant_ranges,
    straight_pass,
    two_way_pings,
    wander,
)
from ubl_graph.solve.marginals import Marginals
from ubl_graph.solve.rounds import Solution
from ubl_graph.solved import solved_again

PROFILE = SoundSpeedProfile.constant(1495.0)
BEACONS = tuple(
    Beacon(name, place, turnaround=0.1)
    for name, place in {
        "B1": [921.0, 389.0, -800.0],
        "B2": [-690.0, 780.0, -830.0],
        "B3": [-1105.0, -467.0, -860.0],
        "B4": [627.0, -663.0, -890.0],
    }.items()
)
#: With four beacons and an unknown sound speed a single combination of their errors can be seen.
MORE = (
    *BEACONS,
    Beacon("B5", [-80.0, 1150.0, -845.0], turnaround=0.1),
    Beacon("B6", [120.0, -1080.0, -815.0], turnaround=0.1),
)
#: What the truth has and the mission does not know of.
WRONG: dict[str, dict[str, float]] = {
    "right": {},
    "ranges": {"noise": 3.0},
    "motion": {"psd": 5.0},
    "medium": {"walk": 10.0},
    "beacons": {"survey": 0.2},
}


def drifter(
    seed: int,
    *,
    noise: float = 1.0,
    psd: float = 1.0,
    walk: float = 1.0,
    survey: float = 0.0,
    duration: float = 1000.0,
    loss: str = "cauchy",
) -> Mission:
    """A vehicle that wanders as the motion prior expects, but for what the arguments multiply.

    `survey` is the standard deviation of the beacons' positions, m, which the mission takes for
    exact.
    """
    rng = np.random.default_rng([seed, 8])
    options = Options(loss=loss, vertical_acceleration_psd=1e-4)
    span = (0.0, duration + 30.0)
    beacons = MORE if survey > 0.0 else BEACONS
    true = tuple(replace(b, position=b.position + survey * rng.standard_normal(3)) for b in beacons)
    density = psd * float(options.acceleration_psd)
    for _ in range(200):
        truth = sampled(
            rng, 2, (density, 1e-4), [0.0, 0.0, -60.0], [0.5, 0.3, 0.0], span, step=0.25
        )
        # Beyond the beacons ranges tell less and less, which is another question.
        if np.abs(truth.position(np.arange(0.0, duration, 10.0))[:, :2]).max() < 1000.0:
            break
    scale = wander(rng, 5e-3, walk * float(options.sound_speed_walk), (0.0, duration + 40.0))
    sent = np.arange(0.0, duration, 5.0)
    pings = two_way_pings(truth, true, sent, Sea(PROFILE, log_scale=scale), rng, noise=noise)
    depth = pressure(truth, np.arange(0.0, duration, 2.0), rng)
    segment = Segment(two_way_range=pings, depth=depth, reference=truth.reference(sent))
    return Mission((segment,), beacons, PROFILE, options=options)


@cache
def solved(what: str, seed: int) -> Result:
    return smooth(drifter(seed, **WRONG[what]))


@pytest.fixture(scope="module")
def right() -> Result:
    return solved("right", 1)


def nees(result: Result) -> float:
    return float(evaluate(result)[""].nees.mean())


def test_the_parts_of_a_variance_add_up_to_the_marginals(right):
    """Two routes to a covariance: a sum over sources, and the banded inverse."""
    problem = next(solved_again(right))
    shares = track_shares(problem, pings_of(problem))
    np.testing.assert_allclose(shares[:, :STATED].sum(axis=1), 1.0, atol=1e-9)
    assert (shares >= 0.0).all()
    marginals = Marginals(problem.problem, Solution(problem.x, problem.frozen, 0.0, 0, ""))
    covariance = marginals.of("position")
    np.testing.assert_allclose(covariance, right.trajectory.covariance, rtol=0.02)


def test_a_result_is_found_again_where_it_was(right):
    problem = next(solved_again(right))
    moved = problem.problem.layout.positions(problem.x) - right.trajectory.position
    assert np.abs(moved).max() < 1e-3


def test_every_block_of_residuals_has_a_source():
    for mission in (demo_survey(1)[0], planar_vehicle(1, duration=60.0)[0]):
        result = smooth(mission)
        problem = next(solved_again(result)).problem
        found = {block.name: source_of(block.name) for block in problem.blocks}
        assert set(found.values()) <= set(SOURCES[:STATED])
        assert any(source == "motion" for source in found.values()), found
        assert not any("prior" in n for n, source in found.items() if source == "motion")


def test_blocks_last_a_minute_and_are_never_the_first_or_last(right):
    problem = next(solved_again(right))
    pings = pings_of(problem)
    blocks = time_blocks(pings)
    assert blocks[np.argmin(pings.t)] == blocks[np.argmax(pings.t)] == -1
    starts = [pings.t[blocks == b].min() for b in np.unique(blocks[blocks >= 0])]
    assert np.diff(starts).min() > LEAST_BLOCK - 10.0
    assert len(starts) == 14


def test_predictions_are_those_of_a_mission_without_the_pings(right):
    """The oracle: smooth what is left as a mission of its own, and predict by hand."""
    mission = right.mission
    pings = mission.segments[0].two_way_range
    block = next(p for p in held_out(right) if p.kind == "beacon" and p.beacons == ("B2",))
    left = pings[pings.beacon != "B2"]
    rest = smooth(replace(mission, segments=(replace(mission.segments[0], two_way_range=left),)))
    problem = next(solved_again(right))
    table = pings_of(problem)
    told = (time_blocks(table) >= 0) & (pings.beacon == "B2")
    track, scale = rest.trajectory, rest.segments[0].slow["sound_speed"]
    beacon = BEACONS[1].position
    total = np.zeros(len(pings))
    for t in (pings.t_transmit, pings.t_receive):
        inside = np.clip(t, track.t[0], track.t[-1])
        away = np.linalg.norm(track.at(inside).position - beacon, axis=1)
        total += away / 1495.0 * np.exp(np.interp(inside, scale.t, scale.value[:, 0]))
    error = (total - pings.travel_time)[told].mean()
    assert block.count == (int(told.sum()),)
    assert block.error[0] == pytest.approx(error, abs=2e-6)


def test_predictions_of_the_right_model_miss_by_what_is_stated():
    """Normalised innovations squared over missions drawn from the model, 99.9 % bounds."""
    some = [p for seed in (1, 2) for p in held_out(solved("right", seed)) if p.kind == "block"]
    total, dof = sum(p.nis for p in some), sum(len(p.error) for p in some)
    low, high = chi2.ppf([0.0005, 0.9995], dof)
    assert low < total < high


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    "what", ["right", "ranges", *(pytest.param(w, marks=SLOW) for w in list(WRONG)[2:])]
)
def test_calibrated_covariances_are_true(what: str):
    """Noise larger than stated, of any source: the sigmas are too small, and are mended."""
    seeds = (1, 2, 3) if what in ("medium", "motion", "beacons") else (1, 2)
    before = np.mean([nees(solved(what, s)) for s in seeds])
    results = [calibrated(solved(what, s)) for s in seeds]
    after = np.mean([nees(r) for r in results])
    assert 1.0 < after < 3.5
    if what == "right":
        assert all(r.consistency.agrees for r in results)
    else:
        assert before > 4.0
        assert np.mean([r.consistency.factor for r in results]) > 1.3
        noisy = [r.consistency.noise for r in results]
        if what in ("motion", "medium"):
            assert all(max(n, key=lambda name: n[name]) == what for n in noisy)


@pytest.mark.slow
@pytest.mark.parametrize("what", WRONG)
def test_calibrated_covariances_are_true_over_many_missions(what: str):
    results = [solved(what, s) for s in range(20)]
    results = [calibrated(r) for r in results if r.status == "converged"]
    after = np.mean([nees(r) for r in results])
    covered = np.mean(np.concatenate([evaluate(r)[""].covered for r in results]))
    assert len(results) >= 14
    assert 1.2 < after < 3.0
    assert 0.87 < covered < 0.985
    if what == "right":
        logs = np.array([np.log(r.consistency.factor) for r in results])
        assert abs(logs.mean()) < 0.1
        stated = np.array([r.consistency.log_sigma for r in results])
        assert np.sqrt(np.mean((logs / stated) ** 2)) < 2.0


def test_everything_is_scaled_by_one_factor(right):
    mended = calibrated(right)
    found = mended.consistency
    assert found is not None and found.applied
    square = found.factor**2
    np.testing.assert_array_equal(mended.trajectory.position, right.trajectory.position)
    times = np.linspace(100.0, 900.0, 37)
    for name in ("covariance", "velocity_covariance"):
        plain, scaled = (getattr(r.trajectory.at(times), name) for r in (right, mended))
        np.testing.assert_allclose(scaled, square * plain, rtol=1e-9, atol=1e-15)
    plain, scaled = (r.segments[0].slow["sound_speed"] for r in (right, mended))
    np.testing.assert_allclose(scaled.sigma, found.factor * plain.sigma)
    assert scaled.observed == plain.observed
    assert calibrated(mended).trajectory.covariance[5, 0, 0] == pytest.approx(
        mended.trajectory.covariance[5, 0, 0]
    )


def test_poses_are_scaled_too():
    mission, _ = planar_vehicle(3, duration=660.0)
    plain = smooth(mission)
    mended = calibrated(plain)
    found = mended.consistency
    assert found is not None and not found.trouble
    times = plain.trajectory.t[[5, 100]] + 0.4
    one, other = (r.segments[0].trajectory.at(times) for r in (plain, mended))
    np.testing.assert_allclose(other.pose_covariance, found.factor**2 * one.pose_covariance)
    np.testing.assert_allclose(
        mended.shared["odometry_scale"].sigma, found.factor * plain.shared["odometry_scale"].sigma
    )
    # What the data tell is not less for a covariance that is scaled afterwards.
    loud = replace(plain, consistency=replace(found, factor=50.0))
    for name, state in calibrated(loud).shared.items():
        assert state.observed == plain.shared[name].observed


def test_the_option_does_it_and_the_files_say_so(right):
    options = replace(right.mission.options, covariance="calibrated")
    result = smooth(replace(right.mission, options=options))
    content = summary(result)["consistency"]
    assert content["applied"] and "scaled" in content["verdict"]
    assert content["factor_low"] < content["factor"] < content["factor_high"]
    assert json.loads(json.dumps(content))["blocks"] == 14
    np.testing.assert_allclose(
        result.trajectory.covariance, calibrated(right).trajectory.covariance, rtol=1e-3
    )
    assert "consistency" not in summary(right)


@pytest.mark.parametrize("name", ["covariance", "noise"])
def test_other_words_are_refused(name: str):
    with pytest.raises(ConfigurationError, match=name):
        Options(**{name: "perfect"})


@pytest.mark.parametrize("change", [{"covariance": "calibrated"}, {"noise": "inflated"}])
def test_only_whole_missions_of_one_vehicle_have_held_out_pings(change):
    options = Options(**change)
    with pytest.raises(ConfigurationError, match="whole missions of one vehicle"):
        FixedLagEstimator(options, beacons=BEACONS)
    with pytest.raises(ConfigurationError, match="whole missions of one vehicle"):
        Fleet((Member("auv", Segment()),), beacons=BEACONS, options=options)


def test_noise_is_inflated_on_request():
    mission = solved("ranges", 1).mission
    result = smooth(replace(mission, options=replace(mission.options, noise="inflated")))
    found = result.inflation
    assert found is not None and found.noise["ranges"] > 1.5
    before, after = (m.segments[0].two_way_range.sigma for m in (mission, result.mission))
    np.testing.assert_allclose(after, found.noise["ranges"] * before)
    assert result.mission.options.noise == "given"
    assert {"held-out", "solve"} <= set(result.wall_times)
    assert nees(result) < 0.6 * nees(solved("ranges", 1))


def test_inflation_never_makes_noise_less(right):
    found = assess(right)
    quiet = replace(found, noise={"ranges": 0.5, "motion": 0.3, "medium": 0.9})
    mission = inflated(right.mission, quiet)
    assert mission.options == replace(
        right.mission.options, vertical_acceleration_psd=1e-4, sound_speed_walk=2e-6
    )
    np.testing.assert_array_equal(
        mission.segments[0].two_way_range.sigma, right.mission.segments[0].two_way_range.sigma
    )


def test_velocities_are_what_motion_noise_means_where_there_are_any(right):
    mission = demo_survey(1)[0]
    loud = replace(assess(right), noise={"ranges": 1.0, "motion": 2.0, "medium": 1.0})
    out = inflated(mission, loud)
    np.testing.assert_allclose(
        out.segments[0].velocity.sigma, 2.0 * mission.segments[0].velocity.sigma
    )
    assert out.options.acceleration_psd == mission.options.acceleration_psd


def test_few_pings_give_no_verdict():
    result = smooth(straight_pass(1)[0])
    found = assess(result)
    assert found.trouble and found.factor == 1.0 and not found.agrees
    assert found.verdict.startswith("no verdict")
    mended = calibrated(result)
    np.testing.assert_array_equal(mended.trajectory.covariance, result.trajectory.covariance)
    assert not mended.consistency.applied


def test_what_no_ping_judges_gets_no_verdict():
    """Of a mission with one beacon, nearly all of the variance is the heading reference's."""
    found = assess(smooth(demo_survey(1)[0]))
    assert found.trouble.endswith("what is known of biases and beacons beforehand")
    assert found.shares["other"] > 0.5
    assert "no verdict" in found.verdict
    # What the pings do say of the noise is there, and can be used.
    assert set(found.noise) == {"ranges", "motion", "medium"}


def test_ranges_as_long_as_their_sigmas_are_no_predictions():
    """A tank a few metres wide, and ranges of which nobody said that they are good."""
    rng = np.random.default_rng(1)
    truth = lawn_mower([0.0, 0.0], depth=1.0, lines=20, length=6.0, spacing=0.5, speed=0.2)
    beacons = [Beacon("B1", [-2.0, -2.0, -3.0]), Beacon("B2", [8.0, 2.0, -2.0])]
    end = truth.span[1] - 6.0
    t = np.arange(0.0, end)
    pings = slant_ranges(truth, beacons, t[1:], rng, sigma=0.2)
    segment = Segment(
        slant_range=replace(pings, sigma=np.full(len(pings), 1.0)),
        depth=pressure(truth, t, rng),
        velocity=dvl(truth, t, rng),
        attitude=ahrs(truth, t),
        start=Start(0.0, 0.0, 0.0, sigma=1.0),
    )
    found = assess(smooth(Mission((segment,), tuple(beacons), PROFILE)))
    assert not found.trouble and found.factor < 1.0


def test_long_missions_are_judged_by_excerpts(monkeypatch, right):
    """Cut into excerpts the verdict is that of the whole, but for what chance makes of fewer."""
    whole = assess(right)
    monkeypatch.setattr(solved_module, "LONG", 300)
    monkeypatch.setattr(solved_module, "EXCERPTS", 2)
    monkeypatch.setattr(consistency_module, "LEAST_BLOCKS", 2)
    cut = assess(right)
    assert 2 <= cut.blocks < whole.blocks
    assert not cut.trouble
    assert abs(np.log(cut.factor / whole.factor)) < 3.0 * np.hypot(cut.log_sigma, whole.log_sigma)
    assert cut.shares == whole.shares


def test_an_open_segment_leaves_the_verdict_to_the_others(right):
    two = drifter(2)
    silent = replace(two.segments[0], name="open", reference=None)
    first = replace(right.mission.segments[0], name="sound")
    result = smooth(replace(right.mission, segments=(first, silent)))
    whole = assess(result)
    broken = replace(result.segments[1], status="unobservable", reason="a reason")
    found = assess(replace(result, segments=(result.segments[0], broken)))
    assert found.left_out == ("open",) and whole.left_out == ()
    assert found.blocks < whole.blocks
    assert found.verdict.endswith("not judged: open")
    alone = assess(smooth(replace(right.mission, segments=(first,))))
    assert found.factor == pytest.approx(alone.factor, rel=1e-2)


def test_odometry_without_a_covariance_is_inflated_by_the_options():
    mission, _ = planar_vehicle(3, duration=660.0)
    odometry = replace(mission.segments[0].odometry, covariance=None)
    mission = replace(mission, segments=(replace(mission.segments[0], odometry=odometry),))
    loud = Consistency(noise={"ranges": 1.0, "motion": 2.5, "medium": 1.0})
    options = inflated(mission, loud).options
    for name in ("way_noise", "time_noise", "way_turn_noise_deg", "time_turn_noise_deg"):
        assert getattr(options, f"odometry_{name}") == pytest.approx(
            2.5 * getattr(mission.options, f"odometry_{name}")
        )


def test_an_undetermined_track_gets_no_verdict(right):
    segment = replace(right.segments[0], status="unobservable", reason="a reason")
    found = assess(replace(right, segments=(segment,)))
    assert "unobservable" in found.trouble


def residuals_of(values: np.ndarray) -> RangeResiduals:
    count = len(values)
    name, t, one = np.full(count, "B1"), np.arange(count, dtype=float), np.ones(count)
    found = np.ones(count, dtype=bool)
    return RangeResiduals(name, name, t, t, one, one, values, one, found)


def test_white_residuals_are_called_white_and_others_not():
    rng = np.random.default_rng(0)
    white = rng.standard_normal(400)
    p_values = [
        whiteness_of(residuals_of(rng.standard_normal(300)))["B1"].p_value for _ in range(200)
    ]
    assert 0.01 < np.mean(np.array(p_values) < 0.05) < 0.10
    walk = np.convolve(white, np.ones(4) / 4.0, mode="same")
    found = whiteness_of(residuals_of(walk))["B1"]
    assert found.lag_one == pytest.approx(0.75, abs=0.08)
    assert found.p_value < 1e-10
    assert whiteness_of(residuals_of(white[:3])) == {}
