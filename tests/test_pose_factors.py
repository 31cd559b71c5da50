"""Residuals of pose nodes: derivatives, signs written out by hand, and GTSAM's own factors.

Poses, measurements and unknowns are drawn at random; what a residual should be is then composed of
plain rotation matrices, or asked of GTSAM, never of the code that is tested.
"""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from problems import everything_posed, nodes_of, posed_state, problem_of
from scipy.spatial.transform import Rotation

from ubl_graph import Beacon, Mission, Options, Segment, SoundSpeedProfile, Vehicle
from ubl_graph.factors import pose_motion
from ubl_graph.factors.compass import CompassBlock
from ubl_graph.factors.loss import RobustLoss
from ubl_graph.factors.poses import PoseMotion, PoseNodes
from ubl_graph.factors.tips import PosesAt, Tips
from ubl_graph.frames import LeverArm, world_R_body
from ubl_graph.graph import build_problem, model_segment
from ubl_graph.layout import Chain, Layout
from ubl_graph.measurements import AngularRate, Attitude, Heading, Odometry, SlantRange, Velocity
from ubl_graph.mission import Start
from ubl_graph.problem import Problem
from ubl_graph.trajectory import whitening

X, V = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.V
NODES = pytest.mark.parametrize("node", ["pose2", "pose3"])
MOVING = {
    "as it is": {},
    "heading bias of every node": {"heading_bias_walk_deg": 1.0},
    "straight rays, beacons known": {"rays": "straight", "estimate_beacons": False},
    "nodes on a grid": {"node_spacing": 4.0},
    "gyros alone turn": {"without": "attitude"},
}
CASES = {f"moving, {name}": (False, options) for name, options in MOVING.items()} | {
    "still": (True, {}),
    "still, heading bias of every node": (True, {"heading_bias_walk_deg": 1.0}),
    "still, odometry taken at its word": (
        True,
        {"odometry_scale_sigma": 0.0, "odometry_turn_bias_sigma_deg": 0.0},
    ),
}
BY_CASE = pytest.mark.parametrize(("still", "options"), CASES.values(), ids=list(CASES))
RANGES = {"two_way_range", "one_way_range", "slant_range"}
#: What a mission of all records must have, whatever its nodes.
ALWAYS = RANGES | {
    "rotation prior",
    "start prior",
    "start heading",
    "odometry",
    "gyro",
    "attitude",
    "heading",
    "position",
}
DVL = {"velocity", "water odometry", "water velocity", "motion", "rate"}


def block_of(problem: Problem, name: str, number: int = 0):
    return [b for b in problem.blocks if b.name == name][number]


# -- derivatives --


@NODES
@BY_CASE
def test_every_jacobian_matches_finite_differences(node, still, options):
    """Some rows of every block by all columns they touch, to the fourth order of the step."""
    problem = problem_of(everything_posed(1, node=node, still=still, **options))
    names = {block.name for block in problem.blocks}
    left_out = {options.get("without", "")}
    assert names >= (ALWAYS | (set() if still else DVL)) - left_out
    assert ("depth" in names) == (node == "pose3")
    assert problem.layout.still == still
    x = posed_state(problem, 1)
    rng = np.random.default_rng(7)
    for block in problem.blocks:
        held = block.frozen(x)
        for row in rng.choice(len(block.columns), min(3, len(block.columns)), replace=False):
            some = slice(int(row), int(row) + 1)
            _, jacobian = block.evaluate(x, held, some)
            columns = np.unique(block.columns[row][block.columns[row] >= 0])
            analytic = jacobian[0] @ (block.columns[row][:, None] == columns)
            numeric = np.stack([slope(block, x, held, some, c) for c in columns], axis=1)
            scale = np.abs(numeric).max(initial=1.0)
            np.testing.assert_allclose(analytic, numeric, atol=1e-7 * scale, err_msg=block.name)


def slope(block, x, held, rows, column, step=1e-3):
    """Derivative of one row by one column, (R,)."""
    out = 0.0
    for weight, times in ((8.0, 1.0), (-8.0, -1.0), (-1.0, 2.0), (1.0, -2.0)):
        moved = x.copy()
        moved[column] += times * step
        out = out + weight * block.evaluate(moved, held, rows, jacobian=False)[0][0]
    return out / (12.0 * step)


@NODES
@BY_CASE
def test_a_row_alone_is_the_row_in_the_batch(node, still, options):
    problem = problem_of(everything_posed(3, node=node, still=still, **options))
    x = posed_state(problem, 3)
    for block in problem.blocks:
        held = block.frozen(x)
        whole, jacobians = block.evaluate(x, held)
        for i in range(len(block.columns)):
            one, jacobian = block.evaluate(x, held, slice(i, i + 1))
            np.testing.assert_allclose(one[0], whole[i], rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(jacobian[0], jacobians[i], rtol=1e-7, atol=1e-8)


@NODES
@BY_CASE
def test_ranges_between_and_at_nodes_are_both_there(node, still, options):
    """Or the derivatives above would say less than they seem to."""
    problem = problem_of(everything_posed(1, node=node, still=still, **options))
    widths = {
        b.name: b.antenna.columns.shape[1] / b.antenna.legs for b in problem.blocks if b.robust
    }
    two_ends = 2 * problem.layout.kinematic_width
    assert set(widths.values()) <= {problem.layout.pose_width, two_ends}
    assert widths["slant_range"] == two_ends
    mission = everything_posed(1, node=node, still=True)
    ends = mission.segments[0].odometry.t_from
    on_nodes = replace(mission.segments[0], slant_range=SlantRange(ends, "B1", 1e3, 1.0))
    problem = problem_of(replace(mission, segments=(on_nodes,)))
    assert block_of(problem, "slant_range").antenna.columns.shape[1] == problem.layout.pose_width


# -- residuals by hand --


def rows_of(problem: Problem, name: str, x: np.ndarray, number: int = 0) -> np.ndarray:
    return block_of(problem, name, number).evaluate(x)[0]


def one_beacon(segment: Segment, vehicle: Vehicle | None = None, **options) -> Mission:
    settings = Options(
        **{"node": "pose3", "estimate_sound_speed": False, "rays": "straight", **options}
    )
    profile = SoundSpeedProfile.constant(1500.0)
    vehicle = Vehicle() if vehicle is None else vehicle
    return Mission((segment,), (Beacon("B1", [40.0, -30.0, -90.0]),), profile, vehicle, settings)


def few_ranges(t: np.ndarray) -> SlantRange:
    return SlantRange(t, "B1", np.full(len(t), 100.0), 0.4)


def at_truth(problem: Problem, heading, pitch, roll, position) -> np.ndarray:
    """A flat vector at known poses, (N,) each and (N, 3)."""
    layout, x = problem.layout, np.zeros(problem.layout.size)
    layout.put(x, "position", position[:, : layout.get(x, "position").shape[1]])
    if layout.node == "pose2":
        layout.put(x, "rotation", (0.5 * np.pi - heading)[:, None])
    else:
        vector = Rotation.from_matrix(world_R_body(heading, pitch, roll)).as_rotvec()
        layout.put(x, "rotation", vector)
    return x


def track(t: np.ndarray) -> tuple[np.ndarray, ...]:
    """Heading, pitch, roll and place of a vehicle that turns clockwise, rolls and pitches."""
    place = np.stack([10.0 + 0.7 * t, 5.0 * np.sin(t / 9.0), -60.0 - 0.1 * t], axis=1)
    return 0.4 + 0.05 * t, 0.1 * np.sin(t / 3.0), 0.2 * np.cos(t / 4.0), place


@NODES
@pytest.mark.parametrize("walk", [0.0, 1.0])
def test_a_reference_that_reads_too_far_clockwise_has_a_positive_bias(node, walk):
    """Two degrees, of an attitude reference and of a compass; the residuals vanish at + 2."""
    t = np.arange(0.0, 31.0, 3.0)
    heading, pitch, roll, place = track(t)
    if node == "pose2":
        pitch = roll = np.zeros_like(t)
    bias = np.deg2rad(2.0)
    segment = Segment(
        slant_range=few_ranges(t),
        attitude=Attitude(t, heading + bias, pitch, roll),
        heading=Heading(t, heading + bias, 0.02),
    )
    problem = problem_of(one_beacon(segment, node=node, heading_bias_walk_deg=walk))
    x = at_truth(problem, heading, pitch, roll, place)
    white = 1.0 / np.deg2rad(Options().attitude_noise_deg)
    off = rows_of(problem, "attitude", x)
    # Unexplained, the reading lies clockwise of the pose: the pose to the left of it, by 2 degrees.
    np.testing.assert_allclose(np.linalg.norm(off, axis=1), white * bias, rtol=1e-9)
    up = world_R_body(heading, pitch, roll)[:, 2]
    up = up[:, 2:] if node == "pose2" else up
    np.testing.assert_allclose(off, white * bias * up, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(rows_of(problem, "heading", x)[:, 0], -bias / 0.02, rtol=1e-9)
    problem.layout.put(x, "heading_bias", np.full_like(problem.layout.get(x, "heading_bias"), bias))
    np.testing.assert_allclose(rows_of(problem, "attitude", x), 0.0, atol=1e-9)
    np.testing.assert_allclose(rows_of(problem, "heading", x), 0.0, atol=1e-9)


def test_a_planar_vehicle_that_rolls_reads_its_heading_all_the_same():
    """What an attitude reference says of roll and pitch turns neither heading nor odometry."""
    t = np.arange(0.0, 31.0, 3.0)
    fine = np.arange(-1.0, 34.0, 0.01)
    place = np.stack([0.7 * fine, 5.0 * np.sin(fine / 9.0), 0.0 * fine - 60.0], axis=1)
    heading, pitch, roll = 0.4 + 0.05 * fine, 0.1 + 0.0 * fine, 0.2 * np.cos(fine / 4.0)
    speed = np.gradient(place, fine, axis=0)
    body = np.einsum("mji,mj->mi", world_R_body(heading, pitch, roll), speed)
    segment = Segment(
        slant_range=few_ranges(t),
        velocity=Velocity(fine, body[:, 0], -body[:, 1], -body[:, 2], 0.01),
        attitude=Attitude(fine, heading, pitch, roll),
    )
    problem = problem_of(one_beacon(segment, node="pose2", node_spacing=3.0))
    nodes = problem.layout.chains[0].t
    places = np.stack([0.7 * nodes, 5.0 * np.sin(nodes / 9.0), 0.0 * nodes - 60.0], axis=1)
    flat = 0.4 + 0.05 * nodes
    x = at_truth(problem, flat, 0.0 * nodes, 0.0 * nodes, places)
    level = world_R_body(flat, 0.0, 0.0)
    across = np.stack([0.7 + 0.0 * nodes, 5.0 / 9.0 * np.cos(nodes / 9.0), 0.0 * nodes], axis=1)
    problem.layout.put(x, "velocity", np.einsum("mji,mj->mi", level, across)[:, :2])
    np.testing.assert_allclose(rows_of(problem, "attitude", x), 0.0, atol=1e-9)
    # In units of the noise: 1 cm/s a sample.
    assert np.abs(rows_of(problem, "odometry", x)).max() < 2e-2
    assert np.abs(rows_of(problem, "velocity", x)).max() < 2e-2


def test_compass_readings_between_nodes_are_held_against_the_interpolated_pose():
    t = np.array([2.0, 9.0])
    layout = Layout((Chain("", 0, t),), 2, node="pose2")
    x = np.zeros(layout.size)
    layout.put(x, "rotation", np.array([[0.2], [1.6]]))
    layout.put(x, "rate", np.array([[0.2], [0.2]]))  # 0.2 rad/s for 7 s: 1.4 rad, no bend at all
    times = np.array([2.0, 4.5, 9.0])
    yaw = 0.2 + 0.2 * (times - 2.0)
    measured = 0.5 * np.pi - yaw + 2.0 * np.pi * np.array([0.0, 1.0, -1.0])
    block = CompassBlock(PosesAt(layout, layout.chains[0], times), measured, np.full(3, 0.01))
    np.testing.assert_allclose(block.evaluate(x)[0], 0.0, atol=1e-10)
    block = CompassBlock(
        PosesAt(layout, layout.chains[0], times), measured + 0.03, np.full(3, 0.01)
    )
    np.testing.assert_allclose(block.evaluate(x)[0], -3.0, rtol=1e-9)


@NODES
def test_a_compass_reading_between_nodes_counts_for_less(node):
    """By what the prior lets the heading do there: psd T^3 / 192 halfway."""
    psd, spacing = 2e-3, 4.0
    segment = Segment(
        slant_range=few_ranges(np.arange(0.0, 21.0)), heading=Heading([6.0, 8.0], 0.3, 0.02)
    )
    mission = one_beacon(segment, node=node, node_spacing=spacing, angular_acceleration_psd=psd)
    problem = problem_of(mission)
    off = rows_of(problem, "heading", np.zeros(problem.layout.size))[:, 0]
    ratio = np.hypot(0.02, np.sqrt(psd * spacing**3 / 192.0)) / 0.02
    assert off[1] / off[0] == pytest.approx(ratio, rel=1e-9)


@pytest.mark.parametrize("psd", [1e-3, 1e3])
def test_nodes_stand_no_closer_than_the_compass_reads(psd):
    """However loose the prior on the heading between them."""
    t = np.arange(0.0, 61.0, 10.0)
    segment = Segment(slant_range=few_ranges(t), heading=Heading(np.arange(0.0, 60.0, 2.0), 0.3))
    mission = one_beacon(segment, node="pose2", angular_acceleration_psd=psd)
    nodes = model_segment(mission.segments[0], mission.options).t
    assert 1.0 < np.diff(nodes).max() <= 2.0


@NODES
def test_odometry_that_turns_too_far_clockwise_and_measures_too_short(node):
    """A turn bias of 0.01 rad/s and a scale of 2 %: the true way is longer than the one read."""
    t = np.array([0.0, 4.0, 9.0, 11.0])
    heading, pitch, roll, place = track(t)
    if node == "pose2":
        pitch = roll = np.zeros_like(t)
        place[:, 2] = -60.0
    rotation = world_R_body(heading, pitch, roll)
    turn_bias, scale = 0.01, 0.02
    ways, turns = [], []
    for k in range(3):
        dt = t[k + 1] - t[k]
        true_way = rotation[k].T @ (place[k + 1] - place[k])
        # What turns too far clockwise (about down) reads so: half of it is there on the way.
        half = Rotation.from_rotvec([0.0, 0.0, -0.5 * turn_bias * dt]).as_matrix()
        ways.append(half @ true_way / (1.0 + scale))
        turns.append(half @ half @ rotation[k].T @ rotation[k + 1])
    way = np.array(ways)
    turn = Rotation.from_matrix(np.array(turns)).as_rotvec()
    records = Odometry(t[:-1], t[1:], *(way * [1, -1, -1]).T, *(turn * [1, -1, -1]).T)
    if node == "pose2":
        records = Odometry(t[:-1], t[1:], way[:, 0], -way[:, 1], about_down=-turn[:, 2])
        # The heading grows by the true turn and what is read too much.
        np.testing.assert_allclose(
            records.about_down, np.diff(heading) + turn_bias * np.diff(t), atol=1e-12
        )
    segment = Segment(slant_range=few_ranges(t), odometry=records)
    mission = one_beacon(segment, node=node, odometry_turn_bias_sigma_deg=1.0)
    problem = problem_of(mission)
    assert problem.layout.still
    x = at_truth(problem, heading, pitch, roll, place)
    assert np.abs(rows_of(problem, "odometry", x)).max() > 1.0
    problem.layout.put(x, "odometry_turn_bias", np.array([turn_bias]))
    problem.layout.put(x, "odometry_scale", np.array([scale]))
    np.testing.assert_allclose(rows_of(problem, "odometry", x), 0.0, atol=1e-9)


def test_an_odometry_residual_is_gtsams_between_factor():
    problem = problem_of(
        everything_posed(4, still=True, odometry_scale_sigma=0.0, odometry_turn_bias_sigma_deg=0.0)
    )
    x = posed_state(problem, 4, turning=0.1)
    records = everything_posed(4, still=True).segments[0].odometry
    residual = rows_of(problem, "odometry", x)
    nodes = nodes_of(problem, x)
    poses = [
        gtsam.Pose3(gtsam.Rot3(r), p) for r, p in zip(nodes.rotation, nodes.position, strict=True)
    ]
    order = [3, 4, 5, 0, 1, 2]
    values = gtsam.Values()
    for k, pose in enumerate(poses):
        values.insert(X(k), pose)
    for k in range(len(records)):
        way, turn = records.translation[k], records.rotation_vector[k]
        covariance = records.covariances_flu[k][np.ix_(order, order)]
        model = gtsam.noiseModel.Gaussian.Covariance(covariance)
        measured = gtsam.Pose3(gtsam.Rot3.Expmap(turn), way)
        factor = gtsam.BetweenFactorPose3(X(k), X(k + 1), measured, model)
        assert 0.5 * residual[k] @ residual[k] == pytest.approx(factor.error(values), rel=1e-9)


def gyro_mission(node: str, rates: AngularRate, t: np.ndarray) -> Mission:
    segment = Segment(
        slant_range=few_ranges(t), angular_rate=rates, start=Start(t[0], 0.0, 0.0, -60.0)
    )
    return one_beacon(segment, node=node, node_spacing=1.0)


@NODES
def test_a_gyro_that_reads_too_much_has_a_positive_bias(node):
    """Read too far clockwise about down means bias about up of the other sign in the state."""
    t, fine = np.arange(0.0, 21.0), np.arange(-1.0, 23.0, 0.01)
    rate, bias = 0.06, np.array([3e-3, -2e-3, 5e-3])  # forward, right, down
    if node == "pose2":
        bias[:2] = 0.0
    rates = AngularRate(fine, bias[0], bias[1], rate + bias[2], 1e-3)
    problem = problem_of(gyro_mission(node, rates, t))
    nodes = problem.layout.chains[0].t
    zero = np.zeros_like(nodes)
    x = at_truth(
        problem, 0.3 + rate * nodes, zero, zero, np.tile([0.0, 0.0, -60.0], (len(nodes), 1))
    )
    turning = np.tile([0.0, 0.0, -rate], (len(nodes), 1))
    problem.layout.put(x, "rate", turning[:, 2:] if node == "pose2" else turning)
    for name in ("gyro", "rate"):
        assert np.abs(rows_of(problem, name, x)).max() > 1.0
    state = np.array([bias[0], -bias[1], -bias[2]])  # forward, left, up
    problem.layout.put(x, "gyro_bias", state[2:] if node == "pose2" else state)
    np.testing.assert_allclose(rows_of(problem, "rate", x), 0.0, atol=1e-9)
    # To first order in the bias; of the second there is bias * dt * turn / 2, some 1e-4 rad.
    np.testing.assert_allclose(
        rows_of(problem, "gyro", x), 0.0, atol=0.3 if node == "pose3" else 1e-6
    )


def test_velocities_with_a_lever_arm_and_a_current():
    """DVL odometry and water-track velocity of a rolling vehicle, written out."""
    t = np.arange(0.0, 21.0, 2.0)
    fine = np.arange(-1.0, 24.0, 0.002)
    arm, current = LeverArm(-0.9, 0.4, 0.3), np.array([0.2, -0.3, 0.0])
    heading, pitch, roll, place = track(fine)
    rotation = world_R_body(heading, pitch, roll)
    tip = place + rotation @ arm.body
    speed = np.gradient(tip, fine, axis=0) - current
    body = np.einsum("mji,mj->mi", rotation, speed)
    segment = Segment(
        slant_range=few_ranges(t),
        velocity=Velocity(fine, body[:, 0], -body[:, 1], -body[:, 2], 0.01, "water"),
        attitude=Attitude(fine, heading, pitch, roll),
    )
    mission = one_beacon(segment, Vehicle(dvl=arm), estimate_current=True, node_spacing=1.0)
    problem = problem_of(mission)
    nodes = problem.layout.chains[0].t
    x = at_truth(problem, *track(nodes))
    layout = problem.layout
    layout.put(x, "current", np.tile(current[:2], (len(nodes), 1)))
    turning = rotating(nodes)
    velocity = (track(nodes + 1e-4)[3] - track(nodes - 1e-4)[3]) / 2e-4
    layout.put(x, "rate", turning)
    layout.put(x, "velocity", np.einsum("mji,mj->mi", world_R_body(*track(nodes)[:3]), velocity))
    # In units of the noise: 1 cm/s a sample, added up.
    assert np.abs(rows_of(problem, "water odometry", x)).max() < 2e-2
    assert np.abs(rows_of(problem, "water velocity", x)).max() < 2e-2
    layout.put(x, "current", np.zeros((len(nodes), 2)))
    assert np.abs(rows_of(problem, "water odometry", x)).max() > 10.0


def rotating(t: np.ndarray) -> np.ndarray:
    """Rates of `track` in the body, (N, 3), rad/s."""
    before, after = (world_R_body(*track(t + step)[:3]) for step in (-1e-4, 1e-4))
    return Rotation.from_matrix(np.swapaxes(before, 1, 2) @ after).as_rotvec() / 2e-4


def test_a_slant_range_with_a_lever_arm_by_hand():
    t = np.arange(0.0, 21.0, 2.0)
    arm = LeverArm(1.2, -0.4, 0.6)
    distance = np.linspace(60.0, 110.0, len(t))
    segment = Segment(slant_range=SlantRange(t, "B1", distance, 0.4))
    mission = one_beacon(segment, Vehicle(transducer=arm), node_spacing=1.0)
    problem = problem_of(mission)
    nodes = problem.layout.chains[0].t
    x = at_truth(problem, *track(nodes))
    residual = rows_of(problem, "slant_range", x)[:, 0]
    heading, pitch, roll, place = track(t)
    antenna = place + world_R_body(heading, pitch, roll) @ arm.body
    expected = np.linalg.norm(antenna - mission.beacons[0].position, axis=1) - distance
    np.testing.assert_allclose(residual, expected / 0.4, rtol=1e-9)


def test_the_interpolations_own_noise_moves_the_tip_of_a_lever_arm():
    """Drawn by chance: what the prior leaves open between known nodes, along a line of sight."""
    t = np.array([0.0, 6.0])
    layout = Layout((Chain("", 0, t),), 2, node="pose3")
    x = np.zeros(layout.size)
    layout.put(x, "rotation", np.array([[0.3, -0.2, 1.0], [0.3, -0.2, 1.0]]))
    psd = np.array([2e-3, 1e-3, 4e-3, 1e-5, 2e-5, 3e-5])
    arm = np.array([4.0, -3.0, 2.0])
    tips = Tips(PosesAt(layout, layout.chains[0], np.array([2.5])), arm, psd)
    _, terms = tips.at(x, slice(None))
    rng = np.random.default_rng(0)
    factor = (2.5 * 3.5 / 6.0) ** 3 / 3.0
    off = np.sqrt(psd * factor) * rng.normal(size=(200_000, 6))
    rotation = Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix()
    moved = (off[:, :3] + np.cross(off[:, 3:], arm)) @ rotation.T
    found = tips.variance(terms)[0]
    scale = np.sqrt(np.outer(np.diag(found), np.diag(found)))
    np.testing.assert_allclose(np.cov(moved.T) / scale, found / scale, atol=0.02)


def test_what_a_plane_holds_adds_no_noise_to_ranges():
    """A beacon straight below: between nodes a planar vehicle moves across the line of sight."""
    segment = Segment(slant_range=SlantRange([6.0, 8.0], "B1", 90.0, 0.4))
    for node, more in (("pose2", 0.0), ("pose3", 2e-3 * 4.0**3 / 192.0)):
        problem = problem_of(one_beacon(segment, node=node, node_spacing=4.0))
        layout, x = problem.layout, np.zeros(problem.layout.size)
        count = layout.node_count
        layout.put(
            x, "position", np.tile([40.0, -30.0, 0.0][: 2 if more == 0.0 else 3], (count, 1))
        )
        sigma = block_of(problem, "slant_range").frozen(x) * 1500.0
        np.testing.assert_allclose(sigma**2, 0.4**2 + more * np.array([1.0, 0.0]), rtol=1e-9)


# -- GTSAM's factors --


def pose_values(layout: Layout, x: np.ndarray) -> gtsam.Values:
    """GTSAM's own poses and twists of all nodes, about the axes first."""
    values = gtsam.Values()
    for k in range(layout.node_count):
        place, turn = (layout.get(x, name)[k] for name in ("position", "rotation"))
        twist = np.concatenate([layout.get(x, "rate")[k], layout.get(x, "velocity")[k]])
        if layout.node == "pose2":
            values.insert(X(k), gtsam.Pose2(*place, turn[0]))
            values.insert(V(k), twist[[1, 2, 0]])
        else:
            values.insert(X(k), gtsam.Pose3(gtsam.Rot3.Expmap(turn), place))
            values.insert(V(k), twist)
    return values


def random_chain(node: str, seed: int, count: int = 5) -> tuple[Layout, np.ndarray]:
    """Poses and twists at random, up to a radian from node to node."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.3, 6.0, count))
    layout = Layout((Chain("", 0, t),), 2, node=node)
    x = rng.normal(size=layout.size)
    layout.put(x, "position", 5.0 * layout.get(x, "position"))
    if node == "pose3":
        turns = Rotation.from_rotvec([1.5, -1.0, 2.0])
        vectors = []
        for _ in range(count):
            turns = turns * Rotation.from_rotvec(0.5 * rng.normal(size=3))
            vectors.append(turns.as_rotvec())
        layout.put(x, "rotation", np.array(vectors))
    layout.put(x, "rate", 0.2 * layout.get(x, "rate"))
    return layout, x


def motion_block(layout: Layout, psd: np.ndarray) -> PoseMotion:
    """The motion prior of a chain, put together as `PoseBuilder` does."""
    dt = np.diff(layout.chains[0].t)
    k = np.arange(len(dt))
    keep = np.array([0, 1, 5, 6, 7, 11]) if layout.node == "pose2" else np.arange(12)
    white = np.einsum("mab,i,ij->maibj", whitening(2, dt), 1.0 / np.sqrt(psd), np.eye(6))
    white = white.reshape(-1, 12, 12)[:, keep[:, None], keep[None, :]]
    ends = (PoseNodes(layout, k), PoseNodes(layout, k + 1))
    return PoseMotion(ends, pose_motion.motion(dt), white, keep, dt, np.tile(psd, (len(dt), 1)))


@NODES
@pytest.mark.parametrize("seed", range(4))
def test_motion_block_is_gtsams_own_wnoa_factor(node, seed):
    layout, x = random_chain(node, seed)
    psd = np.random.default_rng(seed).uniform(1e-4, 1.0, 6)
    block = motion_block(layout, psd)
    problem = Problem(layout, (block,), RobustLoss("none"), (1.0, 1.0))
    values, graph = pose_values(layout, x), gtsam.NonlinearFactorGraph()
    t = layout.chains[0].t
    kind = gtsam.WnoaMotionFactorPose2 if node == "pose2" else gtsam.WnoaMotionFactorPose3
    order = [0, 1, 5] if node == "pose2" else [3, 4, 5, 0, 1, 2]
    for k in range(len(t) - 1):
        ends = [gtsam.StateData(X(i), V(i), t[i]) for i in (k, k + 1)]
        graph.add(kind(*ends, psd[order]))
    assert problem.cost(x, (None,)) == pytest.approx(graph.error(values), rel=1e-9)


@NODES
@pytest.mark.parametrize("seed", range(6))
def test_interpolated_poses_are_gtsams_own(node, seed):
    """GTSAM's interpolated factor around a prior on the pose at a time between two nodes."""
    layout, x = random_chain(node, seed, 2)
    rng = np.random.default_rng(seed)
    t = layout.chains[0].t
    time = rng.uniform(t[0] + 0.1, t[1] - 0.1)
    size = 3 if node == "pose2" else 6
    pose2 = node == "pose2"
    measured = gtsam.Pose2(0.3, -1.0, 0.4) if pose2 else gtsam.Pose3(gtsam.Rot3.Rx(0.4), [1, 2, 3])
    prior = gtsam.PriorFactorPose2 if pose2 else gtsam.PriorFactorPose3
    wrapper = gtsam.WnoaInterpFactorPose2 if pose2 else gtsam.WnoaInterpFactorPose3
    inner = prior(X(7), measured, gtsam.noiseModel.Unit.Create(size))
    states = {gtsam.StateData(X(k), V(k), t[k]) for k in range(2)}
    between = {gtsam.StateData(X(7), V(7), time)}
    factor = wrapper(inner, states, between, np.ones(size), True)
    error = factor.unwhitenedError(pose_values(layout, x))
    position, rotation, _ = PosesAt(layout, layout.chains[0], np.array([time])).at(x)
    if pose2:
        yaw = np.arctan2(rotation[0, 1, 0], rotation[0, 0, 0])
        ours = measured.localCoordinates(gtsam.Pose2(*position[0, :2], yaw))
    else:
        ours = measured.localCoordinates(gtsam.Pose3(gtsam.Rot3(rotation[0]), position[0]))
    np.testing.assert_allclose(ours, error, atol=1e-7)


@NODES
@pytest.mark.parametrize("arm", [LeverArm(), LeverArm(1.0, -0.5, 0.7)], ids=["no arm", "arm"])
def test_interpolated_ranges_are_gtsams_own(node, arm):
    """A range factor inside GTSAM's interpolated one, with the antenna's offset."""
    t = np.array([1.0, 4.3, 8.8])
    pings = SlantRange([2.2, 6.9, 5.0], "B1", [70.0, 75.0, 80.0], 0.5)
    mission = one_beacon(
        Segment(slant_range=pings, start=Start(2.0, 0.0, 0.0, 0.0)),
        Vehicle(transducer=arm),
        node=node,
    )
    model = replace(model_segment(mission.segments[0], mission.options), t=t)
    problem = build_problem(mission, [model])
    layout = problem.layout
    shown, x = random_chain(node, 3, 3)
    assert shown.size == layout.size
    beacon, planar = mission.beacons[0].position, node == "pose2"
    residual = rows_of(problem, "slant_range", x)[:, 0]
    values, psd = pose_values(layout, x), np.ones(3 if planar else 6)
    # GTSAM's planar ranges know no depth: what is across remains.
    values.insert(gtsam.symbol("b", 0), beacon[:2] if planar else beacon)
    up = beacon[2] - arm.body[2] if planar else 0.0
    sensor = gtsam.Pose2(*arm.body[:2], 0.0) if planar else gtsam.Pose3(gtsam.Rot3(), arm.body)
    kind = gtsam.RangeFactorWithTransform2D if planar else gtsam.RangeFactorWithTransform3D
    wrapper = gtsam.WnoaInterpFactorPose2 if planar else gtsam.WnoaInterpFactorPose3
    inner = kind(X(9), gtsam.symbol("b", 0), 0.0, gtsam.noiseModel.Isotropic.Sigma(1, 0.5), sensor)
    for i, time in enumerate(pings.t):
        k = int(np.searchsorted(t, time)) - 1
        states = {gtsam.StateData(X(j), V(j), t[j]) for j in (k, k + 1)}
        factor = wrapper(inner, states, {gtsam.StateData(X(9), V(9), time)}, psd, True)
        across = factor.unwhitenedError(values)[0]
        expected = (np.hypot(across, up) - pings.distance[i]) / 0.5
        assert residual[i] == pytest.approx(expected, rel=1e-7, abs=1e-6)
