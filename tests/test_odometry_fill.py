"""The way between nodes that odometry joins, against a graph with a node at every record."""

from dataclasses import replace

import numpy as np
import pytest

from ubl_graph import Fleet, Member, smooth, smooth_fleet
from ubl_graph.odometry_fill import filled_in
from ubl_graph.sim import PLANAR, planar_vehicle
from ubl_graph.sim.pose_sensors import odometer

#: Few ranges, so that most of the way is odometry's.
EVERY = 5


def both(node="pose2", spatial=True, **changes):
    """One vehicle's mission smoothed with nodes at all records, and as a fleet of one."""
    options = replace(PLANAR, node=node, loss="none", estimate_sound_speed=False, **changes)
    mission, truth = planar_vehicle(3, options=options, duration=300.0)
    (segment,) = mission.segments
    steps = segment.odometry
    if node == "pose3" and spatial:
        rng = np.random.default_rng(5)
        times = np.append(steps.t_from, steps.t_to[-1])
        steps = odometer(truth, times, rng, options, planar=False)
    segment = replace(
        segment,
        heading=None,
        odometry=steps,
        slant_range=segment.slant_range[::EVERY],
        start=replace(segment.start, heading=np.pi / 2.0, heading_sigma=0.5),
    )
    mission = replace(mission, segments=(segment,))
    alone = smooth(mission)
    fleet = Fleet((Member("it", segment, options=options),), mission.beacons, options=options)
    return alone, smooth_fleet(fleet).vehicles["it"]


def relative(one, other):
    """Difference of covariances by the first one's standard deviations."""
    sigma = np.sqrt(np.einsum("nii->ni", one)) + 1e-12
    return (one - other) / (sigma[:, :, None] * sigma[:, None, :])


@pytest.mark.parametrize("node", ["pose2", "pose3"])
@pytest.mark.parametrize("known", [True, False], ids=["known odometry", "odometry with errors"])
def test_the_way_between_nodes_is_that_of_a_graph_with_a_node_at_each_record(node, known):
    none = {"odometry_scale_sigma": 0.0, "odometry_turn_bias_sigma_deg": 0.0} if known else {}
    alone, together = both(node, **none)
    one, other = alone.segments[0].trajectory, together.segments[0].trajectory
    assert alone.status == together.status == "converged"
    assert np.allclose(one.t, other.t)
    apart = np.linalg.norm(one.position - other.position, axis=1)
    # A tenth of a per cent of what is not known of it.
    assert apart.max() < (0.01 if known else 0.05)
    turned = np.einsum("nji,njk->nik", one.rotation, other.rotation)
    assert np.abs(turned - np.eye(3)).max() < 1e-3
    share = 0.01 if known else 0.15
    at_nodes = np.isin(one.t, together.mission.segments[0].slant_range.t)
    for a, b, least in (
        (one.pose_covariance, other.pose_covariance, share),
        (one.pose_covariance[at_nodes], other.pose_covariance[at_nodes], 0.05),
    ):
        assert np.abs(relative(a, b)).max() < least
    # Between nodes as well, where neighbours' joint covariance has its part.
    times = np.linspace(1.0, other.t[-1] - 1.0, 57)
    here, there = one.at(times), other.at(times)
    assert np.abs(relative(here.covariance, there.covariance)).max() < share


def test_planar_odometry_holds_a_vehicle_in_space_upright_in_a_fleet_too():
    alone, together = both("pose3", spatial=False)
    one, other = alone.segments[0].trajectory, together.segments[0].trajectory
    assert np.allclose(one.position, other.position, atol=1e-4)
    assert np.abs(relative(one.pose_covariance, other.pose_covariance)).max() < 1e-3


def test_slow_states_have_as_many_rows_as_the_trajectory():
    options = replace(PLANAR, loss="none")
    mission, _ = planar_vehicle(4, options=options, duration=120.0)
    segment = replace(mission.segments[0], heading=None)
    fleet = Fleet((Member("it", segment, options=options),), mission.beacons, options=options)
    (solved,) = smooth_fleet(fleet).vehicles["it"].segments
    state = solved.slow["sound_speed"]
    assert len(state.t) == len(state.value) == len(state.sigma) == len(solved.trajectory.t)


def test_records_with_a_gap_leave_the_trajectory_as_it_is():
    _, together = both()
    track, records = together.segments[0].trajectory, together.mission.segments[0].odometry
    assert filled_in(track, records[:20], PLANAR) is track
    assert filled_in(track, records[np.arange(len(records)) != 50], PLANAR) is track
