"""PyFG files as missions: what becomes what, in whose axes, and what a mission cannot take."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
import pytest

from ubl_graph.errors import ConfigurationError, DataError
from ubl_graph.io.mission_file import load_mission
from ubl_graph.io.pyfg import TOKENS, PyfgGraph, read_pyfg, write_pyfg
from ubl_graph.io.pyfg_graph import PointRows, PoseRows, RangeRows
from ubl_graph.io.pyfg_mission import pyfg_segments
from ubl_graph.io.pyfg_records import reversed_edges
from ubl_graph.mission import Mission

DOCS = Path(__file__).resolve().parents[1] / "docs"
DATA = '[data]\nformat = "pyfg"\nfile = "graph.pyfg"\n'
EYE3, EYE6 = "1 0 0 1 0 1", " ".join(map(str, np.eye(6)[np.triu_indices(6)]))

#: Four poses along a track, a loop closure, two beacons.
TRACK = f"""\
VERTEX_SE2 0 A0 0 0 0
VERTEX_SE2 0 A1 0 0 0
VERTEX_SE2 0 A5 0 0 0
VERTEX_SE2 0 A7 0 0 0
VERTEX_XY L0 10 20
VERTEX_XY L3 -5 0.5
EDGE_SE2 0 A0 A1 1 2 0.1 4 1 0.5 9 0.25 1
EDGE_SE2 0 A1 A5 1 0 0.2 {EYE3}
EDGE_SE2 0 A5 A7 1 0 0.3 {EYE3}
EDGE_SE2 0 A0 A7 3 1 0.6 {EYE3}
EDGE_RANGE 0 A1 L0 19.5 0.5625
EDGE_RANGE 0 L3 A7 9.5 0.25
"""
SPATIAL = f"""\
VERTEX_SE3:QUAT 0 A0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 0 A1 0 0 0 0 0 0 1
VERTEX_XYZ L0 1 2 -3
EDGE_SE3:QUAT 0 A0 A1 1 2 3 0 0 0 1 {EYE6}
EDGE_RANGE 0 A0 L0 4 0.25
"""


@pytest.fixture
def load(tmp_path):
    def loads(text: str, tables: str = "") -> Mission:
        (tmp_path / "graph.pyfg").write_text(text)
        (tmp_path / "mission.toml").write_text(tables + "\n" + DATA)
        return load_mission(tmp_path / "mission.toml")

    return loads


@pytest.fixture
def refused(load, tmp_path):
    """Check that a file is refused in one line that names file and line."""

    def refuses(text: str, words: str, line: int | None, tables: str = "") -> DataError:
        with pytest.raises(DataError) as caught:
            load(text, tables)
        error, message = caught.value, str(caught.value)
        assert words in message and "\n" not in message
        name = "graph.pyfg" if line else "mission.toml"
        assert (Path(str(error.file)), error.line) == (tmp_path / name, line)
        assert error.remedy and error.row is None
        return error

    return refuses


def graph_of(poses: int, **parts: object) -> PyfgGraph:
    rows = PoseRows([f"A{i}" for i in range(poses)], np.zeros((poses, 3)))
    beacon = PointRows(["L0"], [[5.0, 5.0]])
    every = RangeRows(
        [[f"A{i}", "L0"] for i in range(poses)], np.ones((poses, 1)), np.ones((poses, 1, 1))
    )
    return PyfgGraph(dimension=2, poses=rows, landmarks=beacon, ranges=every, **parts)


# Real data


@pytest.mark.parametrize("name", ["goats_15", "goats_16"])
def test_goats_is_a_mission(name, tmp_path):
    file = gtsam.findExampleDataFile(f"{name}.pyfg")
    graph = read_pyfg(file)
    (tmp_path / "goats.toml").write_text(f'[data]\nformat = "pyfg"\nfile = "{file}"\n')
    mission = load_mission(tmp_path / "goats.toml")
    (segment,) = mission.segments
    assert (mission.name, segment.name, segment.start) == ("goats", "", None)
    assert segment.records().keys() == {"odometry", "slant_range"}
    assert (mission.options.node, mission.options.loss) == ("pose2", "cauchy")
    # One time a pose, in file order.
    count = len(graph.poses)
    assert segment.odometry.t_from.tolist() == list(range(count - 1))
    assert segment.odometry.t_to.tolist() == list(range(1, count))
    # Its edges composed give its vertices: the file's vertices are composed odometry.
    pose, steps = gtsam.Pose2(), segment.odometry
    for i in range(count - 1):
        forward, left, _ = steps.translation[i]
        pose = pose.compose(gtsam.Pose2(forward, left, steps.rotation_vector[i, 2]))
        expected = graph.poses.values[i + 1]
        assert np.hypot(pose.x() - expected[0], pose.y() - expected[1]) < 1e-4
        assert abs(np.sin(pose.theta() - expected[2])) < 1e-5
    np.testing.assert_array_equal(steps.covariances_flu, graph.pose_edges.covariance)
    # Ranges belong to the poses that they name; variances became standard deviations.
    ranges = segment.slant_range
    assert ranges.t.tolist() == [graph.poses.first.index(n) for n in graph.ranges.first]
    assert ranges.beacon.tolist() == graph.ranges.second
    assert ranges.distance.tolist() == graph.ranges.distance.tolist()
    assert set(ranges.sigma) == {0.75}
    assert mission.beacon_names == tuple(graph.landmarks.first)
    for beacon, position in zip(mission.beacons, graph.landmarks.position, strict=True):
        assert beacon.position.tolist() == [*position, 0.0] and not beacon.sigma.any()


# What becomes what


def test_a_track_with_gaps_in_its_numbers_and_a_loop_closure(load):
    (segment,) = load(TRACK).segments
    steps = segment.odometry
    assert steps.t_from.tolist() == [0, 1, 2, 0] and steps.t_to.tolist() == [1, 2, 3, 3]
    assert (steps.forward[0], steps.right[0], steps.about_down[0]) == (1.0, -2.0, -0.1)
    assert steps.dimension == 2 and steps.down is None
    # Right and about down are the file's y and turn with their signs changed.
    assert steps.covariance[0].tolist() == [[4, -1, -0.5], [-1, 9, 0.25], [-0.5, 0.25, 1]]
    assert segment.slant_range.t.tolist() == [1, 3]
    assert segment.slant_range.beacon.tolist() == ["L0", "L3"]
    assert segment.slant_range.sigma.tolist() == [0.75, 0.5]
    assert segment.odometry.source.line.tolist() == [7, 8, 9, 10]


def test_spatial_edges_keep_translation_rotation_and_full_covariance(tmp_path, load):
    rng = np.random.default_rng(3)
    chain = [gtsam.Pose3()]
    for _ in range(5):
        step = gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(size=3)), rng.normal(size=3))
        chain.append(chain[-1].compose(step))
    steps = [a.between(b) for a, b in pairwise(chain)]
    quaternions = [s.rotation().toQuaternion().coeffs() for s in steps]
    root = rng.normal(size=(5, 6, 6)) + 6 * np.eye(6)
    covariance = root @ np.swapaxes(root, 1, 2)
    covariance = (covariance + np.swapaxes(covariance, 1, 2)) / 2
    names = [f"A{i}" for i in range(6)]
    still = np.tile([0.0, 0, 0, 0, 0, 0, 1], (6, 1))
    graph = PyfgGraph(
        dimension=3,
        poses=PoseRows(names, still),
        landmarks=PointRows(["L0"], [[1.0, 2.0, -3.0]]),
        pose_edges=PoseRows(
            np.stack([names[:-1], names[1:]], axis=1),
            np.column_stack([[s.translation() for s in steps], quaternions]),
            covariance,
        ),
        ranges=RangeRows([["A0", "L0"]], [[5.0]], [[[0.25]]]),
    )
    write_pyfg(tmp_path / "made.pyfg", graph)
    mission = load((tmp_path / "made.pyfg").read_text())
    (segment,) = mission.segments
    assert mission.options.node == "pose3"
    assert mission.beacons[0].position.tolist() == [1, 2, -3]
    odometry = segment.odometry
    assert odometry.dimension == 3
    np.testing.assert_allclose(odometry.translation, [s.translation() for s in steps], atol=1e-14)
    turns = [gtsam.Rot3.Logmap(s.rotation()) for s in steps]
    np.testing.assert_allclose(odometry.rotation_vector, turns, atol=1e-12)
    np.testing.assert_array_equal(odometry.covariances_flu, covariance)
    signs = np.array([1, -1, -1, 1, -1, -1])
    np.testing.assert_array_equal(odometry.covariance[0], covariance[0] * np.outer(signs, signs))
    assert (odometry.right == -odometry.translation[:, 1]).all()


def test_vertices_of_poses_hold_guesses_that_serve_nothing(load):
    moved = TRACK.replace("A1 0 0 0", "A1 77 -3 1").replace("A0 0 0 0", "A0 5 5 5")
    assert moved != TRACK
    one, other = load(TRACK), load(moved)
    for kind, rows in one.segments[0].records().items():
        again = getattr(other.segments[0], kind)
        for name in ("t", "t_from", "forward", "right", "distance", "covariance"):
            if hasattr(rows, name):
                np.testing.assert_array_equal(getattr(rows, name), getattr(again, name))
    assert one.segments[0].reference is None and other.segments[0].reference is None


def test_whole_turns_are_none(load):
    mission = load(TRACK.replace("A0 A1 1 2 0.1", "A0 A1 1 2 7").replace("A5 1 0 0.2", "A5 1 0 -3"))
    turns = mission.segments[0].odometry.rotation_vector[:, 2]
    assert turns[0] == pytest.approx(7 - 2 * np.pi, abs=1e-15) and turns[1] == -3.0


@pytest.mark.parametrize("planar", [True, False])
def test_an_edge_back_in_time_is_turned_round(planar):
    """GTSAM's inverse is the oracle; the covariance is that of 1e5 turned draws."""
    rng = np.random.default_rng(5)
    turn = np.array([0.0, 0.0, 2.5]) if planar else np.array([0.4, -0.9, 1.3])
    position = np.array([3.0, -2.0, 0.0]) if planar else np.array([3.0, -2.0, 1.5])
    size = 3 if planar else 6
    root = 1e-3 * (rng.normal(size=(size, size)) + 3 * np.eye(size))
    place, back, covariance = reversed_edges(position[None], turn[None], (root @ root.T)[None])
    edge = gtsam.Pose3(gtsam.Rot3.Expmap(turn), position)
    inverse = edge.inverse()
    np.testing.assert_allclose(place[0], inverse.translation(), atol=1e-14)
    np.testing.assert_allclose(back[0], gtsam.Rot3.Logmap(inverse.rotation()), atol=1e-14)
    where = [0, 1, 5] if planar else list(range(6))
    noise = np.zeros((20000, 6))
    noise[:, where] = rng.normal(size=(20000, size)) @ root.T
    drawn = []
    for n in noise:
        rotation = edge.rotation().compose(gtsam.Rot3.Expmap(n[3:]))
        other = gtsam.Pose3(rotation, position + n[:3]).inverse()
        about = gtsam.Rot3.Logmap(inverse.rotation().between(other.rotation()))
        drawn.append([*(other.translation() - inverse.translation()), *about])
    sample = np.cov(np.array(drawn)[:, where].T)
    sigmas = np.sqrt(np.diagonal(covariance[0]))
    scale = np.outer(sigmas, sigmas)
    # A covariance of N draws is known to about sqrt(2 / N) of it.
    np.testing.assert_allclose(covariance[0] / scale, sample / scale, atol=5 * np.sqrt(2 / 20000))
    again = reversed_edges(place, back, covariance)
    np.testing.assert_allclose(again[0][0], position, atol=1e-14)
    np.testing.assert_allclose(again[2][0], root @ root.T, rtol=1e-9, atol=1e-18)


def test_a_loop_closure_that_names_the_later_pose_first(load):
    closing = f"EDGE_SE2 0 A7 A0 -1 2 0.5 {EYE3}"
    text = TRACK.replace(f"EDGE_SE2 0 A0 A7 3 1 0.6 {EYE3}", closing)
    steps = load(text).segments[0].odometry
    assert (steps.t_from[3], steps.t_to[3]) == (0, 3)
    inverse = gtsam.Pose2(-1, 2, 0.5).inverse()
    np.testing.assert_allclose(
        [*steps.translation[3, :2], steps.rotation_vector[3, 2]],
        [inverse.x(), inverse.y(), inverse.theta()],
        atol=1e-15,
    )


# Times and segments


def test_stamps_are_times_where_they_are_not_all_zero(load):
    stamped = TRACK
    for name, t in (("A0", 100.0), ("A1", 100.5), ("A5", 102.0), ("A7", 110.25)):
        stamped = stamped.replace(f"VERTEX_SE2 0 {name}", f"VERTEX_SE2 {t} {name}")
    (segment,) = load(stamped).segments
    assert segment.odometry.t_from.tolist() == [100.0, 100.5, 102.0, 100.0]
    assert segment.slant_range.t.tolist() == [100.5, 110.25]


def test_a_first_stamp_of_zero_is_a_stamp(load):
    stamped = TRACK
    for name, t in (("A1", 0.5), ("A5", 2.0), ("A7", 3.5)):
        stamped = stamped.replace(f"VERTEX_SE2 0 {name}", f"VERTEX_SE2 {t} {name}")
    assert load(stamped).segments[0].slant_range.t.tolist() == [0.5, 3.5]


def test_poses_that_no_edge_joins_are_segments_of_their_own(load):
    cut = "\n".join(
        line
        for line in TRACK.splitlines()
        if not line.startswith(("EDGE_SE2 0 A1", "EDGE_SE2 0 A0 A7"))
    )
    first, second = load(cut).segments
    assert (first.name, second.name) == ("A0", "A5")
    assert (first.odometry.t_from.tolist(), second.odometry.t_from.tolist()) == ([0], [2])
    assert (first.slant_range.t.tolist(), second.slant_range.t.tolist()) == ([1], [3])
    assert first.slant_range.source.line.tolist() == [9]


def test_a_single_pose_with_ranges_is_a_segment(load):
    alone = "VERTEX_SE2 0 A0 0 0 0\nVERTEX_XY L0 1 2\nEDGE_RANGE 0 A0 L0 2 1\n"
    (segment,) = load(alone).segments
    assert segment.odometry is None and segment.slant_range.t.tolist() == [0]
    names = [s.name for s in pyfg_segments(graph_of(3))]
    assert names == ["A0", "A1", "A2"]


# Priors and start


def test_a_planar_prior_is_a_fix_and_a_heading(load):
    prior = "VERTEX_SE2:PRIOR 0 A1 30 40 0.3 4 1 0 9 0 0.04\n"
    mission = load(TRACK + prior)
    (segment,) = mission.segments
    assert segment.position.t.tolist() == [1]
    assert segment.position.position.tolist() == [[30, 40]]
    assert segment.position.covariances.tolist() == [[[4, 1], [1, 9]]]
    # From x = east, counter-clockwise, to north, clockwise.
    np.testing.assert_allclose(segment.heading.heading, np.pi / 2 - 0.3, atol=1e-15)
    np.testing.assert_allclose(segment.heading.sigma, 0.2, atol=1e-15)
    # No compass: its bias is no unknown, unless it is asked for.
    assert mission.options.heading_bias_sigma_deg == 0.0
    asked = load(TRACK + prior, "[options]\nheading_bias_sigma_deg = 2.0\n")
    assert asked.options.heading_bias_sigma_deg == 2.0


def test_a_spatial_prior_is_a_fix_and_the_heading_of_its_bow(load):
    rotation = gtsam.Rot3.Expmap(np.array([0.3, -0.4, 2.0]))
    quaternion = " ".join(map(repr, rotation.toQuaternion().coeffs().tolist()))
    root = np.random.default_rng(1).normal(size=(3, 3)) * 0.01
    turning = root @ root.T + 1e-4 * np.eye(3)
    covariance = np.diag([1.0, 4.0, 9.0, 0.0, 0.0, 0.0])
    covariance[3:, 3:] = turning
    covariance[0, 1] = covariance[1, 0] = 0.5
    triangle = " ".join(map(repr, covariance[np.triu_indices(6)].tolist()))
    text = SPATIAL + f"VERTEX_SE3:QUAT:PRIOR 0 A0 7 8 -9 {quaternion} {triangle}\n"
    (segment,) = load(text).segments
    assert segment.position.position.tolist() == [[7, 8, -9]]
    np.testing.assert_array_equal(segment.position.covariances[0], covariance[:3, :3])

    def heading(turn: np.ndarray) -> float:
        bow = rotation.compose(gtsam.Rot3.Expmap(turn)).matrix()[:, 0]
        return float(np.arctan2(bow[0], bow[1]))

    np.testing.assert_allclose(segment.heading.heading, heading(np.zeros(3)), atol=1e-14)
    slope = [(heading(1e-6 * e) - heading(-1e-6 * e)) / 2e-6 for e in np.eye(3)]
    expected = np.sqrt(slope @ turning @ slope)
    np.testing.assert_allclose(segment.heading.sigma, expected, rtol=1e-8)


def test_a_prior_that_knows_no_heading_gives_none(load):
    (segment,) = load(TRACK + "VERTEX_SE2:PRIOR 0 A1 30 40 0.3 4 0 0 9 0 100\n").segments
    assert segment.position is not None and segment.heading is None


def test_a_mission_may_have_priors_and_no_range(load):
    text = "VERTEX_SE2 0 A0 0 0 0\nVERTEX_SE2:PRIOR 0 A0 1 2 0 1 0 0 1 0 1\n"
    mission = load(text)
    assert mission.beacons == () and mission.segments[0].records().keys() == {"position", "heading"}


def test_priors_on_landmarks_count_where_beacons_are_estimated(load):
    prior = TRACK + "VERTEX_XY:PRIOR 0 L3 -6 1 4 0 9\n"
    held = load(prior)
    assert held.beacons[1].position.tolist() == [-5, 0.5, 0] and not held.beacons[1].sigma.any()
    free = load(prior, "[options]\nestimate_beacons = true\n")
    assert free.beacons[0].sigma.tolist() == [0, 0, 1e-3]
    assert free.beacons[1].position.tolist() == [-6, 1, 0]
    assert free.beacons[1].sigma.tolist() == [2, 3, 1e-3]
    spatial = SPATIAL + "VERTEX_XYZ:PRIOR 0 L0 1 2 3 4 0 0 9 0 16\n"
    (beacon,) = load(spatial, "[options]\nestimate_beacons = true\n").beacons
    assert (beacon.position.tolist(), beacon.sigma.tolist()) == ([1, 2, 3], [2, 3, 4])


def test_a_start_goes_to_the_pose_of_its_time(load):
    start = "[start]\nt = 2\neast = 100\nnorth = 200\nsigma = 3\nheading_deg = 90\n"
    (segment,) = load(TRACK, start).segments
    assert (segment.start.t, segment.start.east, segment.start.north) == (2.0, 100.0, 200.0)
    assert segment.start.heading == pytest.approx(np.pi / 2)
    cut = TRACK.replace(f"EDGE_SE2 0 A1 A5 1 0 0.2 {EYE3}\n", "")
    cut = cut.replace(f"EDGE_SE2 0 A0 A7 3 1 0.6 {EYE3}\n", "")
    first, second = load(cut, start).segments
    assert first.start is None and second.start.t == 2.0


def test_tables_of_the_mission_file_are_as_elsewhere(load):
    mission = load(
        TRACK,
        '[mission]\nname = "goats"\norigin = { latitude = 43.0, longitude = 10.0 }\n'
        "[vehicle]\ntransducer = { forward = 0.3, down = 1.0 }\n"
        '[options]\nloss = "huber"\nodometry_scale_sigma = 0\n',
    )
    assert mission.name == "goats" and mission.origin.latitude == 43.0
    assert mission.vehicle.transducer.body.tolist() == [0.3, 0.0, -1.0]
    assert (mission.options.loss, mission.options.odometry_scale_sigma) == ("huber", 0.0)


# What is refused


def test_what_one_vehicle_cannot_take_is_refused_by_line(refused):
    range_line = "EDGE_RANGE 0 L3 A7 9.5 0.25\n"
    for text, words, line in (
        (TRACK + "VERTEX_SE2 0 B0 0 0 0\n", "'B0' is of another than 'A0'", 13),
        (TRACK + "EDGE_RANGE 0 A0 A7 5 1\n", "a range between two poses ('A0' and 'A7')", 13),
        (TRACK + "EDGE_RANGE 0 L0 L3 5 1\n", "a range between two landmarks ('L0' and 'L3')", 13),
        (TRACK + "EDGE_SE2_XY 0 A0 L0 1 2 1 0 1\n", "no positions of them seen from", 13),
        (TRACK + range_line, "duplicate record (t = 3.0)", 13),
        (TRACK.replace(range_line, "EDGE_RANGE 0 L3 A7 0 0.25\n"), "no distance to a beacon", 12),
        (TRACK.replace("A0 A1 1 2", "A0 A1 1e5 2"), "100000.0 m is outside", 7),
    ):
        refused(text, words, line)


def test_stamps_that_do_not_increase_are_refused(refused):
    for t in (0.5, 0.25, 0):
        stamped = TRACK.replace("VERTEX_SE2 0 A1", "VERTEX_SE2 0.5 A1")
        stamped = stamped.replace("VERTEX_SE2 0 A5", f"VERTEX_SE2 {t} A5")
        stamped = stamped.replace("VERTEX_SE2 0 A7", "VERTEX_SE2 9 A7")
        refused(stamped, f"the stamp {float(t)} s of 'A5' is not after that of 'A1'", 3)


def test_an_edge_over_a_gap_is_refused(refused):
    cut = TRACK.replace(f"EDGE_SE2 0 A1 A5 1 0 0.2 {EYE3}\n", "")
    refused(cut, "the edge bridges a gap: none joins 'A1' and 'A5'", 9)


def test_nothing_is_dropped_unsaid(refused):
    alone = "VERTEX_SE2 0 A9 0 0 0\n"
    refused(TRACK + alone, "no range or prior says where 'A9' is, and no edge joins it", 13)
    two = alone + f"VERTEX_SE2 0 A10 0 0 0\nEDGE_SE2 0 A9 A10 1 0 0 {EYE3}\n"
    refused(TRACK + two, "no range or prior says where the poses 'A9' to 'A10' are", 13)
    refused(alone, "nothing is known of 'A9': no edge, range or prior", 1)


def test_a_file_without_poses_is_no_mission(load):
    with pytest.raises(DataError, match=r"graph\.pyfg: there is no pose"):
        load("VERTEX_XY L0 1 2\n")


def test_priors_that_no_record_can_hold_are_refused(refused):
    tied = "VERTEX_SE2:PRIOR 0 A1 30 40 0.3 4 0 0.1 9 0 0.04\n"
    refused(TRACK + tied, "position and heading of the prior are correlated", 13)
    estimated = "[options]\nestimate_beacons = true\n"
    prior = "VERTEX_XY:PRIOR 0 L3 -6 1 4 {} 9\n"
    refused(TRACK + prior.format(1), "the axes are correlated", 13, estimated)
    twice = TRACK + prior.format(0) * 2
    refused(twice, "a second prior on 'L3'", 14, estimated)
    upright = "0 -0.7071067811865476 0 0.7071067811865476"
    spatial = SPATIAL + f"VERTEX_SE3:QUAT:PRIOR 0 A0 7 8 -9 {upright} {EYE6}\n"
    refused(spatial, "the bow points up or down", 6)


def test_wrong_tables_are_refused_by_key(refused):
    start = "[start]\nt = {}\neast = 0\nnorth = 0\n"
    for tables, words, field in (
        (start.format(2.5), "there is no pose at 2.5 s", "start.t"),
        (start.format(-1), "'A0' at 0.0 s (stamps are zero: poses are counted)", "start.t"),
        ('[options]\nnode = "pose3"', "'pose3' does not go with the poses", "options.node"),
        ('[options]\nnode = "point"', "leave node out: it is taken from", "options.node"),
        ("[sound_speed]\nconstant = 1500", "it belongs to format = 'csv'", "sound_speed"),
        ('[options]\nloss = "hubber"', "did you mean 'huber'?", "options.loss"),
    ):
        error = refused(TRACK, words, None, tables)
        assert isinstance(error, ConfigurationError) and error.field == field


def test_wrong_keys_of_data_are_refused(tmp_path):
    file = tmp_path / "mission.toml"
    for data, words in (
        ('format = "pyfg"', "field 'data.file': the key is missing"),
        ('format = "pyfg"\nfiel = "a.pyfg"', "did you mean 'file'?"),
        ('format = "pyfg"\nfile = 3', "3 is not a text in quotes"),
        ('format = "pyfg"\nfile = "a.pyfg"\nposition = "b.csv"', "it belongs to format = 'csv'"),
        ('format = "pygf"\nfile = "a.pyfg"', "did you mean 'pyfg'?"),
    ):
        file.write_text(f"[data]\n{data}\n")
        with pytest.raises(ConfigurationError, match=re.escape(words)):
            load_mission(file)
    file.write_text('[data]\nformat = "pyfg"\nfile = "gone.pyfg"\n')
    with pytest.raises(DataError, match=r"gone\.pyfg: there is no such file"):
        load_mission(file)


# What the documentation says


def test_the_documented_lines_are_those_that_are_read():
    text = (DOCS / "pyfg.md").read_text()
    rows = [
        line.split("|")[1:-1] for line in text.splitlines() if line.startswith(("| `V", "| `E"))
    ]
    documented = {token.strip().strip("`"): words for token, words, *_ in rows}
    assert documented.keys() == TOKENS.keys()
    for token, words in documented.items():
        layout = TOKENS[token]
        named = re.findall(r"[a-z]+", words.replace("variance", "").split("+")[0])
        stated = [*(["t"] if layout.stamped else []), *layout.names, *layout.values]
        assert named == stated, token
        size = len(layout.columns) - len(stated)
        expected = "" if size == 0 else "+ variance" if size == 1 else f"+ {size}"
        assert words.strip().endswith(expected) and ("+" in words) == bool(size), token


def test_the_documented_example_is_a_mission(tmp_path):
    text = (DOCS / "pyfg.md").read_text()
    (example,) = [block.split("```")[0] for block in text.split("```toml\n")[1:]]
    goats = gtsam.findExampleDataFile("goats_15.pyfg")
    (tmp_path / "goats_15.pyfg").write_text(Path(goats).read_text())
    (tmp_path / "mission.toml").write_text(example)
    assert len(load_mission(tmp_path / "mission.toml").segments[0].slant_range) == 786
