"""The marginal likelihood against densities written down in full."""

from dataclasses import replace

import numpy as np
import pytest

from ubl_graph import Mission, PositionFix, Segment, SoundSpeedProfile
from ubl_graph.builder import FREE_ACCELERATION, FREE_POSITION
from ubl_graph.factors.loss import WIDTHS
from ubl_graph.graph import build_problem, model_segment
from ubl_graph.sim import straight_pass
from ubl_graph.solve.evidence import FARTHEST, log_evidence
from ubl_graph.trajectory import process_noise, transition

T = np.array([0.0, 3.0, 7.0, 8.0, 13.0, 21.0])


def fixes(seed=3, sigma=0.5):
    """A mission of nothing but fixes: linear, and normal."""
    rng = np.random.default_rng(seed)
    east, north, up = np.cumsum(rng.normal(size=(3, len(T))), axis=1)
    rows = PositionFix(T, east, north, up, sigma)
    return Mission((Segment(position=rows),), (), SoundSpeedProfile.constant(1500.0))


def evidence(mission, **options):
    mission = replace(mission, options=replace(mission.options, **options))
    models = [model_segment(s, mission.options) for s in mission.segments]
    problem = build_problem(mission, models)
    return log_evidence(problem, np.zeros(problem.layout.size))[0]


def density(mission, order, psd, speed_sigma):
    """Log density of the fixes under the Gaussian process, each axis by its full covariance."""
    first = np.diag(np.square([FREE_POSITION, speed_sigma, FREE_ACCELERATION][:order]))
    rows = mission.segments[0].position
    at = [transition(order, t)[0] for t in T]
    cov = np.empty((len(T), len(T)))
    for i in range(len(T)):
        for j in range(i, len(T)):
            # State at T[i], carried on to T[j] by the transition alone.
            noise = process_noise(order, T[i])[0] if T[i] > 0.0 else np.zeros((order, order))
            state = at[i] @ first @ at[i].T + psd * noise
            cov[i, j] = cov[j, i] = (state @ transition(order, T[j] - T[i])[0].T)[0, 0]
    cov += np.diag(rows.sigma**2)
    # scipy's own multivariate normal calls it singular: a prior of 1e5 m beside half a metre.
    half_log_det = np.log(np.linalg.cholesky(cov).diagonal()).sum()
    each = (rows.east, rows.north, rows.up)
    return sum(-half_log_det - 0.5 * x @ np.linalg.solve(cov, x) for x in each)


@pytest.mark.parametrize(
    ("motion", "order"), [("constant_velocity", 2), ("constant_acceleration", 3)]
)
def test_differences_are_those_of_the_density(motion, order):
    mission = fixes()
    name = "acceleration_psd" if order == 2 else "jerk_psd"
    found, true = [], []
    for psd in (1e-4, 1e-2, 1.0):
        options = {"motion": motion, name: psd, "node_spacing": 1.0, "speed_sigma": 3.0}
        found.append(evidence(mission, **options))
        true.append(density(mission, order, psd, 3.0))
    assert np.diff(found) == pytest.approx(np.diff(true), abs=1e-3)


def test_two_orders_are_compared_as_their_densities_are():
    mission = fixes()
    options = {"node_spacing": 1.0, "speed_sigma": 3.0, "acceleration_psd": 0.1, "jerk_psd": 0.01}
    found = [
        evidence(mission, motion=f"constant_{m}", **options) for m in ("velocity", "acceleration")
    ]
    true = [density(mission, order, psd, 3.0) for order, psd in ((2, 0.1), (3, 0.01))]
    assert found[1] - found[0] == pytest.approx(true[1] - true[0], abs=1e-3)


def test_sigmas_of_fixes_count():
    near, far = fixes(sigma=0.5), fixes(sigma=2.0)
    options = {"node_spacing": 1.0, "speed_sigma": 3.0, "acceleration_psd": 0.01}
    found = evidence(far, **options) - evidence(near, **options)
    true = [density(m, 2, 0.01, 3.0) for m in (far, near)]
    assert found == pytest.approx(true[0] - true[1], abs=1e-3)


# Pairs of grids that span the same depths: records beyond the nodes are not used.
@pytest.mark.parametrize("spacings", [(1.0, 0.5), (0.25, 0.1)])
def test_where_nodes_stand_does_not_matter(spacings):
    mission, _ = straight_pass(seed=2)
    mission = replace(mission, options=replace(mission.options, loss="none"))
    start = straight_line(mission)
    found = [
        [start(node_spacing=s, acceleration_psd=q) for s in spacings] for q in (1e-4, 1e-3, 1e-2)
    ]
    assert np.ptp(np.diff(found, axis=1)) < 1e-3


@pytest.mark.parametrize("walk", [2e-6, 2e-5])
def test_slow_states_keep_nodes_near(walk):
    # Without motion noise a straight line needs two nodes, a sound speed that wanders more.
    mission, _ = straight_pass(seed=2, duration=600.0)
    (segment,) = mission.segments
    # Both ways of placing nodes span these depths.
    segment = replace(segment, depth=segment.depth[segment.depth.t < 596.0])
    options = {"loss": "none", "acceleration_psd": 1e-12, "sound_speed_walk": walk}
    options = replace(mission.options, **options)
    start = straight_line(replace(mission, segments=(segment,), options=options))
    assert start() == pytest.approx(start(node_spacing=4.0), abs=1.0)


def straight_line(mission):
    """The evidence with the truth for a start."""

    def value(**options):
        changed = replace(mission, options=replace(mission.options, **options))
        model = model_segment(changed.segments[0], changed.options)
        problem = build_problem(changed, [model])
        x = np.zeros(problem.layout.size)
        t = model.t[:, None]
        problem.layout.put(x, "position", [-200.0, -40.0, -60.0] + t * [1.5, 0.5, 0.0])
        problem.layout.put(x, "velocity", np.tile([1.5, 0.5, 0.0], (len(t), 1)))
        return log_evidence(problem, x)[0]

    return value


@pytest.mark.parametrize("loss", [name for name in WIDTHS if name != "none"])
def test_a_robust_loss_without_outliers_changes_nothing(loss):
    mission, _ = straight_pass(seed=4)
    values = []
    for name in ("none", loss):
        start = straight_line(replace(mission, options=replace(mission.options, loss=name)))
        values.append([start(acceleration_psd=q) for q in (1e-4, 1e-2)])
    assert np.diff(values[1]) == pytest.approx(np.diff(values[0]), abs=0.1)


@pytest.mark.parametrize("delay", [0.005, 0.05])
def test_an_outlier_costs_the_same_wherever_it_lies(delay):
    mission, _ = straight_pass(seed=4)
    pings = mission.segments[0].two_way_range
    late = np.where(np.arange(len(pings)) == 20, delay, 0.0)
    late = replace(pings, travel_time=pings.travel_time + late)
    spoiled = replace(mission, segments=(replace(mission.segments[0], two_way_range=late),))
    lone = replace(mission.segments[0], two_way_range=pings[np.arange(len(pings)) != 20])
    # Beside the mission without the ping: what an outlier may be, against a normal row's constant,
    # and what the shares of outliers say: one of 60 here, half a one of 59 there.
    share, half = 1.0 / len(pings), 0.5 / (len(pings) - 1)
    cost = np.log(share * np.sqrt(2.0 * np.pi) / (2.0 * FARTHEST))
    cost += (len(pings) - 1) * (np.log1p(-share) - np.log1p(-half))
    without = straight_line(replace(mission, segments=(lone,)))(node_spacing=1.0)
    assert straight_line(spoiled)(node_spacing=1.0) == pytest.approx(without + cost, abs=1e-2)


def test_what_is_lost_in_rounding_is_impossible():
    assert evidence(fixes(), node_spacing=0.1, acceleration_psd=1e-30) == -np.inf
