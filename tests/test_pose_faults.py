"""Pose nodes where records are few, far apart, or at odd times: honest, or refused in words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ubl_graph import Mission, Odometry, Options, Segment, SlantRange, smooth
from ubl_graph.errors import DataError
from ubl_graph.measurements import Attitude
from ubl_graph.result import Result
from ubl_graph.sim import (
    Truth,
    drifting_heading,
    gyro,
    odometer,
    planar_vehicle,
    slant_ranges,
)


def off(result: Result, truth: Truth) -> float:
    """Horizontal rms error at the nodes, m."""
    track = result.trajectory
    gap = (track.position - truth.position(track.t))[:, :2]
    return float(np.sqrt(np.mean(np.sum(gap**2, axis=1))))


def nees(result: Result, truth: Truth) -> float:
    """Mean NEES of the horizontal error at the nodes; 2 is expected."""
    track = result.trajectory
    gap = (track.position - truth.position(track.t))[:, :2]
    solved = np.linalg.solve(track.covariance[:, :2, :2], gap[..., None])[..., 0]
    return float(np.einsum("mi,mi->m", gap, solved).mean())


def auv(seed: int = 1) -> tuple[Mission, Truth]:
    mission, truth = drifting_heading(seed, lines=2, run_in=400.0)
    return replace(mission, options=replace(mission.options, node="pose3", loss="none")), truth


def with_gyro(mission: Mission, truth: Truth, attitude: Attitude | None) -> Mission:
    segment = mission.segments[0]
    assert segment.two_way_range is not None
    begin, end = segment.two_way_range.t_transmit.min(), segment.two_way_range.t_receive.max()
    rates = gyro(truth, np.arange(begin - 1.0, end + 1.0, 0.2), np.random.default_rng(5))
    segment = replace(segment, attitude=attitude, angular_rate=rates)
    return replace(mission, segments=(segment,))


@pytest.mark.parametrize("few", [1, 40], ids=["one record", "the first records"])
def test_attitude_ends_and_the_gyro_goes_on(few):
    """What is not read is not believed: beyond the records the gyro says how the vehicle turned."""
    mission, truth = auv()
    attitude = mission.segments[0].attitude
    assert attitude is not None
    whole = smooth(with_gyro(mission, truth, attitude))
    ended = smooth(with_gyro(mission, truth, attitude[:few]))
    assert ended.status == "converged", ended.reason
    assert off(ended, truth) < off(whole, truth) + 3.0
    assert nees(ended, truth) < 8.0


def test_a_gap_of_the_attitude_without_a_gyro_leaves_the_velocities():
    mission, truth = auv()
    attitude = mission.segments[0].attitude
    assert attitude is not None
    middle = float(np.mean(attitude.t))
    gap = attitude[np.abs(attitude.t - middle) > 100.0]
    segment = replace(mission.segments[0], attitude=gap)
    result = smooth(replace(mission, segments=(segment,)))
    assert result.status != "converged" or nees(result, truth) < 8.0


def test_a_record_counts_once_however_dense_the_nodes_are():
    mission, _ = auv()
    attitude = mission.segments[0].attitude
    assert attitude is not None
    sparse = replace(mission.segments[0], attitude=attitude[::8])
    mission = replace(mission, segments=(sparse,))
    sigmas = []
    for spacing in (4.0, 1.0):
        options = replace(mission.options, node_spacing=spacing)
        track = smooth(replace(mission, options=options)).segments[0].trajectory
        sigmas.append(np.median(np.sqrt(track.pose_covariance[:, 3, 3])))
    # Four times as many nodes know no more of the roll than the records do.
    assert sigmas[1] > 0.8 * sigmas[0]


def weaving(step: float) -> tuple[Mission, Truth]:
    """A planar vehicle that weaves, with odometry steps of some length and ranges in between."""

    def motion(t):
        east, north = 1.2 * t, 12.0 * np.sin(t / 15.0)
        position = np.stack([east, north, 0.0 * t], axis=1)
        return position, np.stack([1.2 + 0.0 * t, 0.8 * np.cos(t / 15.0), 0.0 * t], axis=1)

    truth = Truth((-1.0, 260.0), motion)
    mission, _ = planar_vehicle(1)
    rng = np.random.default_rng(3)
    options = Options(node="pose2", estimate_sound_speed=False, acceleration_psd=0.02, loss="none")
    steps = odometer(truth, np.arange(0.0, 240.1, step), rng, options, planar=True)
    ranges = slant_ranges(truth, mission.beacons, np.arange(1.5, 239.0, 3.0), rng, sigma=0.3)
    segment = Segment(odometry=steps, slant_range=ranges)
    return replace(mission, segments=(segment,), options=options), truth


@pytest.mark.parametrize("step", [1.0, 5.0])
def test_ranges_between_still_nodes_know_that_the_vehicle_weaves(step):
    mission, truth = weaving(step)
    result = smooth(mission)
    assert result.status == "converged", result.reason
    assert nees(result, truth) < 6.0
    times = np.linspace(1.0, 239.0, 300)
    states = result.trajectory.at(times)
    gap = (states.position - truth.position(times))[:, :2]
    solved = np.linalg.solve(states.covariance[:, :2, :2], gap[..., None])[..., 0]
    assert np.einsum("mi,mi->m", gap, solved).mean() < 6.0


def test_a_regular_grid_keeps_nodes_at_the_ends_of_odometry():
    mission, truth = weaving(1.0)
    segment = mission.segments[0]
    # The first steps are missing, so that nodes need velocities.
    segment = replace(segment, odometry=segment.odometry[20:])
    plain = smooth(replace(mission, segments=(segment,)))
    options = replace(mission.options, node_spacing=5.0)
    grid = smooth(replace(mission, segments=(segment,), options=options))
    assert np.isin(segment.odometry.t_from, grid.trajectory.t).all()
    assert off(grid, truth) < off(plain, truth) + 0.3


def test_steps_that_do_not_join_need_the_motion_prior():
    """0-2, 1-3, 2-4: two chains that know nothing of each other."""
    mission, truth = weaving(1.0)
    rng = np.random.default_rng(4)
    chains = [
        odometer(truth, np.arange(first, 240.1, 2.0), rng, mission.options, planar=True)
        for first in (0.0, 1.0)
    ]
    names = ("t_from", "t_to", "forward", "right", "about_down")
    hops = Odometry(**{n: np.concatenate([getattr(c, n) for c in chains]) for n in names})
    result = smooth(replace(mission, segments=(replace(mission.segments[0], odometry=hops),)))
    assert result.status == "converged", result.reason
    assert off(result, truth) < 1.0


@pytest.mark.parametrize("name", ["travel_time_sigma", "sound_speed_walk"])
def test_noise_of_odometry_missions_is_left_to_the_data(name):
    mission, truth = weaving(1.0)
    options = replace(mission.options, **{name: "auto", "estimate_sound_speed": True})
    result = smooth(replace(mission, options=options))
    assert result.status == "converged", result.reason
    assert off(result, truth) < 1.0


def test_noise_of_zero_is_none_but_still_some():
    mission, truth = weaving(1.0)
    silent = {
        f"odometry_{n}": 0.0
        for n in ("way_noise", "time_noise", "way_turn_noise_deg", "time_turn_noise_deg")
    }
    result = smooth(replace(mission, options=replace(mission.options, **silent)))
    assert off(result, truth) < 1.0


def test_steps_that_take_no_time_are_refused():
    with pytest.raises(DataError, match="check the unit"):
        Odometry([0.0, 1e-6], [1e-6, 2e-6], 1.0, 0.0)


def test_planar_odometry_leaves_a_spatial_vehicle_upright():
    mission, truth = weaving(1.0)
    result = smooth(replace(mission, options=replace(mission.options, node="pose3")))
    track = result.segments[0].trajectory
    assert np.abs(track.attitude[:, 1:]).max() < np.deg2rad(15.0)
    assert off(result, truth) < 1.0


def test_a_start_is_believed_beside_a_compass_that_is_far_off():
    """One beacon: nothing but the start tells how far the heading reference is off."""
    mission, truth = auv(2)
    segment = mission.segments[0]
    assert segment.attitude is not None
    turned = replace(segment.attitude, heading=segment.attitude.heading + np.deg2rad(25.0))
    options = replace(mission.options, heading_bias_sigma_deg=20.0)
    result = smooth(
        replace(mission, segments=(replace(segment, attitude=turned),), options=options)
    )
    assert not any("left out" in text for text in result.warnings)
    assert off(result, truth) < 15.0


def test_one_slant_range_alone_is_no_track():
    mission, _ = weaving(1.0)
    alone = SlantRange(10.0, mission.beacons[0].name, 100.0)
    result = smooth(replace(mission, segments=(replace(mission.segments[0], slant_range=alone),)))
    assert result.status == "unobservable"
