"""Every residual against finite differences and against formulas written out anew."""

import numpy as np
import pytest
from problems import BEACONS, PROFILE, everything, problem_of, state_of

from ubl_graph.acoustics import straight
from ubl_graph.attitude import AttitudeTrack
from ubl_graph.factors.odometry import Preintegration
from ubl_graph.frames import world_R_body
from ubl_graph.measurements import Attitude, Velocity

CASES = {
    "wnoa": {},
    "wnoj": {"motion": "constant_acceleration"},
    "straight rays": {"rays": "straight"},
    "beacons known": {"estimate_beacons": False},
    "no sound-speed state": {"estimate_sound_speed": False},
    "spaced nodes": {"travel_time_sigma": 1e-2, "acceleration_psd": 1e-5},
}


@pytest.mark.parametrize("options", CASES.values(), ids=CASES)
@pytest.mark.parametrize("seed", [1, 2])
def test_every_jacobian_matches_finite_differences(options, seed):
    problem = problem_of(everything(seed, **options))
    x = state_of(problem, seed)
    names = {block.name for block in problem.blocks}
    assert {
        "motion",
        "odometry",
        "water odometry",
        "velocity",
        "depth",
        "position",
        "start prior",
        "two_way_range",
        "one_way_range",
        "clock walk",
        "current walk",
    } <= names
    for block in problem.blocks:
        held = block.frozen(x)
        _, jacobian = block.evaluate(x, held)
        assert jacobian is not None
        dense = np.zeros((*jacobian.shape[:2], problem.layout.size))
        for row, columns in enumerate(block.columns):
            np.add.at(dense[row].T, columns[columns >= 0], jacobian[row][:, columns >= 0].T)
        for column in np.unique(block.columns[block.columns >= 0]):
            step = np.zeros(problem.layout.size)
            step[column] = 1e-3
            forward, _ = block.evaluate(x + step, held, jacobian=False)
            backward, _ = block.evaluate(x - step, held, jacobian=False)
            numeric = (forward - backward) / 2e-3
            scale = 1.0 + np.abs(numeric).max()
            np.testing.assert_allclose(
                dense[:, :, column], numeric, atol=3e-6 * scale, err_msg=block.name
            )


@pytest.mark.parametrize("options", CASES.values(), ids=CASES)
def test_a_row_alone_is_the_row_in_the_batch(options):
    problem = problem_of(everything(3, **options))
    x = state_of(problem, 3)
    for block in problem.blocks:
        held = block.frozen(x)
        whole, jacobians = block.evaluate(x, held)
        assert jacobians is not None
        for i in range(len(block.columns)):
            one, jacobian = block.evaluate(x, held, slice(i, i + 1))
            np.testing.assert_allclose(one[0], whole[i], rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(jacobian[0], jacobians[i], rtol=1e-7, atol=1e-9)


def test_two_way_residual_is_the_travel_time_written_out_by_hand():
    mission = everything(5, rays="straight", acceleration_psd=10.0)  # no node is spared
    problem = problem_of(mission)
    x = state_of(problem, 5)
    layout, chain = problem.layout, problem.layout.chains[0]
    pings, segment = mission.segments[0].two_way_range, mission.segments[0]
    block = next(b for b in problem.blocks if b.name == "two_way_range")
    residual, _ = block.evaluate(x)
    position, log_scale = layout.get(x, "position"), layout.get(x, "sound_speed")[:, 0]
    beacons = {b.name: layout.get(x, f"beacon {b.name}") for b in BEACONS}
    track = AttitudeTrack(segment.attitude)
    for i in range(len(pings)):
        expected = -pings.travel_time[i]
        for t in (pings.t_transmit[i], pings.t_receive[i]):
            node = int(np.argmin(np.abs(chain.t - t)))
            assert chain.t[node] == t
            antenna = position[node] + track.at(np.array([t]))[0] @ [0.3, 0.2, -0.5]
            flight = straight(PROFILE, antenna, beacons[str(pings.beacon[i])]).time[0]
            expected += flight * np.exp(log_scale[node])
        assert residual[i, 0] == pytest.approx(expected / pings.sigma[i], rel=1e-9, abs=1e-7)


def test_one_way_residual_holds_the_clock_offset():
    mission = everything(6, rays="straight", estimate_sound_speed=False)
    problem = problem_of(mission)
    x = state_of(problem, 6)
    block = next(b for b in problem.blocks if b.name == "one_way_range")
    before, _ = block.evaluate(x)
    layout = problem.layout
    layout.put(x, "clock_offset", layout.get(x, "clock_offset") + 2e-3)
    after, _ = block.evaluate(x)
    np.testing.assert_allclose((after - before)[:, 0], 2e-3 / 3e-4, rtol=1e-6)


def test_interpolation_variance_is_projected_on_the_line_of_sight():
    """A ping between two nodes of a level track straight above the beacon sees the vertical."""
    mission = everything(7, rays="straight", travel_time_sigma=1e-2)
    problem = problem_of(mission)
    block = next(b for b in problem.blocks if b.name == "two_way_range")
    x = state_of(problem, 7)
    held = block.frozen(x)
    assert (held >= block.sigma).all()
    pings, nodes = mission.segments[0].two_way_range, problem.layout.chains[0].t
    t_out, t_back = pings.t_transmit, pings.t_receive
    at_nodes = np.isin(t_out, nodes) & np.isin(t_back, nodes)
    np.testing.assert_array_equal(held[at_nodes], block.sigma[at_nodes])


def helix(t: np.ndarray) -> tuple[Attitude, np.ndarray]:
    heading = 0.05 * t
    return Attitude(t, heading, 0.0, 0.0), heading


def test_preintegration_of_a_turn_is_the_integral_of_its_world_velocity():
    t = np.linspace(0.0, 60.0, 6001)
    attitude, heading = helix(t)
    samples = Preintegration(Velocity(t, 1.5, 0.2, -0.1), AttitudeTrack(attitude), 1e-3)
    t0, t1 = np.array([0.0, 10.005, 33.3]), np.array([20.0, 40.0, 33.9])
    moved = samples.between(t0, t1)
    assert moved.covered.all()
    rate = 0.05

    def integral(a, b):
        s, c = (
            (np.cos(rate * a) - np.cos(rate * b)) / rate,
            (np.sin(rate * b) - np.sin(rate * a)) / rate,
        )
        return np.stack([1.5 * s + 0.2 * c, 1.5 * c - 0.2 * s, 0.1 * (b - a)], axis=1)

    np.testing.assert_allclose(moved.displacement, integral(t0, t1), atol=2e-5)
    del heading


def test_preintegration_derivatives_match_velocities_with_those_errors():
    """Bias and misalignment put into the samples give the displacement's linear change."""
    t = np.linspace(0.0, 30.0, 301)
    attitude, _ = helix(t)
    rng = np.random.default_rng(8)
    body = np.column_stack([1.0 + 0.1 * rng.normal(size=301), 0.1 * rng.normal(size=(301, 2))])
    track = AttitudeTrack(attitude)
    t0, t1 = np.array([2.03]), np.array([27.77])

    def moved(flu):
        return Preintegration(Velocity(t, flu[:, 0], -flu[:, 1], -flu[:, 2]), track, 1e-3).between(
            t0, t1
        )

    base = moved(body)
    for axis in range(3):
        unit = np.eye(3)[axis] * 1e-3
        by_bias = (moved(body + unit).displacement - base.displacement)[0] / 1e-3
        np.testing.assert_allclose(base.by_bias[0][:, axis], by_bias, atol=1e-9)
        turned = (moved(body + np.cross(unit, body)).displacement - base.displacement)[0] / 1e-3
        np.testing.assert_allclose(base.by_misalignment[0][:, axis], turned, atol=1e-9)


def test_white_velocity_noise_adds_up_to_the_displacement_sigma():
    t = np.arange(0.0, 200.0, 0.5)
    rng = np.random.default_rng(9)
    track = AttitudeTrack(Attitude(0.0, 0.3))
    noise = 0.05 * rng.normal(size=(400, len(t)))
    ends = np.array([10.2]), np.array([150.4])
    displacements = [
        Preintegration(Velocity(t, row, 0.0, 0.0, 0.05), track, 1e-9).between(*ends).displacement[0]
        for row in noise
    ]
    along = world_R_body(0.3, 0.0, 0.0)[0][:, 0]
    spread = np.std(np.array(displacements) @ along)
    stated = (
        Preintegration(Velocity(t, noise[0], 0.0, 0.0, 0.05), track, 1e-9).between(*ends).sigma[0]
    )
    assert stated == pytest.approx(spread, rel=0.1)


def test_gaps_in_the_velocities_interrupt_the_odometry():
    t = np.concatenate([np.arange(0.0, 10.0, 0.2), np.arange(20.0, 30.0, 0.2)])
    samples = Preintegration(Velocity(t, 1.0, 0.0, 0.0), AttitudeTrack(Attitude(0.0, 0.0)), 1e-3)
    covered = samples.between(
        np.array([0.0, 9.0, 12.0, 21.0, -5.0]), np.array([9.8, 21.0, 15.0, 29.0, 3.0])
    ).covered
    np.testing.assert_array_equal(covered, [True, False, False, True, False])
    np.testing.assert_allclose(samples.breaks(), [0.0, 9.8, 20.0, 29.8])
