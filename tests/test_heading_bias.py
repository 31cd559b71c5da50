"""A heading reference that is off and wanders: the bias as a state of every node.

The oracles: odometry's displacement integrated by quadrature under a bias that changes, the
variance of a random walk's mean between two known ends by simulation, and truth drawn from the very
model, against which NEES is judged (`tests/test_consistency.py` says how).
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from online import Run, records_of, run, until
from scipy.integrate import quad
from scipy.stats import chi2
from test_consistency import assert_consistent, squared

from ubl_graph import (
    Attitude,
    Beacon,
    Mission,
    Options,
    Segment,
    SoundSpeedProfile,
    Start,
    Velocity,
    smooth,
)
from ubl_graph.evaluation import evaluate
from ubl_graph.factors.block import LinearBlock
from ubl_graph.graph import build_problem, model_segment
from ubl_graph.io.result_files import write_result
from ubl_graph.observability import observability
from ubl_graph.problem import Problem
from ubl_graph.result import Result
from ubl_graph.sim import (
    DRIFTING,
    Sea,
    Truth,
    ahrs,
    drifting_heading,
    dvl,
    lawn_mower,
    pressure,
    two_way_pings,
)

#: The heading taken at its word: no bias is estimated.
AT_ITS_WORD = {"heading_bias_sigma_deg": 0.0}
#: Where in a run of `judged` the estimate is looked at, as a share of its nodes.
PLACES = {"start": 0.0, "quarter": 0.25, "middle": 0.5, "end": 1.0}
PROFILE = SoundSpeedProfile.constant(1500.0)
BEACONS = (
    Beacon("B1", [-150.0, 120.0, -110.0]),
    Beacon("B2", [160.0, 140.0, -112.0]),
    Beacon("B3", [150.0, -140.0, -115.0]),
)


@dataclass(frozen=True)
class Judged:
    """A smoothed run against its truth: horizontal rms error (m), and NEES by place."""

    rms: float
    horizontal: dict[str, float]
    position: dict[str, float]
    bias: dict[str, float]


def judged(result: Result, truth: Truth) -> Judged:
    """Judge any result, whatever its nodes, whose heading bias is a state of the nodes."""
    assert result.status == "converged", result.reason
    segment = result.segments[0]
    track, bias = segment.trajectory, segment.slow["heading_bias"]
    nodes = {name: round(share * (len(track.t) - 1)) for name, share in PLACES.items()}
    off = track.position - truth.position(track.t)
    turned = (bias.value[:, 0] - truth.heading_bias(bias.t)) / bias.sigma[:, 0]
    return Judged(
        rms(result),
        {n: squared(off[k, :2], track.covariance[k, :2, :2]) for n, k in nodes.items()},
        {n: squared(off[k], track.covariance[k]) for n, k in nodes.items()},
        {n: float(turned[k] ** 2) for n, k in nodes.items()},
    )


def rms(result: Result) -> float:
    """Horizontal rms error against the mission's reference, m."""
    errors = evaluate(result)[""]
    return float(np.sqrt(np.mean(errors.horizontal**2)))


def smoothed(seed: int, *, drawn: bool = False, **options) -> tuple[Result, Truth]:
    """Smooth the mission of a bad heading reference: 2 degrees off at the start, or as drawn.

    By the banded solver unless asked otherwise: it is the faster one.
    """
    fixed = None if drawn else 2.0
    mission, truth = drifting_heading(seed, heading_bias_deg=fixed)
    options = {"solver": "banded", **options}
    return smooth(replace(mission, options=replace(mission.options, **options))), truth


@cache
def consistent_runs(runs: int, **options) -> list[Judged]:
    """Runs whose heading bias is drawn, under the normal distribution's own loss."""
    options = {"loss": "none", **options}
    return [judged(*smoothed(seed, drawn=True, **options)) for seed in range(runs)]


def check_consistency(runs: list[Judged]) -> None:
    """Hold NEES of positions and of the heading bias within two-sided 99.9 % bounds."""
    for place in PLACES:
        assert_consistent([r.horizontal[place] for r in runs], 2, f"{place}, horizontal")
        assert_consistent([r.position[place] for r in runs], 3, f"{place}, position")
        assert_consistent([r.bias[place] for r in runs], 1, f"{place}, heading bias")


# -- which unknowns there are --


def names_of(**options) -> tuple[set[str], set[str]]:
    """Slow and shared states of a mission with these options."""
    layout = problem_of(drifting_heading(1, lines=1, run_in=100.0)[0], **options).layout
    return {name for name, _ in layout.slow}, {name for name, _ in layout.shared}


def problem_of(mission: Mission, **options) -> Problem:
    mission = replace(mission, options=replace(mission.options, **options))
    return build_problem(mission, [model_segment(s, mission.options) for s in mission.segments])


def test_a_bias_that_wanders_travels_with_the_nodes():
    slow, shared = names_of()
    assert "heading_bias" in slow
    assert "heading_bias" not in shared


def test_a_constant_bias_is_shared():
    slow, shared = names_of(heading_bias_walk_deg=0.0)
    assert "heading_bias" not in slow
    assert "heading_bias" in shared


@pytest.mark.parametrize("walk", [0.0, 0.5])
def test_no_bias_no_state(walk: float):
    slow, shared = names_of(heading_bias_sigma_deg=0.0, heading_bias_walk_deg=walk)
    assert "heading_bias" not in slow | shared
    assert "dvl_scale" in shared


def block(problem: Problem, name: str) -> LinearBlock:
    (found,) = (b for b in problem.blocks if b.name == name)
    assert isinstance(found, LinearBlock)
    return found


@pytest.mark.parametrize("walk", [0.0, 0.5])
def test_the_prior_is_the_options_or_the_records(walk: float):
    mission, _ = drifting_heading(1, lines=1, run_in=100.0)
    segment = mission.segments[0]
    segment = replace(segment, attitude=replace(segment.attitude, sigma=np.deg2rad(0.7)))
    mission = replace(mission, segments=(segment,))
    for asked, expected in ((1.5, 1.5), (None, 0.7)):
        options = {"heading_bias_sigma_deg": asked, "heading_bias_walk_deg": walk}
        problem = problem_of(mission, **options)
        prior = block(problem, "heading_bias prior")
        assert prior.matrix.shape == (1, 1, 1)
        sigma = problem.layout.unit("heading_bias") / prior.matrix[0, 0, 0]
        np.testing.assert_allclose(np.rad2deg(sigma), expected)


def test_the_walk_is_that_of_the_options():
    problem = problem_of(drifting_heading(1, lines=1, run_in=100.0)[0])
    walk = block(problem, "heading_bias walk")
    dt = np.diff(problem.layout.chains[0].t)
    strayed = problem.layout.unit("heading_bias") / walk.matrix[:, 0, 1]
    np.testing.assert_allclose(np.rad2deg(strayed), 0.5 * np.sqrt(dt / 3600.0))


# -- the rows --

BIAS = (1e-4, 3e-5)  #: small enough for the first order: rad, and rad/s


def sailing(reference: str, course: float = 0.7) -> Problem:
    """Straight ahead at 1.5 m/s for 40 s, nodes every 8 s, under a bias that grows evenly."""
    t = np.arange(0.0, 40.5, 0.5)
    segment = Segment(
        velocity=Velocity(t, 1.5, 0.0, 0.0, reference=reference),
        attitude=Attitude(t, course + BIAS[0] + BIAS[1] * t),
        start=Start(0.0, 0.0, 0.0),
        two_way_range=two_way_pings(
            lawn_mower([0.0, 0.0], depth=0.0), BEACONS, [1.0, 20.0], Sea(PROFILE),
            np.random.default_rng(0),
        ),
    )  # fmt: skip
    options = replace(DRIFTING, node_spacing=8.0, estimate_current=True)
    return problem_of(Mission((segment,), BEACONS, PROFILE, options=options))


@pytest.mark.parametrize("reference", ["bottom", "water"])
def test_rows_of_a_bias_that_grows_agree_with_quadrature(reference: str):
    """The way is that along the true course, which the rows find from the one that was read."""
    problem = sailing(reference)
    layout, course, current = problem.layout, 0.7, np.array([0.3, -0.2])
    t = layout.chains[0].t
    truth = 1.5 * np.array([np.sin(course), np.cos(course), 0.0])
    drift = np.append(current if reference == "water" else [0.0, 0.0], 0.0)
    x = np.zeros(layout.size)
    layout.put(x, "position", t[:, None] * (truth + drift))
    layout.put(x, "velocity", np.broadcast_to(truth + drift, (len(t), 3)))
    layout.put(x, "heading_bias", (BIAS[0] + BIAS[1] * t)[:, None])
    prefix = ""
    if reference == "water":
        layout.put(x, "current", np.broadcast_to(current, (len(t), 2)))
        prefix = "water "
    for name, sigma in ((f"{prefix}odometry", None), (f"{prefix}velocity", 0.01)):
        rows = block(problem, name)
        residual, _ = rows.evaluate(x)
        assert len(residual) >= 4
        if sigma is not None:
            np.testing.assert_allclose(sigma * residual, 0.0, atol=3e-6)
        else:
            # In metres: the rows of the position at an interval's end are the whitening itself.
            off = np.linalg.solve(rows.matrix[:, :, 3:6], residual[:, :, None])[:, :, 0]
            np.testing.assert_allclose(off, 0.0, atol=2e-5)
    # What the reference alone would have said is off by a thousand times that.
    east = quad(lambda s: 1.5 * np.sin(course + BIAS[0] + BIAS[1] * s), t[3], t[4])[0]
    assert abs(east - 1.5 * np.sin(course) * (t[4] - t[3])) > 5e-3


def test_the_mean_of_a_random_walk_strays_between_its_ends():
    """Noise across the way, walk^2 dt / 12 of the mean: by simulation, and in the rows."""
    walk, dt, steps = 0.3, 8.0, 400
    rng = np.random.default_rng(3)
    path = np.cumsum(walk * np.sqrt(dt / steps) * rng.standard_normal((20_000, steps)), axis=1)
    path = np.concatenate([np.zeros((len(path), 1)), path], axis=1)
    mean = 0.5 * (path[:, :-1] + path[:, 1:]).mean(axis=1)
    strayed = np.var(mean - 0.5 * (path[:, 0] + path[:, -1]))
    assert strayed == pytest.approx(walk**2 * dt / 12.0, rel=0.03)

    problem = problem_of_walk(60.0)
    rows = block(problem, "odometry")
    still = block(problem_of_walk(1e-6), "odometry")
    covariance, white = (np.linalg.inv(b.matrix[:, :, 3:6].swapaxes(1, 2) @ b.matrix[:, :, 3:6])
                         for b in (rows, still))  # fmt: skip
    across = np.array([np.cos(0.7), -np.sin(0.7), 0.0])
    added = (np.deg2rad(60.0) / 60.0) ** 2 * dt / 12.0 * (1.5 * dt) ** 2
    inner = (covariance - white)[1:-2]
    np.testing.assert_allclose(
        inner, np.broadcast_to(added * np.outer(across, across), inner.shape), rtol=1e-3, atol=1e-5
    )


def problem_of_walk(walk_deg: float) -> Problem:
    t = np.arange(0.0, 40.5, 0.5)
    segment = Segment(
        velocity=Velocity(t, 1.5, 0.0, 0.0),
        attitude=Attitude(t, 0.7),
        start=Start(0.0, 0.0, 0.0),
        two_way_range=two_way_pings(
            lawn_mower([0.0, 0.0], depth=0.0), BEACONS, [1.0, 20.0], Sea(PROFILE),
            np.random.default_rng(0),
        ),
    )  # fmt: skip
    options = replace(DRIFTING, node_spacing=8.0, heading_bias_walk_deg=walk_deg)
    return problem_of(Mission((segment,), BEACONS, PROFILE, options=options))


# -- noiseless recovery --


def exact(bias: Callable[[np.ndarray], np.ndarray], **options) -> tuple[Result, Truth]:
    """A mission without noise among three beacons, under a given bias."""
    rng = np.random.default_rng(0)
    truth = lawn_mower([0.0, 0.0], depth=60.0, lines=3, length=150.0, spacing=50.0)
    truth = truth.with_heading_bias(bias)
    end = truth.span[1] - 3.0
    t, sent = np.arange(0.0, end, 0.25), np.arange(1.0, end - 2.0, 3.0)
    segment = Segment(
        two_way_range=two_way_pings(truth, BEACONS, sent, Sea(PROFILE), rng, noise=0.0),
        velocity=dvl(truth, t, rng, noise=0.0),
        attitude=ahrs(truth, t),
        depth=pressure(truth, np.arange(0.0, end), rng, noise=0.0),
        reference=truth.reference(sent),
    )
    base = Options(
        heading_bias_sigma_deg=5.0,
        heading_bias_walk_deg=30.0,
        dvl_misalignment_sigma_deg=0.0,
        dvl_scale_sigma=0.0,
        dvl_bias_sigma=0.0,
        estimate_sound_speed=False,
    )
    options = replace(base, **options)
    return smooth(Mission((segment,), BEACONS, PROFILE, options=options)), truth


def test_a_bias_that_swings_is_followed():
    result, truth = exact(lambda t: 5e-3 * np.sin(t / 60.0))
    assert result.status == "converged"
    bias = result.segments[0].slow["heading_bias"]
    off = bias.value[:, 0] - truth.heading_bias(bias.t)
    assert np.abs(off[5:-5]).max() < 2e-4
    assert rms(result) < 3e-3
    worse, _ = exact(lambda t: 5e-3 * np.sin(t / 60.0), **AT_ITS_WORD)
    assert rms(worse) > 10.0 * rms(result)


def test_banded_and_gtsam_agree_on_it():
    results = [smoothed(1, solver=solver)[0] for solver in ("banded", "gtsam")]
    assert [r.segments[0].solver for r in results] == ["banded", "gtsam"]
    one, two = (r.segments[0] for r in results)
    np.testing.assert_allclose(one.trajectory.position, two.trajectory.position, atol=1e-6)
    found = [s.slow["heading_bias"].value for s in (one, two)]
    np.testing.assert_allclose(*found, atol=1e-9)


# -- what it is good for --


@cache
def together(**options) -> float:
    """Rms over all times of several missions whose AHRS is 2 degrees off and wanders, m."""
    return float(np.sqrt(np.mean([rms(smoothed(seed, **options)[0]) ** 2 for seed in range(4)])))


@pytest.mark.parametrize("node", ["point", "pose3"])
def test_five_times_better_than_the_heading_at_its_word(node: str):
    assert together(**AT_ITS_WORD) > 5.0 * together(node=node)


def test_a_pose_is_as_good_as_a_point_with_a_heading_bias():
    assert together(node="pose3") == pytest.approx(together(node="point"), rel=0.1)


def test_positions_and_bias_are_consistent_over_fifty_runs():
    """Those of poses are in tests/test_pose_consistency.py."""
    check_consistency(consistent_runs(50))


def test_a_constant_bias_does_not_explain_one_that_wanders():
    """The test has teeth: without the walk the covariances are too small."""
    nees = []
    for seed in range(6):
        result, _ = smoothed(seed, drawn=True, loss="none", heading_bias_walk_deg=0.0)
        nees.append(evaluate(result)[""].summary()["interior_mean_nees_2dof"])
    assert np.mean(nees) > 4.0


# -- outputs --


def test_outputs_know_it(tmp_path):
    result, _ = smoothed(1)
    names = {path.name for path in write_result(result, tmp_path / "out")}
    assert {"heading_bias.png", "slow_states.csv"} <= names
    with (tmp_path / "out" / "slow_states.csv").open() as file:
        rows = list(csv.DictReader(file))
    bias = result.segments[0].slow["heading_bias"]
    assert len(rows) == len(bias.t)
    np.testing.assert_allclose(
        [float(r["heading_bias"]) for r in rows], bias.value[:, 0], rtol=1e-6
    )
    np.testing.assert_allclose(
        [float(r["sd_heading_bias"]) for r in rows], bias.sigma[:, 0], rtol=1e-6
    )
    told = json.loads((tmp_path / "out" / "result.json").read_text())
    assert "heading_bias" not in told["shared_states"]
    (first,) = told["segments"][0]["slow_states"]["heading_bias"]["first"]
    assert np.rad2deg(first) == pytest.approx(2.0, abs=1.0)


def test_the_turn_about_a_lone_beacon_is_open_but_for_priors():
    mission, _ = drifting_heading(1)
    found = observability(mission)[""]
    assert found.measured.unobserved == ("the turn about the beacon",)
    assert found.informed.unobserved == ()
    believed = replace(mission, options=replace(mission.options, **AT_ITS_WORD))
    assert observability(believed)[""].measured.unobserved == ()


# -- online --

#: The vehicle has passed the beacon, which tells the bias, and then mows another line; s.
PASSED, ENOUGH = 950.0, 1250.0


@cache
def online(sigma_deg: float) -> tuple[Run, Truth]:
    mission, truth = drifting_heading(1, run_in=1000.0, dvl_interval=1.0)
    options = replace(mission.options, heading_bias_sigma_deg=sigma_deg)
    segment = until(mission.segments[0], ENOUGH)
    return run(replace(mission, options=options), records_of(segment)), truth


def test_online_follows_it_too():
    estimated, truth = online(2.0)
    believed, _ = online(0.0)
    assert estimated.share("ok", PASSED) == 1.0
    errors, wrong = (r.errors(truth, PASSED)[0] for r in (estimated, believed))
    assert len(errors) >= 19
    assert np.sqrt(np.mean(errors**2)) < 0.2 * np.sqrt(np.mean(wrong**2))
    # Errors of one run are one draw; but none is where one in ten thousand would be.
    limit = chi2.ppf(1.0 - 1e-4, 2)
    assert estimated.errors(truth)[1].max() < limit
    assert np.median(believed.errors(truth, PASSED)[1]) > limit
