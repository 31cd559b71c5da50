"""What can be calibrated: derivatives, NEES where motion shows it, and nothing where it hides."""

from dataclasses import replace

import numpy as np
import pytest
from calibrated import OPTIONS, hovering, surveyed
from scipy.stats import chi2

from ubl_graph import smooth
from ubl_graph.errors import ConfigurationError
from ubl_graph.graph import build_problem, model_segment
from ubl_graph.pose_initial import find_tracks
from ubl_graph.track import start_vector

#: Missions of the full trial.
MANY = 300


def errors_of(result, truth):
    """Error, covariance and whether it counts as observed, by the states' names."""
    found = {
        name: (s.value - truth[name], s.covariance, s.observed)
        for name, s in [*result.shared.items(), *prefixed(result.beacons)]
    }
    for name, s in result.segments[0].slow.items():
        found[name] = (s.value[0] - truth[name], np.diag(s.sigma[0] ** 2), s.observed)
    return found


def prefixed(beacons):
    return [(f"beacon {name}", s) for name, s in beacons.items()]


def test_all_states_are_estimated_and_their_covariances_are_true():
    trial(12, seed=1000)


@pytest.mark.slow
def test_all_states_are_consistent_over_many_missions():
    trial(MANY, seed=0)


def trial(count, seed):
    nees, dof = {}, {}
    for i in range(count):
        mission, truth = surveyed(seed + i)
        result = smooth(mission)
        assert result.status == "converged", result.reason
        for name, (error, covariance, observed) in errors_of(result, truth).items():
            assert observed, (i, name)
            nees[name] = nees.get(name, 0.0) + error @ np.linalg.solve(covariance, error)
            dof[name] = dof.get(name, 0) + len(error)
    assert len(nees) == 14
    for name in nees:
        # 14 states, each with a chance of 1e-4 on either side.
        low, high = chi2.ppf([1e-4, 1.0 - 1e-4], dof[name])
        assert low < nees[name] < high, (name, nees[name] / dof[name])


def test_a_motion_that_shows_nothing_leaves_all_unobserved():
    for seed in range(3):
        mission, truth = hovering(seed)
        result = smooth(mission)
        for name, (_, _, observed) in errors_of(result, truth).items():
            assert not observed, name
        assert not any(s.observable for s in result.shared.values() if s.expected is not None)


def test_what_the_start_promises_is_what_comes():
    mission, _ = surveyed(5)
    result = smooth(mission)
    for name, s in result.shared.items():
        assert s.observable, name
        ratio = np.sqrt(np.diag(s.expected)) / s.sigma
        assert ((ratio > 0.7) & (ratio < 1.5)).all(), name


@pytest.mark.parametrize("node", ["point", "pose3", "pose2"])
def test_derivatives_by_bias_and_lever_arm(node):
    mission, _ = surveyed(7)
    options = replace(OPTIONS, node=node)
    segment = replace(mission.segments[0], one_way_range=None)
    mission = replace(mission, segments=(segment,), options=options)
    model = model_segment(segment, options)
    problem = build_problem(mission, [model])
    x = start_vector(mission, problem.layout, [find_tracks(mission, model).tracks[0]])
    rng = np.random.default_rng(2)
    for name, _ in problem.layout.shared:
        columns = problem.layout.shared_columns(name)
        x[columns] += 0.1 * rng.standard_normal(len(columns))
    block = next(b for b in problem.blocks if b.name == "two_way_range")
    held = block.frozen(x)
    _, jacobian = block.evaluate(x, held)
    own = problem.layout.shared_columns("lever_arm")
    own = np.append(own, problem.layout.shared_columns("range_bias A"))
    for column in [*own, *np.unique(block.columns[10][block.columns[10] >= 0])[:6]]:
        step = np.zeros_like(x)
        step[column] = 1e-4
        high, low = (block.evaluate(x + s * step, held, jacobian=False)[0] for s in (1.0, -1.0))
        measured = (high - low)[:, 0] / 2e-4
        told = np.where(block.columns == column, jacobian[:, 0], 0.0).sum(axis=1)
        assert np.allclose(measured, told, rtol=1e-5, atol=1e-6 * np.abs(measured).max() + 1e-9)


def test_a_lever_arm_needs_an_attitude():
    mission, _ = surveyed(1)
    segment = replace(mission.segments[0], attitude=None, velocity=None)
    with pytest.raises(ConfigurationError, match="lever_arm_sigma"):
        replace(mission, segments=(segment,))
