"""Poses of a smoothed trajectory at any time: means, covariances, frames and angles.

The oracles: GTSAM's interpolation, extra nodes that nothing was measured at, simulation of the
nodes' errors, and covariances worked out by hand.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import problem_of
from scipy.spatial.transform import Rotation
from test_pose_gtsam_view import missions
from test_pose_recovery import beacons, screw

from ubl_graph import Mission, Options, Segment, SoundSpeedProfile, TimeError, smooth
from ubl_graph.frames import world_R_body
from ubl_graph.graph import build_problem, model_segment
from ubl_graph.pose_assembly import pose_trajectory
from ubl_graph.pose_trajectory import PoseTrajectory, mariners_angles
from ubl_graph.sim import Sea, ahrs, planar_vehicle, pressure, two_way_pings
from ubl_graph.solve.banded import BandedEngine
from ubl_graph.solve.marginals import Marginals
from ubl_graph.solve.rounds import solve
from ubl_graph.trajectory import NodeCovariance

X, V = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.V
NAMES = pytest.mark.parametrize(
    "name", ["pose3, motion prior alone", "pose2, hard turns", "pose3, odometry", "pose2, odometry"]
)


@cache
def smoothed(name: str) -> PoseTrajectory:
    mission = missions()[name]
    result = smooth(replace(mission, options=replace(mission.options, solver="banded")))
    assert result.status == "converged", result.reason
    track = result.segments[0].trajectory
    assert isinstance(track, PoseTrajectory)
    return track


def gap_of(found: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference of covariances (M, S, S) in units of the standard deviations."""
    sigma = np.sqrt(np.einsum("mii->mi", expected))
    scale = np.maximum(sigma[:, :, None] * sigma[:, None, :], 1e-30)
    return float((np.abs(found - expected) / scale).max())


@given(
    st.floats(0.0, 2.0 * np.pi - 1e-9), st.floats(-1.5, 1.5), st.floats(-np.pi + 1e-6, np.pi - 1e-6)
)
@settings(max_examples=200, derandomize=True, deadline=None)
def test_mariners_angles_undo_the_rotation(heading, pitch, roll):
    found = mariners_angles(world_R_body(heading, pitch, roll))[0]
    assert np.exp(1j * found[0]) == pytest.approx(np.exp(1j * heading), abs=1e-9)
    assert found[1:] == pytest.approx([pitch, roll], abs=1e-9)
    assert 0.0 <= found[0] < 2.0 * np.pi


@NAMES
def test_at_nodes_it_is_the_nodes_own(name):
    track = smoothed(name)
    states = track.at(track.t)
    np.testing.assert_allclose(states.position, track.position, atol=1e-9)
    np.testing.assert_allclose(states.rotation, track.rotation, atol=1e-12)
    np.testing.assert_allclose(states.velocity, track.velocity, atol=1e-9)
    np.testing.assert_allclose(states.covariance, track.covariance, rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(states.pose_covariance, track.pose_covariance, rtol=1e-7, atol=1e-12)
    velocity = track.joint.node[:, 3:6, 3:6]
    # By central differences.
    np.testing.assert_allclose(states.velocity_covariance, velocity, rtol=1e-6, atol=1e-9)


@NAMES
def test_the_covariances_are_the_solvers(name):
    """The position's block of the pose, and of the joint of position and velocity, are one."""
    track = smoothed(name)
    np.testing.assert_allclose(track.pose_covariance[:, :3, :3], track.covariance, atol=1e-12)
    np.testing.assert_allclose(track.joint.node[:, :3, :3], track.covariance, atol=1e-12)
    assert np.linalg.eigvalsh(track.pose_covariance).min() > -1e-12


@pytest.mark.parametrize("name", ["pose3, motion prior alone", "pose2, hard turns"])
def test_between_nodes_the_mean_is_gtsams(name):
    """GTSAM's interpolated factor around a prior on the pose."""
    track = smoothed(name)
    planar = name.startswith("pose2")
    kind = gtsam.WnoaInterpFactorPose2 if planar else gtsam.WnoaInterpFactorPose3
    body = np.einsum("nji,nj->ni", track.rotation, track.velocity)
    rng = np.random.default_rng(0)
    for k in rng.choice(len(track.t) - 1, 12, replace=False):
        time = track.t[k] + rng.uniform(0.2, 0.8) * (track.t[k + 1] - track.t[k])
        values = gtsam.Values()
        for i in (k, k + 1):
            turn, twist = track.rotation[i], np.concatenate([track.rate[i], body[i]])
            if planar:
                yaw = np.arctan2(turn[1, 0], turn[0, 0])
                values.insert(X(i), gtsam.Pose2(*track.position[i, :2], yaw))
                values.insert(V(i), np.array([body[i, 0], body[i, 1], track.rate[i, 2]]))
            else:
                values.insert(X(i), gtsam.Pose3(gtsam.Rot3(turn), track.position[i]))
                values.insert(V(i), twist)
        states = track.at(time)
        turn = states.rotation[0]
        if planar:
            yaw = np.arctan2(turn[1, 0], turn[0, 0])
            here = gtsam.Pose2(*states.position[0, :2], yaw)
            inner = gtsam.PriorFactorPose2(X(10**6), here, gtsam.noiseModel.Unit.Create(3))
        else:
            here = gtsam.Pose3(gtsam.Rot3(turn), states.position[0])
            inner = gtsam.PriorFactorPose3(X(10**6), here, gtsam.noiseModel.Unit.Create(6))
        ends = {gtsam.StateData(X(i), V(i), track.t[i]) for i in (k, k + 1)}
        between = {gtsam.StateData(X(10**6), V(10**6), time)}
        factor = kind(inner, ends, between, np.ones(3 if planar else 6), True)
        np.testing.assert_allclose(factor.unwhitenedError(values), 0.0, atol=1e-7)


@NAMES
def test_velocities_are_the_positions_rate_of_change(name):
    track = smoothed(name)
    rng = np.random.default_rng(1)
    k = rng.choice(len(track.t) - 1, 40)
    times = track.t[k] + rng.uniform(0.1, 0.9, 40) * np.diff(track.t)[k]
    before, after = track.at(times - 1e-4), track.at(times + 1e-4)
    slope = (after.position - before.position) / 2e-4
    np.testing.assert_allclose(track.at(times).velocity, slope, atol=1e-5)


@NAMES
def test_covariances_between_nodes_by_simulation(name):
    """Both nodes' errors drawn at random and carried through the interpolation."""
    track = smoothed(name)
    size, rng = 4000, np.random.default_rng(2)
    k = len(track.t) // 2 + int(np.argmax(np.diff(track.t[len(track.t) // 2 :][:6])))
    time = 0.6 * track.t[k + 1] + 0.4 * track.t[k]
    pairs = track.motion.pairs(np.array([k]))[0]
    values, vectors = np.linalg.eigh(pairs)
    # Small enough to be linear, whatever the track's own sigmas are.
    small = 1e-3
    root = small * vectors * np.sqrt(np.maximum(values, 0.0))
    drawn = rng.standard_normal((size, 24)) @ root.T
    places, turns, speeds = [], [], []
    middle = track.at(time)
    body = np.einsum("nji,nj->ni", track.rotation, track.velocity)[k : k + 2]
    for error in drawn.reshape(size, 2, 12):
        turned = [track.rotation[k + i] @ expm(error[i, 3:6]) for i in (0, 1)]
        moved = [track.position[k + i] + track.rotation[k + i] @ error[i, :3] for i in (0, 1)]
        speed = [turned[i] @ (body[i] + error[i, 6:9]) for i in (0, 1)]
        two = replace(
            track,
            t=track.t[k : k + 2],
            position=np.array(moved),
            velocity=np.array(speed),
            rotation=np.array(turned),
            rate=track.rate[k : k + 2] + error[:, 9:],
        )
        path, rates = two._path(np.zeros(1, int), np.diff(two.t), np.array([0.6]))
        places.append(path.position[0] - middle.position[0])
        relative = middle.rotation[0].T @ path.rotation[0]
        turns.append(middle.rotation[0] @ Rotation.from_matrix(relative).as_rotvec())
        speeds.append(path.rotation[0] @ path.twist(rates)[0, :3] - middle.velocity[0])
    poses = np.concatenate([places, turns], axis=1) / small
    own_pose, own_speed = (
        track._own(np.diff(track.t)[k : k + 1], np.array([0.6]), d) for d in (0, 1)
    )
    turn = np.kron(np.eye(2), middle.rotation[0])
    expected = np.cov(poses.T) + turn @ np.diag(own_pose[0]) @ turn.T
    held = np.diag(expected) > 1e-15
    kept = np.ix_(held, held)
    assert gap_of(middle.pose_covariance[0][kept][None], expected[kept][None]) < 0.08
    spread = np.cov(np.array(speeds).T / small) + np.diag(own_speed[0, :3])
    held = np.diag(spread) > 1e-12
    kept = np.ix_(held, held)
    assert gap_of(middle.velocity_covariance[0][kept][None], spread[kept][None]) < 0.1


def expm(vector: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(vector).as_matrix()


@pytest.mark.parametrize("node", ["pose2", "pose3"])
def test_extra_nodes_say_the_same(node):
    """A node that no measurement asks for changes nothing: the prior is Markov.

    Its mean on a constant twist exactly so; covariances to the prior's own linearisation about each
    node, whose share grows with the turn between nodes (here 0.07 rad).
    """
    truth = screw() if node == "pose3" else screw(climb=0.0, pitch=0.0, roll=0.0)
    rng, profile = np.random.default_rng(4), SoundSpeedProfile.constant(1500.0)
    pings = np.arange(1.0, 60.0, 3.0)
    ends = two_way_pings(truth, beacons(), pings, Sea(profile), rng, noise=0.0)
    nodes = np.union1d(ends.t_transmit, ends.t_receive)
    segment = Segment(
        two_way_range=ends,
        attitude=ahrs(truth, nodes),
        depth=pressure(truth, nodes, rng, noise=0.0),
    )
    options = Options(
        node=node,
        loss="none",
        acceleration_psd=1e-3,
        vertical_acceleration_psd=1e-3,
        angular_acceleration_psd=1e-6,
        estimate_sound_speed=False,
        heading_bias_sigma_deg=0.0,
    )
    mission = Mission((segment,), beacons(), profile, options=options)
    model = replace(model_segment(segment, options), t=nodes)
    plain = solved_with(mission, model, truth)
    gaps = np.diff(nodes)
    wide = np.flatnonzero(gaps > 1.0)
    times = nodes[wide] + gaps[wide] * rng.uniform(0.3, 0.7, len(wide))
    # No attitude is read there: each record counts at the node nearest to it.
    finer = solved_with(mission, replace(model, t=np.union1d(nodes, times)), truth)
    at, there = plain.at(times), np.searchsorted(finer.t, times)
    np.testing.assert_allclose(at.position, finer.position[there], atol=1e-5)
    np.testing.assert_allclose(at.rotation, finer.rotation[there], atol=1e-6)
    np.testing.assert_allclose(at.velocity, finer.velocity[there], atol=1e-5)
    held = [0, 1, 5] if node == "pose2" else [0, 1, 2, 3, 4, 5]
    kept = np.ix_(np.arange(len(times)), held, held)
    assert gap_of(at.pose_covariance[kept], finer.pose_covariance[there][kept]) < 5e-3
    held = held[:2] if node == "pose2" else held[:3]
    kept = np.ix_(np.arange(len(times)), held, held)
    speeds = finer.joint.node[there, 3:6, 3:6]
    assert gap_of(at.velocity_covariance[kept], speeds[kept]) < 5e-3


def solved_with(mission, model, truth) -> PoseTrajectory:
    """The trajectory with the nodes that the model has, begun at the truth."""
    problem = build_problem(mission, [model])
    layout, x = problem.layout, np.zeros(problem.layout.size)
    t, planar = layout.chains[0].t, layout.node == "pose2"
    rotation = truth.rotation(t)
    layout.put(x, "position", truth.position(t)[:, : 2 if planar else 3])
    vector = Rotation.from_matrix(rotation).as_rotvec()
    layout.put(x, "rotation", vector[:, 2:] if planar else vector)
    body = np.einsum("nji,nj->ni", rotation, truth.velocity(t))
    layout.put(x, "velocity", body[:, : 2 if planar else 3])
    rate = truth.angular_rate(t)
    layout.put(x, "rate", rate[:, 2:] if planar else rate)
    solution = solve(BandedEngine(problem), x)
    assert solution.converged, solution.trouble
    marginals = Marginals(problem, solution)
    return pose_trajectory(problem, solution.x, marginals, layout.chains[0], mission.options)


# -- what nodes without velocities say --


@pytest.mark.parametrize("name", ["pose3, odometry", "pose2, odometry"])
def test_still_nodes_move_by_constant_twists(name):
    track = smoothed(name)
    assert track.still
    k = np.arange(len(track.t) - 1)
    dt = np.diff(track.t)
    for i in k[::9]:
        one = gtsam.Pose3(gtsam.Rot3(track.rotation[i]), track.position[i])
        two = gtsam.Pose3(gtsam.Rot3(track.rotation[i + 1]), track.position[i + 1])
        twist = gtsam.Pose3.Logmap(one.between(two))
        half = one.compose(gtsam.Pose3.Expmap(0.5 * twist))
        states = track.at(0.5 * (track.t[i] + track.t[i + 1]))
        np.testing.assert_allclose(states.position[0], half.translation(), atol=1e-9)
        np.testing.assert_allclose(states.rotation[0], half.rotation().matrix(), atol=1e-9)
        np.testing.assert_allclose(track.rate[i], twist[:3] / dt[i], atol=1e-9)
        speed = track.rotation[i] @ twist[3:] / dt[i]
        np.testing.assert_allclose(track.velocity[i], speed, atol=1e-9)
        # Between nodes its length is the same all the way.
        assert np.linalg.norm(states.velocity) == pytest.approx(np.linalg.norm(speed), rel=1e-9)
    sigma = np.sqrt(np.einsum("nii->ni", track.joint.node[:, 3:, 3:]))
    seen = slice(0, 2 if name.startswith("pose2") else 3)
    assert (sigma[:, seen] > 0.0).all()
    assert (sigma < 10.0).all()


def test_what_a_plane_holds_is_known_between_nodes_too():
    """Up, roll and pitch do not wander where they are no unknowns."""
    for name in ("pose2, hard turns", "pose2, odometry"):
        track = smoothed(name)
        times = 0.5 * (track.t[1:] + track.t[:-1])
        for states in (track.at(track.t), track.at(times)):
            held = states.pose_covariance[:, [2, 3, 4]]
            np.testing.assert_allclose(held, 0.0, atol=1e-12)
            np.testing.assert_allclose(states.velocity_covariance[:, 2], 0.0, atol=1e-9)


# -- frames --


def still_node(rotation: np.ndarray, motion: np.ndarray) -> PoseTrajectory:
    """One node with a covariance of what moves and turns it in its own axes."""
    zero = np.zeros((1, 3))
    node = NodeCovariance(motion[None], np.empty((0, 12, 12)))
    return PoseTrajectory(
        np.array([5.0]),
        zero,
        zero,
        None,
        (rotation @ motion[:3, :3] @ rotation.T)[None],
        (1.0, 1.0),
        NodeCovariance(np.zeros((1, 6, 6)), np.empty((0, 6, 6))),
        rotation[None],
        zero,
        node,
    )


def test_pose_covariances_stand_in_the_worlds_axes_translation_first():
    """A vehicle heading east, rolled 90 degrees to starboard: its left axis points up.

    It is unsure by 1 m ahead, 2 m to its left, 3 m along its top, and by 0.01 rad about its bow,
    0.02 about its left, 0.03 about its top.
    """
    rotation = world_R_body(0.5 * np.pi, 0.0, 0.5 * np.pi)[0]
    np.testing.assert_allclose(rotation @ [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], atol=1e-12)
    sigmas = np.array([1.0, 2.0, 3.0, 0.01, 0.02, 0.03] + [0.0] * 6)
    motion = np.diag(sigmas**2)
    motion[0, 4] = motion[4, 0] = 0.005  # ahead goes with a turn about the left axis
    track = still_node(rotation, motion)
    east, north, up = track.pose_covariance[0, :3, :3].diagonal() ** 0.5
    assert (east, north, up) == pytest.approx((1.0, 3.0, 2.0))
    about = track.pose_covariance[0, 3:, 3:].diagonal() ** 0.5
    assert about == pytest.approx((0.01, 0.03, 0.02))
    # East goes with a turn about up.
    assert track.pose_covariance[0, 0, 5] == pytest.approx(0.005)
    states = track.at(5.0)
    np.testing.assert_array_equal(states.pose_covariance, track.pose_covariance)
    np.testing.assert_allclose(states.covariance, track.pose_covariance[:, :3, :3])
    np.testing.assert_allclose(np.rad2deg(track.attitude), [[90.0, 0.0, 90.0]], atol=1e-9)


def test_the_headings_variance_is_that_about_up():
    """Of a planar vehicle: the square of what the solver says of the yaw."""
    mission, _ = planar_vehicle(3, duration=60.0)
    track = smooth(mission).segments[0].trajectory
    problem = problem_of(mission)
    layout, x = problem.layout, np.zeros(problem.layout.size)
    bow = track.rotation[:, :, 0]
    layout.put(x, "position", track.position[:, :2])
    layout.put(x, "rotation", np.arctan2(bow[:, 1], bow[:, 0])[:, None])
    solution = solve(BandedEngine(problem), x)
    yaw = Marginals(problem, solution).of("rotation")[:, 0, 0]
    np.testing.assert_allclose(track.pose_covariance[:, 5, 5], yaw, rtol=1e-4)


def test_times_outside_are_refused():
    track = smoothed("pose3, odometry")
    for wrong in (track.t[0] - 1e-3, np.nan, [[track.t[0]]]):
        with pytest.raises(TimeError):
            track.at(wrong)


def test_many_times_are_as_one():
    track = smoothed("pose3, motion prior alone")
    times = np.random.default_rng(1).uniform(track.t[0], track.t[-1], 9000)
    states = track.at(times)
    for i in (0, 4095, 4096, 8999):
        one = track.at(times[i])
        for name in ("position", "rotation", "velocity", "pose_covariance", "velocity_covariance"):
            np.testing.assert_allclose(
                getattr(states, name)[i], getattr(one, name)[0], rtol=1e-9, atol=1e-12
            )
