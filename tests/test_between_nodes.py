"""Between nodes a trajectory knows what a node there would know: extra nodes are the oracle.

A node that no measurement asks for changes nothing (the prior is Markov), so the covariance that a
problem with extra nodes has there is the one that `Trajectory.at` must give without them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ubl_graph import Mission, Options, smooth
from ubl_graph.graph import SegmentModel, build_problem, model_segment
from ubl_graph.sim import straight_pass
from ubl_graph.solve.banded import BandedEngine
from ubl_graph.solve.marginals import Marginals
from ubl_graph.solve.rounds import solve
from ubl_graph.trajectory import NodeCovariance, Trajectory

MOTIONS = pytest.mark.parametrize("motion", ["constant_velocity", "constant_acceleration"])


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
