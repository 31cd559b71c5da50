"""Between nodes a trajectory knows what a node there would know: extra nodes are the oracle.

A node that no measurement asks for changes nothing (the prior is Markov), so the covariance that a
problem with extra nodes has there is the one that `Trajectory.at` must give without them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ubl_graph import Beacon, Mission, Options, Segment, SoundSpeedProfile, TimeError, smooth
from ubl_graph.builder import SegmentModel
from ubl_graph.graph import build_problem, model_segment
from ubl_graph.sim import Sea, constant_velocity, pressure, straight_pass, two_way_pings
from ubl_graph.solve.banded import BandedEngine
from ubl_graph.solve.marginals import Marginals
from ubl_graph.solve.rounds import solve
from ubl_graph.trajectory import NodeCovariance, Trajectory

MOTIONS = pytest.mark.parametrize("motion", ["constant_velocity", "constant_acceleration"])


def two_segments() -> Mission:
    """Two passes over unknown beacons."""
    rng = np.random.default_rng(4)
    truth = constant_velocity([-60.0, 20.0, -60.0], [0.8, 0.2, 0.0], (0.0, 200.0))
    profile = SoundSpeedProfile.constant(1495.0)
    places = ([150.0, 100.0, -120.0], [-150.0, 90.0, -118.0], [10.0, -160.0, -122.0])
    beacons = tuple(
        Beacon(f"B{i}", place, sigma=1.0, turnaround=0.5) for i, place in enumerate(places)
    )
    segments = []
    for name, first in (("A", 0.0), ("B", 110.0)):
        sent = first + np.arange(0.0, 60.0, 4.0)
        pings = two_way_pings(truth, beacons, sent, Sea(profile), rng)
        levels = pressure(truth, np.arange(first, first + 60.0, 3.0), rng)
        segments.append(Segment(name, pings, depth=levels))
    options = Options(estimate_beacons=True, loss="none")
    return Mission(tuple(segments), beacons, profile, options=options)


def smoothed(mission: Mission, model: SegmentModel, start: Trajectory | None) -> Trajectory:
    """The trajectory with the nodes that the model has."""
    problem = build_problem(mission, [model])
    layout = problem.layout
    x = np.zeros(layout.size)
    truth = np.stack([-200.0 + 1.5 * model.t, -40.0 + 0.5 * model.t, 0.0 * model.t - 60.0], axis=1)
    layout.put(x, "position", truth if start is None else start.at(model.t).position)
    solution = solve(BandedEngine(problem), x)
    assert solution.converged
    marginals = Marginals(problem, solution)
    states = ["position", "velocity", "acceleration"][: layout.order]
    joint = NodeCovariance(marginals.joint(states), marginals.following(states))
    parts = [layout.get(solution.x, name) for name in states]
    third = parts[2] if layout.order == 3 else None
    covariance = joint.node[:, :3, :3]
    return Trajectory(model.t, parts[0], parts[1], third, covariance, problem.psd, joint)


@MOTIONS
def test_extra_nodes_say_the_same(motion):
    """Pings only: other measurements between nodes would move to the extra ones."""
    options = Options(
        motion=motion,
        loss="none",
        vertical_acceleration_psd=1e-4,
        jerk_psd=1e-3,
        vertical_jerk_psd=1e-5,
    )
    mission, _ = straight_pass(4, options=options)
    mission = replace(mission, segments=(replace(mission.segments[0], depth=None),))
    model = model_segment(mission.segments[0], mission.options)
    pings = mission.segments[0].two_way_range
    model = replace(model, t=np.union1d(pings.t_transmit, pings.t_receive))  # none thinned out
    plain = smoothed(mission, model, None)
    rng = np.random.default_rng(0)
    # One time in every interval that is long enough for it.
    gaps = np.diff(plain.t)
    wide = np.flatnonzero(gaps > 1.5)
    times = plain.t[wide] + gaps[wide] * rng.uniform(0.3, 0.7, len(wide))
    finer = smoothed(mission, replace(model, t=np.union1d(model.t, times)), plain)
    at, there = plain.at(times), np.searchsorted(finer.t, times)
    np.testing.assert_allclose(at.position, finer.position[there], atol=1e-5)
    np.testing.assert_allclose(at.velocity, finer.velocity[there], atol=1e-5)
    for name, block in (("covariance", slice(0, 3)), ("velocity_covariance", slice(3, 6))):
        found, expected = getattr(at, name), finer.joint.node[there, block, block]
        sigma = np.sqrt(np.einsum("nii->ni", expected))
        gap = np.abs(found - expected) / (sigma[:, :, None] * sigma[:, None, :])
        # What normal equations of condition 1e12 leave of double precision.
        assert gap.max() < 1e-4, name


@MOTIONS
def test_at_nodes_it_is_the_nodes_own(motion):
    mission, _ = straight_pass(4, options=Options(motion=motion))
    track = smooth(mission).segments[0].trajectory
    states = track.at(track.t)
    np.testing.assert_allclose(states.covariance, track.covariance, rtol=1e-9, atol=1e-12)
    velocity = track.joint.node[:, 3:6, 3:6]
    np.testing.assert_allclose(states.velocity_covariance, velocity, rtol=1e-9, atol=1e-12)
    assert np.linalg.eigvalsh(states.velocity_covariance).min() > 0.0


def test_many_times_are_as_one():
    """They are taken in portions; in any order and number the answer is the same."""
    mission, _ = straight_pass(4)
    track = smooth(mission).trajectory
    times = np.random.default_rng(1).uniform(track.t[0], track.t[-1], 40_000)
    states = track.at(times)
    for i in (0, 16_383, 16_384, 39_999):
        one = track.at(times[i])
        np.testing.assert_allclose(states.covariance[i], one.covariance[0], rtol=1e-12)
        np.testing.assert_allclose(
            states.velocity_covariance[i], one.velocity_covariance[0], rtol=1e-12
        )


def test_segments_that_share_unknowns_know_their_own_neighbours():
    """The second segment alone, with what both know of the beacons, against both together."""
    mission = two_segments()
    together = smooth(mission)
    problem = build_problem(mission, [model_segment(s, mission.options) for s in mission.segments])
    layout, x = problem.layout, np.zeros(problem.layout.size)
    for name in ("position", "velocity"):
        layout.put(x, name, getattr(together.trajectory, name))
    layout.put(
        x, "sound_speed", np.concatenate([s.slow["sound_speed"].value for s in together.segments])
    )
    for beacon in mission.beacons:
        layout.put(x, f"beacon {beacon.name}", together.beacons[beacon.name].value)
    _, jacobian = problem.linearize(x, problem.frozen(x))
    matrix = (jacobian.T @ jacobian).toarray()
    scale = 1.0 / np.sqrt(matrix.diagonal())
    inverse = np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale)
    for chain, segment in zip(layout.chains, together.segments, strict=True):
        nodes = np.arange(layout.node_count)[chain.nodes]
        columns = np.concatenate(
            [layout.node_columns(n, nodes) for n in ("position", "velocity")], 1
        )
        for k in (0, len(nodes) // 2, len(nodes) - 2):
            expected = inverse[np.ix_(columns[k], columns[k + 1])]
            sigma = np.sqrt(inverse.diagonal())
            gap = np.abs(segment.trajectory.joint.following[k] - expected)
            assert (gap / np.outer(sigma[columns[k]], sigma[columns[k + 1]])).max() < 1e-4


def test_all_segments_answer_as_each_does():
    result = smooth(two_segments())
    times = np.array([115.3, 20.2, 161.7, 3.1])
    whole = result.trajectory.at(times)
    for i, name in enumerate(("B", "A", "B", "A")):
        one = result.trajectory[name].at(times[i])
        for field in ("position", "velocity", "covariance", "velocity_covariance"):
            found, expected = getattr(whole, field)[i], getattr(one, field)[0]
            np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-15)


def test_a_single_node_has_its_own_covariances():
    node = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])[None]
    joint = NodeCovariance(node, np.empty((0, 6, 6)))
    zero = np.zeros((1, 3))
    one = Trajectory(np.array([5.0]), zero, zero, None, node[:, :3, :3], (1.0, 1.0), joint)
    np.testing.assert_array_equal(one.at(5.0).covariance[0], np.diag([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(one.at(5.0).velocity_covariance[0], np.diag([4.0, 5.0, 6.0]))


def test_times_in_two_dimensions_are_refused():
    track = smooth(straight_pass(4)[0]).trajectory
    for asked in (track, track[""]):
        with pytest.raises(TimeError, match="2 dimensions"):
            asked.at([[10.0, 11.0]])
