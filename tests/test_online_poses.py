"""The online estimator on nodes that are poses.

The oracles: the offline smoother on the same grid, the truth of simulated missions (NEES), closed
forms of the prediction, finite differences, and changes of pose multiplied out one by one.
"""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from online import Run, moved, records_of, retimed, run, survey, until, with_options
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from test_online_late import assert_all_count, shuffled

from ubl_graph import (
    AngularRate,
    Attitude,
    Beacon,
    ConfigurationError,
    DataError,
    FixedLagEstimator,
    Heading,
    LeverArm,
    Mission,
    Odometry,
    Options,
    Start,
    Vehicle,
    smooth,
)
from ubl_graph.gtsam_view import GraphView
from ubl_graph.measurements import odometry_covariance
from ubl_graph.mission import Setup
from ubl_graph.odometry_noise import odometry_covariances
from ubl_graph.online.buffer import entry_of
from ubl_graph.online.frame import frame_of
from ubl_graph.online.gate import limit, step_distance
from ubl_graph.online.grid_odometry import on_grid
from ubl_graph.online.json_records import record_content
from ubl_graph.online.pose_state import leap_block, moved_on, poses_of, step_ahead
from ubl_graph.online.window import Window
from ubl_graph.pose_path import Poses
from ubl_graph.problem import Problem
from ubl_graph.records import Records
from ubl_graph.sim import PLANAR, Sea, fixes, planar_vehicle, pose_sensors, sensors
from ubl_graph.trajectory import process_noise

ENGINES = ("lm", "isam2")
NODES = ("pose2", "pose3")
LAG = 30.0
#: A window is full, and its doubts of the beginning are over.
SETTLED = 45.0


def swim(seed: int, **changes) -> tuple[Mission, object]:
    """A minute and a quarter of a survey between beacons: DVL, attitude, depth, pings."""
    sizes = {"node": "pose3", "lag": LAG, "lines": 1, "length": 120.0, "dvl_rate": 2.0}
    return survey(seed, **{**sizes, **changes})


def drive(seed: int, **changes) -> tuple[Mission, object]:
    """Two minutes on the water: odometry, compass, ranges."""
    options = replace(PLANAR, lag=LAG, engine=changes.pop("engine", "lm"))
    return planar_vehicle(seed, options=options, **{"duration": 120.0, **changes})


def stream(mission: Mission) -> list[Records]:
    """Records in order; of those of one time the ranges last."""

    def order(record: Records) -> tuple[float, bool]:
        entry = entry_of(record)
        return entry.t, entry.kind.endswith("_range")

    return sorted(records_of(mission.segments[0]), key=order)


def along(mission: Mission, records: list[Records] | None = None) -> Run:
    kinds = ("two_way_range", "slant_range", "position")
    return run(mission, stream(mission) if records is None else records, at_every=kinds)


def heading_errors(result: Run, truth, after: float) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the heading, rad, and their standard deviations."""
    some = [e for e in result.estimates if e.position is not None and e.t >= after]
    off = np.array([e.attitude[0] - truth.heading(e.t)[0] for e in some])
    sigma = np.array([e.heading_sigma for e in some])
    return np.remainder(off + np.pi, 2.0 * np.pi) - np.pi, sigma


# -- against the smoother --


def assert_near_the_batch(
    mission: Mission, result: Run, times: list[float], *, moving: bool = True
) -> None:
    """Within a tenth of the batch's sigma: position, rotation, velocity, and the sigmas' size.

    Ahead of its last node the batch does not look at the attitude: online it may be known better.
    `moving`: the batch's nodes have velocities to compare with.
    """
    said = {e.t: e for e in result.estimates}
    stamps = np.array(sorted(said))
    for t in times:
        t = float(stamps[stamps <= t][-1])
        part = replace(mission, segments=(until(mission.segments[0], t),))
        part = with_options(part, node_spacing=1.0, solver="banded")
        whole = smooth(part).segments[0].trajectory
        at = whole.at(min(t, whole.t[-1]))
        own, held = said[t], mission.options.node == "pose2"
        ways = 2 if held else 3
        sigma = np.sqrt(np.diagonal(at.covariance[0]))[:ways]
        assert np.abs((own.position - at.position[0])[:ways] / sigma).max() < 0.1
        assert own.position[2] == pytest.approx(at.position[0, 2], abs=0.1)
        speed = np.sqrt(np.diagonal(at.velocity_covariance[0]))[:ways]
        off = np.abs((own.velocity - at.velocity[0])[:ways] / speed).max()
        assert off < 0.1 or not moving
        turn = Rotation.from_matrix(own.rotation @ at.rotation[0].T).as_rotvec()
        turned = np.sqrt(np.diagonal(at.pose_covariance[0])[3:])
        about = [2] if held else [0, 1, 2]
        assert np.abs(turn[about] / turned[about]).max() < 0.1
        told = np.sqrt(np.diagonal(own.pose_covariance))
        assert told[:ways] == pytest.approx(sigma, rel=0.1)
        assert (told[3:][about] < 1.1 * turned[about]).all()
        told = np.sqrt(np.diagonal(own.covariance))[3 : 3 + ways]
        assert (told < 1.1 * speed).all() or not moving


def assert_same_window(mission: Mission, estimator: FixedLagEstimator, share: float) -> None:
    """The window's nodes are the batch's: poses, velocities, and covariances of the poses."""
    window = estimator.window()
    whole = smooth(with_options(mission, node_spacing=1.0, solver="banded"))
    whole = whole.segments[0].trajectory
    # The last two nodes are still to be reached by some sensor.
    times = window.t[:-2]
    own, at = window.at(times), whole.at(times)
    kept = [0, 1, 5] if mission.options.node == "pose2" else list(range(6))
    scale = np.sqrt(np.einsum("kii->ki", at.pose_covariance))[:, kept]
    moved_by = own.position - at.position
    turn = np.einsum("kij,klj->kil", own.rotation, at.rotation)
    gap = np.concatenate([moved_by, Rotation.from_matrix(turn).as_rotvec()], axis=1)[:, kept]
    assert np.abs(gap / scale).max() < share
    spread = np.sqrt(np.einsum("kii->ki", own.pose_covariance))[:, kept]
    assert spread == pytest.approx(scale, rel=0.1)
    assert np.abs(own.velocity - at.velocity).max() < 5e-3


@pytest.mark.parametrize(
    ("engine", "node"),
    [
        ("lm", "pose2"),
        ("lm", "pose3"),
        ("isam2", "pose2"),
        pytest.param("isam2", "pose3", marks=pytest.mark.slow),
    ],
)
def test_a_survey_is_estimated_as_the_smoother_does_on_the_same_grid(engine, node):
    mission, _ = swim(3, node=node, engine=engine)
    result = along(mission)
    assert all(o.accepted for o in result.outcomes)
    assert result.estimator.health()["rebuilds"] == 0
    assert result.share("ok", SETTLED) >= 0.9
    assert_near_the_batch(mission, result, [40.0, 74.0])
    # What GTSAM's smoother let go of it linearised a little elsewhere.
    assert_same_window(mission, result.estimator, 0.1 if engine == "lm" else 0.2)


def test_lever_arms_swing_with_the_pose():
    mission, truth = swim(4)
    arms = Vehicle(
        LeverArm(0.8, 0.3, -0.3), LeverArm(-0.6, 0.1, 0.2), LeverArm(0.5), LeverArm(0.0, 0.0, -1.0)
    )
    rng = np.random.default_rng(4)
    segment = mission.segments[0]
    end, sea = truth.span[1] - 5.0, Sea(mission.sound_speed)
    segment = replace(
        segment,
        two_way_range=sensors.two_way_pings(
            truth, mission.beacons, np.arange(1.0, end - 3.0, 3.0), sea, rng, arm=arms.transducer
        ),
        velocity=sensors.dvl(truth, np.arange(0.0, end, 0.5), rng, arm=arms.dvl),
        depth=sensors.pressure(truth, np.arange(0.0, end), rng, arm=arms.depth_sensor),
        position=fixes(truth, np.arange(0.5, end, 7.0), rng, arm=arms.antenna, sigma=0.5),
    )
    mission = replace(mission, vehicle=arms, segments=(segment,))
    result = along(mission)
    assert all(o.accepted for o in result.outcomes)
    assert_near_the_batch(mission, result, [70.0])


@pytest.mark.parametrize("engine", ["lm", pytest.param("isam2", marks=pytest.mark.slow)])
def test_odometry_and_compass_are_fused_as_the_smoother_does(engine):
    mission, _ = drive(3, engine=engine)
    result = along(mission)
    assert all(o.accepted for o in result.outcomes)
    assert result.share("ok", SETTLED) >= 0.9
    # Odometry that joins all ranges needs no velocities: offline they are those of its last step.
    assert_near_the_batch(mission, result, [60.0, 110.0], moving=False)


def judged(missions) -> tuple[list[float], list[float], list[float]]:
    """Squared distances of positions and headings far enough apart in time, and shares of ok."""
    position, heading, fine = [], [], []
    for mission, truth in missions:
        result = along(mission)
        some = [e for e in result.estimates if e.t >= SETTLED][::6]
        for e in some:
            gap = (e.position - truth.position(e.t)[0])[:2]
            position.append(float(gap @ np.linalg.solve(e.covariance[:2, :2], gap)))
        off, sigma = heading_errors(result, truth, SETTLED)
        heading.append(float((off[-1] / sigma[-1]) ** 2))
        fine.append(result.share("ok", SETTLED))
    return position, heading, fine


def assert_consistent(values: list[float], dof: int) -> None:
    """Below what chance exceeds once in ten thousand, and not next to nothing.

    The turning noise of the prior expects more of a heading between two nodes than a survey does.
    """
    count = len(values)
    assert 0.03 * dof < np.mean(values) < chi2.ppf(0.9999, dof * count) / count


def test_surveys_are_as_sure_as_they_say():
    position, heading, fine = judged(swim(seed, lag=40.0) for seed in range(2))
    assert_consistent(position, 2)
    assert_consistent(heading, 1)
    assert np.mean(fine) >= 0.9


def test_planar_vehicles_are_as_sure_as_they_say():
    position, heading, fine = judged(drive(seed, duration=90.0) for seed in range(2))
    assert_consistent(position, 2)
    assert np.mean(heading) < chi2.ppf(0.9999, 2) / 2
    assert np.mean(fine) >= 0.9


@pytest.mark.slow
@pytest.mark.parametrize("node", NODES)
def test_many_surveys_are_as_sure_as_they_say(node):
    position, heading, fine = judged(swim(seed, lag=40.0, node=node) for seed in range(20))
    assert_consistent(position, 2)
    assert_consistent(heading, 1)
    assert np.mean(fine) >= 0.9


@pytest.mark.slow
@pytest.mark.parametrize("step", [0.4, 1.0])
def test_many_planar_vehicles_are_as_sure_as_they_say(step):
    position, heading, fine = judged(drive(seed, step=step) for seed in range(20))
    assert_consistent(position, 2)
    assert_consistent(heading, 1)
    assert np.mean(fine) >= 0.9


# -- without a heading reference --


def test_gyro_and_dvl_alone_find_the_heading_by_ranges():
    mission, truth = swim(2, node="pose2")
    rng = np.random.default_rng(2)
    rates = pose_sensors.gyro(truth, np.arange(0.0, truth.span[1] - 5.0, 0.5), rng, planar=True)
    segment = replace(mission.segments[0], attitude=None, angular_rate=rates)
    mission = replace(mission, segments=(segment,))
    result = along(mission)
    off, sigma = heading_errors(result, truth, SETTLED)
    assert len(off) > 10
    assert np.abs(off[-1]) < np.deg2rad(3.0)
    assert np.abs(off / sigma).max() < 4.0
    errors, _ = result.errors(truth, SETTLED)
    assert errors.max() < 1.0


def test_fixes_and_a_heading_reference_begin_at_once():
    mission, truth = swim(1)
    rng = np.random.default_rng(1)
    segment = replace(
        mission.segments[0],
        two_way_range=None,
        position=fixes(truth, np.arange(1.0, 60.0, 3.0), rng, sigma=0.5),
    )
    result = along(replace(mission, segments=(segment,)))
    assert result.estimates[0].position is not None
    _, distances = result.errors(truth)
    assert np.mean(distances) < 6.0


def test_a_set_heading_and_odometry_begin_at_once():
    mission, truth = drive(2)
    start = mission.segments[0].start
    segment = replace(mission.segments[0], heading=None, start=None)
    estimator = FixedLagEstimator.of(replace(mission, segments=(segment,)))
    heading = float(truth.heading(0.0)[0])
    outcome = estimator.set_position(
        0.0, start.east, start.north, 0.0, 2.0, heading, np.deg2rad(2.0)
    )
    assert outcome.accepted
    first = estimator.estimate()
    assert np.hypot(*(first.position[:2] - [start.east, start.north])) < 1e-3
    assert first.heading_sigma == pytest.approx(np.deg2rad(2.0), rel=0.01)
    result = run(estimator, stream(replace(mission, segments=(segment,))), ("slant_range",))
    off, sigma = heading_errors(result, truth, 20.0)
    assert np.abs(off / sigma).max() < 4.0


# -- records --


def test_late_records_change_nothing_in_the_end():
    mission, _ = swim(5)
    records = stream(mission)
    ordered = along(mission, records)
    expected = ordered.estimator.estimate(end := entry_of(records[-1]).t + 0.5)
    result = along(mission, shuffled(records, 0, 5.0, 0.3))
    assert_all_count(result)
    got = result.estimator.estimate(end)
    sigma = np.sqrt(np.diagonal(expected.covariance)[:2])
    assert np.abs((got.position - expected.position)[:2] / sigma).max() < 0.1
    assert got.heading_sigma == pytest.approx(expected.heading_sigma, rel=0.05)


def test_late_odometry_and_headings_change_nothing_in_the_end():
    mission, _ = drive(1, step=0.7, duration=80.0)
    records = stream(mission)
    expected = along(mission, records).estimator.estimate(80.0)
    result = along(mission, shuffled(records, 3, 4.0, 0.3))
    assert_all_count(result)
    got = result.estimator.estimate(80.0)
    sigma = np.sqrt(np.diagonal(expected.covariance)[:2])
    assert np.abs((got.position - expected.position)[:2] / sigma).max() < 0.1


def test_records_that_are_wrong_are_gated_and_good_ones_stay():
    mission, truth = swim(1)
    estimator = along(mission).estimator
    t = estimator.estimate().t
    ahead, east = t + 0.2, float(truth.heading(min(t, truth.span[1]))[0])
    before = estimator.estimate(t + 0.1)
    assert not estimator.add(Attitude(ahead, east + np.pi, sigma=0.01)).accepted
    assert estimator.add(Heading(ahead, east)).accepted
    assert not estimator.add(Heading(ahead + 0.1, east + 2.0)).accepted
    assert estimator.add(AngularRate(ahead, about_down=0.0)).accepted
    assert not estimator.add(AngularRate(ahead + 0.1, about_down=5.0)).accepted
    assert estimator.add(Odometry(ahead, ahead + 1.0, 1.5, 0.0)).accepted
    refused = estimator.add(Odometry(ahead + 1.0, ahead + 2.0, 80.0, 0.0))
    assert not refused.accepted
    assert refused.reason.startswith("gated")
    after = estimator.estimate(t + 1.5)
    assert np.hypot(*(after.position - before.position)[:2]) < 5.0


def test_five_headings_that_agree_are_readmitted():
    mission, truth = swim(1)
    estimator = along(mission).estimator
    t = estimator.estimate().t
    heading = float(truth.heading(min(t, truth.span[1]))[0])
    assert estimator.add(Heading(t + 0.1, heading)).accepted
    outcomes = [estimator.add(Heading(t + 0.1 * k, heading + 1.5)) for k in range(2, 8)]
    assert [o.accepted for o in outcomes[:4]] == [False] * 4
    told = [e.kind for o in outcomes for e in o.others]
    assert "readmitted" in told or outcomes[-1].accepted


@pytest.mark.parametrize("kind", ["heading", "angular_rate", "odometry"])
def test_steady_sensors_pass_their_gates(kind):
    mission, truth = swim(3)
    rng, times = np.random.default_rng(3), np.arange(0.0, 80.0, 0.5)
    records = {
        "heading": lambda: pose_sensors.compass(truth, times, rng),
        "angular_rate": lambda: pose_sensors.gyro(truth, times, rng),
        "odometry": lambda: pose_sensors.odometer(truth, times, rng, mission.options),
    }[kind]()
    entries = [entry_of(records[i]) for i in range(len(records))]
    for before, entry in pairwise(entries):
        away, dof = step_distance(entry, before)
        assert away < limit(dof)


def test_what_is_no_record_is_refused_and_changes_nothing():
    mission, _ = swim(1)
    estimator = along(mission).estimator
    before = estimator.estimate(200.0)
    with pytest.raises(DataError, match="heading"):
        Heading(100.0, np.nan)
    with pytest.raises(DataError):
        Odometry(100.0, 99.0, 1.0, 0.0)
    with pytest.raises(ConfigurationError, match="heading"):
        estimator.set_position(100.0, 0.0, 0.0, heading=np.inf)
    after = estimator.estimate(200.0)
    assert np.abs(before.position - after.position).max() < 1e-5
    point = FixedLagEstimator(Options())
    with pytest.raises(DataError, match="point"):
        point.add(Heading(0.0, 0.1))
    with pytest.raises(ConfigurationError, match="point"):
        point.set_position(0.0, 0.0, 0.0, heading=0.1)


# -- jumps, silences, clocks --


def test_a_position_set_far_away_is_believed_with_its_heading():
    mission, truth = drive(1, duration=60.0)
    segment = replace(mission.segments[0], heading=None)
    estimator = along(replace(mission, segments=(segment,))).estimator
    t = float(estimator.estimate().t)
    here = estimator.estimate(t + 0.1)
    turned = float(here.attitude[0]) + 2.0
    outcome = estimator.set_position(
        t, here.position[0] + 300.0, here.position[1] - 200.0, 0.0, 1.0, turned, 0.05
    )
    assert outcome.accepted
    there = estimator.estimate(t + 0.2)
    assert there.status == "rebuilt"
    assert np.hypot(*(there.position - here.position)[:2] - [300.0, -200.0]) < 5.0
    assert abs(np.remainder(there.attitude[0] - turned + np.pi, 2.0 * np.pi) - np.pi) < 0.15
    assert truth is not None


def test_pings_that_contradict_the_track_move_it():
    mission, truth = swim(2)
    begin = 60.0
    records = stream(mission)
    segment = mission.segments[0]
    far = [
        Beacon(b.name, b.position - np.array([60.0, 40.0, 0.0]), turnaround=b.turnaround)
        for b in mission.beacons
    ]
    rng = np.random.default_rng(7)
    sent = segment.two_way_range.t_transmit[segment.two_way_range.t_transmit > begin]
    odd = sensors.two_way_pings(truth, tuple(far), sent, Sea(mission.sound_speed), rng)
    kept = [r for r in records if entry_of(r).kind != "two_way_range" or entry_of(r).t < begin]
    pings = [odd[i] for i in range(len(odd))]
    both = sorted(kept + pings, key=lambda r: entry_of(r).t)
    result = along(mission, both)
    assert "rebuilt" in [e.status for e in result.estimates]
    last = result.estimates[-1]
    gap = last.position - truth.position(last.t)[0] - [60.0, 40.0, 0.0]
    assert np.hypot(*gap[:2]) < 3.0


def test_after_a_long_silence_it_goes_on():
    mission, truth = swim(2)
    records = stream(mission)
    first = [r for r in records if entry_of(r).t < 40.0]
    estimator = FixedLagEstimator.of(mission)
    run(estimator, first)
    ahead = estimator.estimate(100.0)
    # Without any reference a minute lets the heading go anywhere, and the position with it.
    assert ahead.status in ("coasting", "lost")
    assert ahead.heading_sigma > 1.0
    gap = 400.0

    result = run(estimator, [moved(r, gap) for r in records if entry_of(r).t >= 41.0])
    errors, _ = result.errors(truth, gap + 55.0, ahead=gap)
    assert len(errors) > 5
    assert errors.max() < 1.0


def test_a_clock_set_back_is_followed():
    mission, truth = swim(2)
    by = -20.0
    result = run(FixedLagEstimator.of(mission), retimed(stream(mission), by, 50.0))
    assert result.estimator.health()["clock_steps"] == 1
    errors, _ = result.errors(truth, 49.0, "degraded", ahead=by)
    assert len(errors) > 3
    assert errors.max() < 1.0


# -- checkpoints, lines --


@pytest.mark.parametrize("make", [swim, drive], ids=["swim", "drive"])
def test_a_checkpoint_goes_on_where_it_was(make, tmp_path):
    mission, _ = make(1)
    records = stream(mission)
    half = len(records) // 2
    estimator = FixedLagEstimator.of(mission)
    run(estimator, records[:half], at_every=())
    estimator.checkpoint(tmp_path / "state")
    again = FixedLagEstimator.restore(tmp_path / "state")
    for one in (estimator, again):
        run(one, records[half:], at_every=("two_way_range", "slant_range"))
    t = entry_of(records[-1]).t + 0.3
    a, b = estimator.estimate(t), again.estimate(t)
    assert np.abs(a.position - b.position).max() < 1e-6
    assert np.abs(a.rotation - b.rotation).max() < 1e-8
    assert a.pose_covariance == pytest.approx(b.pose_covariance, rel=1e-5, abs=1e-12)
    estimator.checkpoint(tmp_path / "state")
    last = FixedLagEstimator.restore(tmp_path / "state").estimate(t + 1.0)
    assert np.abs(estimator.estimate(t + 1.0).position - last.position).max() < 1e-9


CONFIG = """
[mission]
name = "boat"
[[beacon]]
name = "B1"
position = { east = -90, north = 60, up = 0 }
[[beacon]]
name = "B2"
position = { east = 110, north = 40, up = 0 }
[[beacon]]
name = "B3"
position = { east = 10, north = -120, up = 0 }
[sound_speed]
constant = 1500
[options]
node = "pose2"
lag = 30.0
"""


def test_the_process_speaks_of_headings(tmp_path):
    mission, truth = drive(1, duration=40.0)
    (tmp_path / "boat.toml").write_text(CONFIG)
    heading = float(np.rad2deg(truth.heading(0.0)[0]))
    east, north, _ = truth.position(0.0)[0]
    start = {
        "type": "set_position", "t": 0.0, "east": east, "north": north, "sigma": 1.0,
        "heading": heading, "heading_sigma": 3.0,
    }  # fmt: skip
    content = [start, *(record_content(r) for r in stream(mission))]
    bad = [
        {"type": "heading", "t": 40.0, "heading": 800.0},
        {**start, "t": 40.0, "heading": 800.0},
        {"type": "set_position", "t": 40.0, "east": 0, "north": 0, "heading_sigma": 3.0},
    ]
    lines = "".join(json.dumps(c) + "\n" for c in [*content, *bad])
    done = subprocess.run(
        [sys.executable, "-m", "ubl_graph", "live", "boat.toml"],
        input=lines.encode(),
        capture_output=True,
        cwd=tmp_path,
        timeout=60,
        check=True,
    )
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    estimates = [a for a in answers if a["type"] == "estimate"]
    assert len(estimates) == 1 + len(mission.segments[0].slant_range)
    assert estimates[0]["heading"] == pytest.approx(heading % 360.0, abs=1e-2)
    assert estimates[0]["heading_sigma"] == pytest.approx(3.0, rel=1e-3)
    last = estimates[-1]
    assert len(last["pose_covariance"]) == 36
    off = last["heading"] - float(np.rad2deg(truth.heading(last["t"])[0]))
    assert abs(np.remainder(off + 180.0, 360.0) - 180.0) < 4.0 * last["heading_sigma"]
    assert last["up"] == last["pitch"] == last["roll"] == 0.0
    rejected = [a["reason"] for a in answers if a["type"] == "rejected"]
    assert len(rejected) == 3
    assert all("heading" in reason for reason in rejected)


def test_estimates_of_points_say_nothing_of_headings():
    mission, _ = swim(1, node="point")
    estimate = along(mission, stream(mission)[:200]).estimates[-1]
    assert (estimate.rotation, estimate.attitude, estimate.heading_sigma) == (None, None, None)
    assert estimate.pose_covariance is None


@pytest.mark.parametrize("engine", ENGINES)
def test_slant_ranges_are_pings_of_points_too(engine):
    mission, truth = swim(2, node="point", engine=engine)
    segment = mission.segments[0]
    rng = np.random.default_rng(5)
    sent = segment.two_way_range.t_transmit
    ranges = sensors.slant_ranges(truth, mission.beacons, sent, rng, sigma=0.2)
    segment = replace(segment, two_way_range=None, slant_range=ranges)
    result = along(replace(mission, segments=(segment,)))
    assert all(o.accepted for o in result.outcomes)
    errors, distances = result.errors(truth, SETTLED)
    assert np.sqrt(np.mean(errors**2)) < 0.3
    assert np.mean(distances) < 6.0


# -- the parts --


def test_odometry_on_nodes_stays_as_it_is():
    mission, _ = drive(1)
    records = mission.segments[0].odometry
    laid = on_grid([records], np.arange(0.0, 119.5), PLANAR)
    assert len(laid) == len(records)
    assert np.abs(laid.translation - records.translation).max() < 1e-14
    assert np.abs(laid.rotation_vector - records.rotation_vector).max() < 1e-14
    assert np.array_equal(laid.covariances_flu, odometry_covariances(records, PLANAR))


def test_odometry_within_an_interval_is_multiplied_out_with_its_noise():
    rng = np.random.default_rng(0)
    ends = np.array([0.0, 0.3, 0.55, 1.0])
    ways, turns = rng.normal(0.5, 0.2, (3, 3)), 0.3 * rng.standard_normal((3, 3))
    covariance = odometry_covariance(0.02, 0.01, 3)[0]
    records = Odometry(ends[:-1], ends[1:], *ways.T, *turns.T, covariance)
    laid = on_grid([records], np.array([0.0, 1.0]), Options(node="pose3"))
    signs = np.array([1.0, -1.0, -1.0])

    def chained(noise: np.ndarray) -> np.ndarray:
        pose = np.eye(4)
        for way, turn, off in zip(ways, turns, noise.reshape(3, 6), strict=True):
            step, error = np.eye(4), np.eye(4)
            step[:3, :3] = Rotation.from_rotvec(turn * signs).as_matrix()
            step[:3, 3] = way * signs
            error[:3, :3] = Rotation.from_rotvec(off[3:]).as_matrix()
            error[:3, 3] = off[:3]
            pose = pose @ step @ error
        return pose

    whole = chained(np.zeros(18))
    assert np.abs(laid.translation[0] - whole[:3, 3]).max() < 1e-12
    turned = Rotation.from_rotvec(laid.rotation_vector[0]).as_matrix()
    assert np.abs(turned - whole[:3, :3]).max() < 1e-12
    slopes = np.empty((6, 18))
    for i in range(18):
        ahead, back = (np.linalg.inv(whole) @ chained(s * 1e-6 * np.eye(18)[i]) for s in (1, -1))
        slopes[:3, i] = (ahead[:3, 3] - back[:3, 3]) / 2e-6
        skew = (ahead[:3, :3] - back[:3, :3]) / 2e-6
        slopes[3:, i] = skew[2, 1], skew[0, 2], skew[1, 0]
    flip = np.tile(signs, 2)
    flu = covariance * np.outer(flip, flip)
    expected = slopes @ np.kron(np.eye(3), flu) @ slopes.T
    assert laid.covariances_flu[0] == pytest.approx(expected, abs=1e-9)


def test_odometry_over_a_node_is_cut_and_gaps_are_left_out():
    turn = 0.4
    steps = Odometry([0.5, 2.5, 5.2], [2.5, 4.0, 6.0], [2.0, 1.5, 0.8], 0.0, about_down=turn)
    laid = on_grid([steps], np.arange(0.0, 8.0), Options(node="pose2"))
    # The first interval, and those that the gap from 4.0 to 5.2 touches, are not covered.
    assert laid.t_from.tolist() == [1.0, 2.0, 3.0]
    assert laid.rotation_vector[:, 2] == pytest.approx(
        [-turn / 2, -turn / 4 - turn / 3, -turn / 1.5]
    )
    assert on_grid([], np.arange(3.0), Options()) is None
    assert on_grid([steps], np.array([4.0, 5.0]), Options()) is None


def pose_frame(node: str = "pose3", **options):
    setup = Setup(options=Options(node=node, **options))
    return frame_of(setup, set(), 0.0, 1.0, 1.0)


def test_a_pose_ahead_grows_as_its_errors_and_the_prior_say():
    frame = pose_frame()
    twist, dt = np.array([1.2, -0.3, 0.1, 0.05, -0.2, 0.4]), 1.7
    eye = np.eye(3)[None]
    node = Poses(np.zeros((1, 3)), eye, eye, twist[None])
    carry, noise = step_ahead(frame, twist, dt)
    whole = moved_on(node, np.array([dt]))

    def local(change: np.ndarray) -> np.ndarray:
        """Where a changed node ends, seen from where the unchanged one does."""
        turn = Rotation.from_rotvec(change[3:6]).as_matrix()
        changed = Poses(change[None, :3], turn[None], eye, (twist + change[6:])[None])
        there = moved_on(changed, np.array([dt]))
        back = whole.rotation[0].T
        off = Rotation.from_matrix(back @ there.rotation[0]).as_rotvec()
        moved = back @ (there.position - whole.position)[0]
        return np.concatenate([moved, off, (there.twist - whole.twist)[0]])

    step = 1e-6
    slopes = [(local(step * e) - local(-step * e)) / (2.0 * step) for e in np.eye(12)]
    assert np.abs(np.stack(slopes, axis=1) - carry).max() < 1e-7
    assert np.linalg.eigvalsh(noise)[0] > 0.0
    # Without turning the prior's noise is that of points.
    _, straight = step_ahead(frame, np.zeros(6), dt)
    psd = np.repeat([frame.setup.options.horizontal_psd, 1e-3], 3)
    assert straight == pytest.approx(np.kron(process_noise(2, dt)[0], np.diag(psd)))


@pytest.mark.parametrize("node", NODES)
def test_a_leap_is_the_motion_prior_where_that_holds(node):
    frame = pose_frame(node)
    width = frame.width
    rng = np.random.default_rng(1)
    first = 0.3 * rng.standard_normal(width)
    window = Window(frame, FixedLagEstimator(Options(node=node)).core.tracker.buffer, 0)
    dt = 2.0
    nodes = np.stack([first, window.predicted(first, np.array([dt]))[0]])
    block = leap_block(frame, nodes, np.zeros(2), dt)
    layout = frame.layout(np.array([0.0, dt]))
    (motion,) = [b for b in frame.builder(layout).silent_blocks(layout.chains[0]) if not b.linear]
    x = np.concatenate([nodes.ravel(), np.zeros(frame.border)])
    _, theirs = motion.evaluate(x)
    own = block.matrix[0]
    # The same information, whatever square root of it.
    assert own.T @ own == pytest.approx(theirs[0].T @ theirs[0], rel=1e-6, abs=1e-6)
    r, _ = block.evaluate(x)
    assert np.abs(r).max() < 1e-9


def test_predicted_rotations_are_at_most_half_a_turn():
    frame = pose_frame()
    window = Window(frame, FixedLagEstimator(Options(node="pose3")).core.tracker.buffer, 0)
    node = np.zeros(frame.width)
    node[3:6], node[9:12] = [0.0, 0.0, 3.0], [0.0, 0.0, 0.2]
    ahead = window.predicted(node, np.arange(1.0, 60.0))
    assert np.linalg.norm(ahead[:, 3:6], axis=1).max() <= np.pi + 1e-12
    turned = poses_of(frame, ahead, np.zeros(59)).rotation
    yaw = np.arctan2(turned[:, 1, 0], turned[:, 0, 0])
    expected = 3.0 + 0.2 * np.arange(1.0, 60.0)
    assert np.abs(np.exp(1j * yaw) - np.exp(1j * expected)).max() < 1e-12


def test_the_window_and_the_newest_estimate_agree():
    mission, _ = swim(2)
    estimator = along(mission).estimator
    window = estimator.window()
    for t in (window.t[-1], window.t[-1] - 0.4):
        tracker = estimator.core.tracker
        moment, states = tracker.moment(float(t)), window.at(t)
        assert np.abs(moment.mean[:3] - states.position[0]).max() < 1e-9
        assert np.abs(moment.mean[3:] - states.velocity[0]).max() < 1e-9
        assert np.abs(moment.rotation - states.rotation[0]).max() < 1e-9
        assert moment.pose_covariance == pytest.approx(states.pose_covariance[0], abs=1e-9)
        assert moment.covariance[:3, :3] == pytest.approx(states.covariance[0], abs=1e-9)
        assert moment.covariance[3:, 3:] == pytest.approx(states.velocity_covariance[0], abs=1e-9)


@pytest.mark.parametrize("node", NODES)
def test_gtsam_holds_charts_as_plain_vectors(node):
    mission, _ = swim(2, node=node)
    tracker = along(mission, stream(mission)[:160]).estimator.core.tracker
    window = tracker.window
    blocks = [
        *window.ranges(window.usable()),
        window.prior_row(),
        window.interval_row(window.first),
    ]
    problem = Problem(window.layout, tuple(blocks), window.loss, (1.0, 1.0))
    view = GraphView(problem, charts=True)
    x = window.vector
    frozen = tuple(b.frozen(x) for b in blocks)
    assert np.array_equal(view.vector(view.values(x)), x)
    total = 0.0
    for block, held in zip(blocks, frozen, strict=True):
        r, _ = block.evaluate(x, held, jacobian=False)
        total += float(window.loss.cost(r).sum()) if block.robust else 0.5 * float((r**2).sum())
    assert view.graph(frozen).error(view.values(x)) == pytest.approx(total, rel=1e-9)


def test_start_with_a_heading_goes_through_the_configuration():
    start = Start(0.0, 1.0, 2.0, 0.0, 1.0, heading=1.0, heading_sigma=0.05)
    estimator = FixedLagEstimator(Options(node="pose2"), start=start)
    estimator.add(Odometry(0.0, 1.0, 1.0, 0.0))
    estimate = estimator.estimate(1.0)
    assert estimate.attitude[0] == pytest.approx(1.0, abs=1e-4)
    ahead = np.array([np.sin(1.0), np.cos(1.0)])
    assert estimate.position[:2] == pytest.approx(np.array([1.0, 2.0]) + ahead, abs=0.05)
