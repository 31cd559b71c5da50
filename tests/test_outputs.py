"""Result files and figures: what they hold, and that figures show it."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from ubl_graph import (
    Attitude,
    Beacon,
    Mission,
    Odometry,
    Options,
    Segment,
    SlantRange,
    SoundSpeedProfile,
    Start,
    lie,
    smooth,
)
from ubl_graph.errors import ConfigurationError, DataError, TimeError
from ubl_graph.evaluation import Errors, errors_of, evaluate
from ubl_graph.io import result_files
from ubl_graph.io.result_files import summary, write_result
from ubl_graph.mission import Reference
from ubl_graph.plots import errors, heading, residuals, slow_state, track
from ubl_graph.pose_trajectory import mariners_angles, mariners_slopes
from ubl_graph.result import Result
from ubl_graph.sim import straight_pass
from ubl_graph.trajectory import Trajectory


@pytest.fixture(scope="module")
def result() -> Result:
    """Two segments of one mission, the second half an hour after the first."""
    mission, _ = straight_pass(seed=1)
    first = replace(mission.segments[0], name="A")

    def later(records):
        changes = {
            n: getattr(records, n) + 1800.0
            for n in ("t", "t_transmit", "t_receive")
            if hasattr(records, n)
        }
        return replace(records, **changes)

    second = replace(
        first,
        name="B",
        two_way_range=later(first.two_way_range),
        depth=later(first.depth),
        reference=Reference(first.reference.t + 1800.0, first.reference.position),
    )
    return smooth(replace(mission, segments=(first, second)))


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def test_trajectory_file_holds_the_nodes(tmp_path, result):
    write_result(result, tmp_path / "out", figures=False)
    rows = rows_of(tmp_path / "out" / "trajectory.csv")
    assert [r["segment"] for r in rows] == [s.name for s in result.segments for _ in s.trajectory.t]
    np.testing.assert_array_equal([float(r["t"]) for r in rows], result.trajectory.t)
    for names, values in (
        (("east", "north", "up"), result.trajectory.position),
        (("v_east", "v_north", "v_up"), result.trajectory.velocity),
        (
            ("sd_east", "sd_north", "sd_up"),
            np.sqrt(np.einsum("nii->ni", result.trajectory.covariance)),
        ),
    ):
        written = [[float(r[n]) for n in names] for r in rows]
        np.testing.assert_allclose(written, values, atol=6e-7)
    written = [float(r["cov_east_north"]) for r in rows]
    np.testing.assert_allclose(written, result.trajectory.covariance[:, 0, 1], atol=6e-7)


def test_residual_file_has_one_row_a_ping(tmp_path, result):
    write_result(result, tmp_path, figures=False)
    rows = rows_of(tmp_path / "residuals.csv")
    table = result.residuals
    assert table is not None
    assert [r["beacon"] for r in rows] == [str(b) for b in table.beacon]
    np.testing.assert_allclose([float(r["residual"]) for r in rows], table.residual, atol=1e-9)
    assert {r["direct_ray"] for r in rows} == {"yes"}


def test_result_file_is_strict_json_with_what_it_should_say(tmp_path, result):
    write_result(result, tmp_path, figures=False)
    text = (tmp_path / "result.json").read_text()
    content = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert content["status"] == "converged" and content["reason"] == ""
    assert content["cost"] == pytest.approx(sum(s.cost for s in result.segments))
    assert sum(b["used"] for b in content["pings"].values()) == len(result.residuals)
    assert set(content["versions"]) == {"python", "ubl-graph", "gtsam", "numpy", "scipy"}
    assert set(content["wall_times_s"]) == {"model", "start", "solve", "covariance"}
    compared = Errors.joined(evaluate(result).values()).summary()
    assert content["reference"] == pytest.approx(compared)
    assert [s["name"] for s in content["segments"]] == ["A", "B"]
    resolved = json.loads((tmp_path / "mission.json").read_text())
    assert resolved["options"]["acceleration_psd"] == Options().acceleration_psd


def test_shared_unknowns_make_one_problem(result):
    options = replace(result.mission.options, estimate_beacons=True)
    beacons = tuple(replace(b, sigma=1.0) for b in result.mission.beacons)
    joint = smooth(replace(result.mission, options=options, beacons=beacons))
    assert {s.problem for s in joint.segments} == {0}
    assert summary(joint)["cost"] == pytest.approx(joint.segments[0].cost)
    for beacon in beacons:
        found = joint.beacons[beacon.name]
        assert (found.sigma > 0.0).all() and (found.sigma < 1.01).all()
        assert np.linalg.norm(found.value - beacon.position) < 3.0 * np.linalg.norm(found.sigma)


def test_a_failure_while_writing_leaves_nothing(tmp_path, result, monkeypatch):
    def broken(_):
        raise RuntimeError("disk on fire")

    monkeypatch.setattr(result_files, "resolved", broken)
    with pytest.raises(RuntimeError, match="disk on fire"):
        write_result(result, tmp_path / "out", figures=False)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_a_data_error(tmp_path, result):
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="output"):
        write_result(result, tmp_path / "file" / "out", figures=False)


@pytest.mark.parametrize(
    "draw",
    [track, residuals, errors, lambda r: slow_state(r, "sound_speed")],
    ids=["track", "residuals", "errors", "slow state"],
)
def test_figures_have_labels_and_ink(result, draw):
    figure = draw(result)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = np.asarray(canvas.buffer_rgba())[..., :3]
    assert (picture < 250).any(axis=2).mean() > 0.01
    for axes in figure.axes:
        assert axes.get_ylabel()
        assert axes.lines
        drawn = np.concatenate([np.asarray(line.get_ydata(), dtype=float) for line in axes.lines])
        assert np.isfinite(drawn).all()
    assert any(axes.get_xlabel() for axes in figure.axes)


def test_trajectory_is_asked_over_all_segments(result):
    times = np.array([5.0, 1805.0, 20.0])
    states = result.trajectory.at(times)
    for i, name in enumerate("ABA"):
        one = result.trajectory[name].at(times[i])
        np.testing.assert_array_equal(states.position[i], one.position[0])
        np.testing.assert_array_equal(states.covariance[i], one.covariance[0])
    with pytest.raises(TimeError, match="no segment"):
        result.trajectory.at(1000.0)
    with pytest.raises(ConfigurationError, match="known: 'A', 'B'"):
        _ = result.trajectory["C"]


def test_errors_are_written_out_by_hand():
    """Two metres east of a line whose east is known to one metre: NEES 4."""
    t = np.array([0.0, 100.0])
    position = np.array([[2.0, 0.0, 0.0], [2.0, 100.0, 0.0]])
    covariance = np.tile(np.diag([1.0, 4.0, 1.0]), (2, 1, 1))
    psd = (1e-30, 1e-30)
    line = Trajectory(t, position, np.tile([0.0, 1.0, 0.0], (2, 1)), None, covariance, psd)
    times = np.array([-5.0, 10.0, 50.0, 90.0, 100.0])
    truth = np.stack([0 * times, times, 0 * times], axis=1)
    found = errors_of(line, Reference(times, truth))
    np.testing.assert_array_equal(found.t, times[1:])
    np.testing.assert_allclose(found.horizontal, 2.0)
    np.testing.assert_allclose(found.nees, 4.0)
    np.testing.assert_array_equal(found.interior, [False, True, False, False])
    assert found.summary()["interior_count"] == 1


def test_what_should_stop_a_user_is_a_warning(result):
    """Half of the pings nonsense: more than outliers; with no loss the chi-square says it."""
    segment = result.mission.segments[0]
    pings = segment.two_way_range
    rng = np.random.default_rng(0)
    nonsense = rng.uniform(-0.03, 0.03, len(pings)) * (rng.random(len(pings)) < 0.5)
    wrong = pings.travel_time + nonsense
    pings = replace(pings, travel_time=wrong, t_receive=pings.t_receive + 0.05)
    spoilt = replace(segment, two_way_range=pings)
    for loss, said in (("cauchy", "down-weighted"), ("none", "chi-square")):
        options = replace(result.mission.options, loss=loss)
        found = smooth(replace(result.mission, segments=(spoilt,), options=options))
        assert any(said in w for w in found.warnings), (loss, found.warnings)


def test_a_profile_that_ends_far_above_the_beacons_is_said(result):
    mission = result.mission
    deepest = max(-b.position[2] for b in mission.beacons)
    short = SoundSpeedProfile([0.0, 0.5 * deepest], [1500.0, 1499.0])
    one = replace(mission, sound_speed=short, segments=mission.segments[:1])
    assert any("profile ends at" in w for w in smooth(one).warnings)
    long = SoundSpeedProfile([0.0, 0.95 * deepest], [1500.0, 1499.0])
    assert not any("profile" in w for w in smooth(replace(one, sound_speed=long)).warnings)


# -- poses --

SITES = (Beacon("L0", [0.0, 80.0, 0.0]), Beacon("L1", [60.0, -20.0, 0.0]))
#: A third of a circle, 1 m and 3 degrees a step, and how far from the beacons.
STEPS, TURN = 40, np.deg2rad(3.0)


def drive(**options) -> Result:
    """A car on a plane: odometry that joins all, ranges to two beacons, a known start."""
    t = np.arange(STEPS + 1.0)
    yaw = TURN * t
    step = np.stack([np.cos(yaw[:-1]), np.sin(yaw[:-1])], axis=1)
    place = np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)])
    rng = np.random.default_rng(4)
    names = np.array([b.name for b in SITES])[np.arange(STEPS) % 2]
    site = np.array([b.position[:2] for b in SITES])[np.arange(STEPS) % 2]
    distance = np.linalg.norm(place[1:] - site, axis=1) + rng.normal(0.0, 0.3, STEPS)
    distance[7] += 40.0
    given = options.pop("covariance", True)
    covariance = np.tile(np.diag([1e-4, 1e-4, 1e-6]), (STEPS, 1, 1)) if given else None
    segment = Segment(
        odometry=Odometry(t[:-1], t[1:], 1.0, 0.0, about_down=-TURN, covariance=covariance),
        slant_range=SlantRange(t[1:], names, distance, 0.3),
        start=Start(0.0, 0.0, 0.0, sigma=1.0, heading=np.pi / 2),
    )
    base = {"node": "pose2", "estimate_sound_speed": False}
    options = Options(**{**base, **options})
    return smooth(Mission((segment,), SITES, SoundSpeedProfile.constant(1500.0), options=options))


@pytest.fixture(scope="module")
def driven() -> Result:
    return drive()


@pytest.fixture(scope="module")
def dived() -> Result:
    """Poses in space, with velocities and an attitude reference."""
    mission, _ = straight_pass(seed=2)
    segment = mission.segments[0]
    t = np.arange(0.0, segment.two_way_range.t_receive.max(), 1.0)
    read = Attitude(t, 0.4, 0.05, -0.03, sigma=0.02)
    options = replace(mission.options, node="pose3")
    return smooth(replace(mission, segments=(replace(segment, attitude=read),), options=options))


def test_slopes_of_the_mariners_angles_by_differences():
    rotation = lie.rotation(np.random.default_rng(0).normal(size=(100, 3)))
    slopes = mariners_slopes(rotation)
    for axis in range(3):
        turn = np.zeros((1, 3))
        turn[0, axis] = 1e-6
        ahead, behind = (mariners_angles(lie.rotation(s * turn) @ rotation) for s in (1.0, -1.0))
        change = np.angle(np.exp(1j * (ahead - behind))) / 2e-6
        np.testing.assert_allclose(slopes[:, :, axis], change, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("mission", ["driven", "dived"])
def test_trajectory_file_of_poses(tmp_path, request, mission):
    result = request.getfixturevalue(mission)
    write_result(result, tmp_path, figures=False)
    rows = rows_of(tmp_path / "trajectory.csv")
    found = result.segments[0].trajectory
    assert list(rows[0])[:12] == list(result_files.TRAJECTORY_COLUMNS)
    names = ("heading_deg", "pitch_deg", "roll_deg")
    written = np.deg2rad([[float(r[n]) for n in names] for r in rows])
    np.testing.assert_allclose(written, found.attitude, atol=1e-7)
    sd = np.deg2rad([[float(r[f"sd_{n}"]) for n in names] for r in rows])
    np.testing.assert_allclose(sd, found.attitude_sigma, atol=1e-7)
    # A level vehicle's heading is as sure as its turn about up.
    about_up = np.sqrt(found.pose_covariance[:, 5, 5])
    np.testing.assert_allclose(sd[:, 0], about_up, rtol=0.01 if mission == "dived" else 1e-4)
    if mission == "driven":
        expected = np.pi / 2 - TURN * np.arange(STEPS + 1)
        off = np.angle(np.exp(1j * (written[:, 0] - expected)))
        assert np.abs(off).max() < 4.0 * sd[:, 0].max()
        assert not written[:, 1:].any() and not sd[:, 1:].any()


@pytest.mark.parametrize("mission", ["driven", "dived"])
def test_pose_covariance_file(tmp_path, request, mission):
    """Upper triangles: positions as in trajectory.csv, symmetric, never negative."""
    result = request.getfixturevalue(mission)
    write_result(result, tmp_path, figures=False)
    rows = rows_of(tmp_path / "pose_covariance.csv")
    track = result.segments[0].trajectory
    assert [float(r["t"]) for r in rows] == track.t.tolist()
    names = list(rows[0])[2:]
    assert len(names) == 21
    assert names[:2] == ["cov_east_east", "cov_east_north"]
    assert names[-1] == "cov_about_up_about_up"
    assert names[6] == "cov_north_north" and names[5] == "cov_east_about_up"
    i, j = np.triu_indices(6)
    whole = np.zeros((len(rows), 6, 6))
    whole[:, i, j] = [[float(r[n]) for n in names] for r in rows]
    whole[:, j, i] = whole[:, i, j]
    np.testing.assert_allclose(whole[:, :3, :3], track.covariance, rtol=1e-8, atol=1e-15)
    np.testing.assert_allclose(whole, track.pose_covariance, rtol=1e-8, atol=1e-15)
    values = np.linalg.eigvalsh(whole)
    assert (values > -1e-9 * values[:, -1:]).all()


def test_result_file_of_poses(tmp_path, driven):
    write_result(driven, tmp_path, figures=False)
    told = json.loads((tmp_path / "result.json").read_text())
    assert told["node"] == "pose2"
    (segment,) = told["segments"]
    assert segment["odometry_noise"] == "given"
    assert segment["runner_up"] == driven.segments[0].runner_up
    assert 0.0 < segment["median_sd_heading_deg"] < 10.0
    assert set(told["shared_states"]) == {"odometry_scale", "odometry_turn_bias"}
    options = json.loads((tmp_path / "mission.json").read_text())["options"]
    assert options["node"] == "pose2" and options["odometry_way_noise"] == 0.02
    start = json.loads((tmp_path / "mission.json").read_text())["segments"][0]["start"]
    assert start["heading_deg"] == pytest.approx(90.0)
    assert start["heading_sigma_deg"] == pytest.approx(np.rad2deg(0.1))


@pytest.mark.parametrize(
    ("given", "asked", "said"),
    [(True, "both", "both"), (True, "growing", "growing"), (False, "given", "growing")],
)
def test_result_file_says_which_noise_odometry_was_given(given, asked, said):
    result = drive(covariance=given, odometry_noise=asked)
    assert summary(result)["segments"][0]["odometry_noise"] == said


def test_points_say_nothing_of_poses(tmp_path, result):
    write_result(result, tmp_path, figures=False)
    assert not (tmp_path / "pose_covariance.csv").exists()
    assert list(rows_of(tmp_path / "trajectory.csv")[0]) == list(result_files.TRAJECTORY_COLUMNS)
    told = json.loads((tmp_path / "result.json").read_text())
    assert told["node"] == "point"
    assert not {"odometry_noise", "median_sd_heading_deg"} & set(told["segments"][0])


def test_what_is_no_number_is_an_empty_field(tmp_path, driven):
    """A reader takes it as missing; "nan" and "inf" it may not understand."""
    segment = driven.segments[0]
    motion = segment.trajectory.motion
    node = motion.node.copy()
    node[3] = np.nan
    covariance = segment.trajectory.covariance.copy()
    covariance[3] = np.inf
    spoilt = replace(segment.trajectory, motion=replace(motion, node=node), covariance=covariance)
    write_result(
        replace(driven, segments=(replace(segment, trajectory=spoilt),)), tmp_path, figures=False
    )
    for name, empty in (("trajectory.csv", 7), ("pose_covariance.csv", 21)):
        rows = rows_of(tmp_path / name)
        assert sum(not value for k, value in rows[3].items() if k != "segment") == empty
        for row in rows[:3] + rows[4:]:
            assert all(np.isfinite(float(v)) for k, v in row.items() if k != "segment")


def test_figures_of_poses(driven, dived):
    for result, panels in ((driven, 2), (dived, 3)):
        figure = heading(result)
        FigureCanvasAgg(figure).draw()
        assert len(figure.axes) == panels
        for axes in figure.axes:
            assert axes.get_ylabel() and axes.lines
            drawn = np.concatenate([np.asarray(x.get_ydata(), dtype=float) for x in axes.lines])
            assert np.isfinite(drawn).all()
            low, high = axes.get_ylim()
            assert ((drawn >= low) & (drawn <= high)).all()


def test_a_heading_that_passes_north_is_drawn_in_pieces():
    """No line joins 359 degrees with 1."""
    result = drive()
    angle = np.rad2deg(result.segments[0].trajectory.attitude[:, 0])
    assert np.abs(np.diff(angle)).max() > 180.0
    lines = heading(result).axes[0].lines
    assert len(lines) == 2
    for line in lines:
        assert np.abs(np.diff(line.get_ydata())).max() < 10.0


def test_slant_ranges_are_drawn_in_metres_and_far_ones_at_the_edge(driven):
    figure = residuals(driven)
    assert {axes.get_ylabel() for axes in figure.axes} == {"model - range, m"}
    assert figure.axes[-1].get_xlabel() == "t, number of the pose"
    table = driven.residuals
    far = np.abs(table.residual).max() * 1500.0
    assert far == pytest.approx(40.0, abs=2.0)
    marks = [line for axes in figure.axes for line in axes.lines]
    edges = [line for line in marks if line.get_label() == "beyond the axis"]
    assert sum(len(line.get_ydata()) for line in edges) == 1
    assert all(axes.get_ylim()[1] < 0.5 * far for axes in figure.axes)
    drawn = sum(len(m.get_ydata()) for m in marks if m.get_label() in ("used", "down-weighted"))
    assert drawn == len(table) - 1


def test_the_scale_of_slant_ranges_is_drawn_as_their_own():
    result = drive(estimate_sound_speed=True, sound_speed_sigma=0.05)
    (axes,) = slow_state(result, "sound_speed").axes
    assert axes.get_ylabel() == "ranges too long by, %"
    state = result.segments[0].slow["sound_speed"]
    drawn = axes.lines[0].get_ydata()
    np.testing.assert_allclose(drawn, 100.0 * (np.exp(state.value[:, 0]) - 1.0))


def test_ellipses_that_would_hide_the_map_are_left_out(result):
    def ellipses(covariance: np.ndarray) -> int:
        track_of = result.segments[0].trajectory
        whole = np.broadcast_to(covariance, track_of.covariance.shape)
        segment = replace(result.segments[0], trajectory=replace(track_of, covariance=whole))
        return len(track(replace(result, segments=(segment,))).get_axes()[0].patches)

    # A known point, a direction that is open, and nothing known at all.
    assert ellipses(np.diag([1.0, 1.0, 1.0])) == ellipses(np.diag([1e10, 1.0, 1.0])) == 25
    assert ellipses(np.diag([1e10, 1e10, 1.0])) == 0
