"""Compounded odometry: against one-by-one composition, Monte Carlo and the chain of all nodes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ubl_graph import lie
from ubl_graph.measurements import Odometry, odometry_covariance
from ubl_graph.odometry_chain import compounded
from ubl_graph.odometry_noise import in_space
from ubl_graph.options import Options

PLANE, SPACE = Options(node="pose2"), Options(node="pose3")


def planar(rng, n=60, dt=1.0, covariance=None):
    """A vehicle that turns and slides in the plane, with full covariances."""
    t = 100.0 + dt * np.arange(n + 1)
    if covariance is None:
        root = rng.normal(0.0, 0.02, (n, 3, 3)) + 0.05 * np.eye(3)
        covariance = root @ np.swapaxes(root, 1, 2)
    return Odometry(
        t[:-1],
        t[1:],
        rng.normal(1.5, 0.3, n),
        rng.normal(0.0, 0.3, n),
        about_down=rng.normal(0.05, 0.1, n),
        covariance=covariance,
    )


def spatial(rng, n=40):
    """The same in space."""
    t = np.arange(n + 1.0)
    root = rng.normal(0.0, 0.01, (n, 6, 6)) + 0.03 * np.eye(6)
    turn = rng.normal(0.02, 0.1, (3, n))
    return Odometry(
        t[:-1],
        t[1:],
        rng.normal(1.5, 0.3, n),
        rng.normal(0.0, 0.3, n),
        rng.normal(0.0, 0.3, n),
        *turn,
        covariance=root @ np.swapaxes(root, 1, 2),
    )


def poses(records):
    """Poses (K, 4, 4) that records put one after the other lead to, and the covariance there."""
    pose, covariance = np.eye(4), np.zeros((6, 6))
    out = [pose]
    planes = records.dimension == 2
    keep = np.array([0, 1, 5]) if planes else np.arange(6)
    own = records.covariances_flu
    for i in range(len(records)):
        step = np.eye(4)
        step[:3, :3] = Rotation.from_rotvec(records.rotation_vector[i]).as_matrix()
        step[:3, 3] = records.translation[i]
        back = np.linalg.inv(step)
        carry = lie.adjoint(back[None, :3, :3], back[None, :3, 3])[0]
        covariance = carry @ covariance @ carry.T
        covariance[np.ix_(keep, keep)] += own[i]
        pose = pose @ step
        out.append(pose)
    return np.array(out), covariance[np.ix_(keep, keep)]


@pytest.mark.parametrize("make", [planar, spatial])
def test_compounds_are_the_records_put_one_after_the_other(make):
    rng = np.random.default_rng(1)
    records = make(rng)
    options = PLANE if make is planar else SPACE
    begin = records.t_from[0]
    times = begin + np.array([3.0, 4.0, 17.0, 30.0])
    whole = compounded(records, times, options)
    ends = [begin, *times, records.t_to[-1]]
    np.testing.assert_array_equal(whole.t_from, ends[:-1])
    np.testing.assert_array_equal(whole.t_to, ends[1:])
    assert whole.dimension == records.dimension
    got, _ = poses(whole)
    all_poses, _ = poses(records)
    np.testing.assert_allclose(got, all_poses[(np.array(ends) - begin).astype(int)], atol=1e-12)
    for k, (a, b) in enumerate(zip(whole.t_from - begin, whole.t_to - begin, strict=True)):
        _, covariance = poses(records[int(a) : int(b)])
        np.testing.assert_allclose(whole.covariances_flu[k], covariance, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("make", [planar, spatial])
def test_the_covariance_is_that_of_simulated_noise(make):
    rng = np.random.default_rng(2)
    exact = make(rng, n=12)
    keep = np.array([0, 1, 5]) if make is planar else np.arange(6)
    small = 0.1 * np.linalg.cholesky(exact.covariances_flu)
    options = PLANE if make is planar else SPACE
    runs = 20000
    noise = np.zeros((12, runs, 6))
    noise[:, :, keep] = rng.standard_normal((12, runs, len(keep))) @ np.swapaxes(small, 1, 2)
    rotation, position = np.tile(np.eye(3), (runs, 1, 1)), np.zeros((runs, 3))
    true_rotation, true_position = np.eye(3)[None], np.zeros((1, 3))
    for i in range(12):
        turn, way = lie.rotation(exact.rotation_vector[i][None]), exact.translation[i][None]
        off_turn, off = lie.exponential(noise[i])
        position = position + np.einsum("mij,mj->mi", rotation @ turn, off) + rotation @ way[0]
        rotation = rotation @ turn @ off_turn
        true_position = true_position + np.einsum("mij,mj->mi", true_rotation, way)
        true_rotation = true_rotation @ turn
    seen = lie.logarithm(
        *lie.between(
            np.repeat(true_rotation, runs, axis=0),
            true_position.repeat(runs, 0),
            rotation,
            position,
        )
    )[:, keep]
    whole = compounded(exact, np.empty(0), options)
    assert len(whole) == 1
    expected = 0.01 * whole.covariances_flu[0]
    got = seen.T @ seen / runs
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        got / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.04
    )


def test_the_covariance_is_that_of_the_chain_with_its_middle_nodes_marginalised():
    """All nodes as unknowns, the first held: the last one's block of the inverse information."""
    records = planar(np.random.default_rng(3), n=25)
    whole = compounded(records, np.empty(0), PLANE)
    n = len(records)
    information = np.zeros((3 * (n + 1), 3 * (n + 1)))
    for i in range(n):
        step = np.eye(4)
        step[:3, :3] = Rotation.from_rotvec(records.rotation_vector[i]).as_matrix()
        step[:3, 3] = records.translation[i]
        back = np.linalg.inv(step)
        carry = lie.adjoint(back[None, :3, :3], back[None, :3, 3])[0][np.ix_([0, 1, 5], [0, 1, 5])]
        rows = np.zeros((3, 3 * (n + 1)))
        rows[:, 3 * i : 3 * i + 3] = -carry
        rows[:, 3 * i + 3 : 3 * i + 6] = np.eye(3)
        information += rows.T @ np.linalg.inv(records.covariances_flu[i]) @ rows
    held = np.linalg.inv(information[3:, 3:])
    np.testing.assert_allclose(whole.covariances_flu[0], held[-3:, -3:], rtol=1e-8)


@pytest.mark.parametrize("make", [planar, spatial])
def test_a_record_is_split_where_a_time_lies_within(make):
    records = make(np.random.default_rng(4), n=6)
    options = PLANE if make is planar else SPACE
    begin = records.t_from[0]
    times = begin + np.array([2.25, 2.5, 4.7])
    parts = compounded(records, times, options)
    np.testing.assert_allclose(parts.t_to[:-1], times)
    got, _ = poses(parts)
    expected, _ = poses(records)
    np.testing.assert_allclose(got[-1], expected[-1], atol=1e-12)
    # A quarter of the third record's twist.
    quarter = parts[1]
    assert quarter.t_from[0] == times[0]
    twist = lie.logarithm(lie.rotation(records[2].rotation_vector), records[2].translation)
    turn, way = lie.exponential(0.25 * twist)
    np.testing.assert_allclose(quarter.translation, way, atol=1e-13)
    np.testing.assert_allclose(quarter.rotation_vector, lie.rotation_vector(turn), atol=1e-13)
    np.testing.assert_allclose(
        quarter.covariances_flu, 0.25 * records[2].covariances_flu, rtol=1e-12
    )


def test_a_time_near_a_records_end_is_that_end():
    records = planar(np.random.default_rng(5), n=4)
    whole = compounded(records, np.array([101.0 + 1e-6, 101.0 - 1e-6, 103.0]), PLANE)
    np.testing.assert_array_equal(whole.t_to, [101.0, 103.0, 104.0])


def test_gaps_stay_and_times_in_them_count_for_nothing():
    records = planar(np.random.default_rng(6), n=20)
    holed = records[np.r_[0:8, 12:20]]
    whole = compounded(holed, np.array([50.0, 104.0, 110.0, 500.0]), PLANE)
    np.testing.assert_array_equal(whole.t_from, [100.0, 104.0, 112.0])
    np.testing.assert_array_equal(whole.t_to, [104.0, 108.0, 120.0])


def test_overlapping_records_stay_as_they_are():
    records = planar(np.random.default_rng(7), n=10)
    over = Odometry(102.5, 104.5, 3.0, 0.0, covariance=0.1 * np.eye(3))
    columns = {
        name: np.concatenate([getattr(records, name), getattr(over, name)])
        for name in ("t_from", "t_to", "forward", "right", "about_down", "covariance")
    }
    whole = compounded(Odometry(**columns), np.array([101.0, 103.3, 107.0]), PLANE)
    np.testing.assert_array_equal(whole.t_from, [100, 101, 102, 102.5, 103, 104, 105, 107])
    np.testing.assert_array_equal(whole.t_to, [101, 102, 103, 104.5, 104, 105, 107, 110])
    kept = whole[whole.t_from == 102.5]
    assert kept.forward[0] == 3.0
    np.testing.assert_array_equal(kept.covariance[0], 0.1 * np.eye(3))


def test_the_order_of_records_and_times_does_not_matter():
    rng = np.random.default_rng(8)
    records = planar(rng)
    times = np.array([103.0, 120.5, 140.0])
    one = compounded(records, times, PLANE)
    other = compounded(records[rng.permutation(len(records))], times[[2, 0, 1]], PLANE)
    for name in ("t_from", "t_to", "forward", "right", "about_down", "covariance"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_records_between_wanted_times_come_back_as_they_were():
    records = planar(np.random.default_rng(9), n=5)
    same = compounded(records, records.t_from, PLANE)
    for name in ("t_from", "t_to", "forward", "right", "about_down"):
        np.testing.assert_array_equal(getattr(same, name), getattr(records, name))
    np.testing.assert_allclose(same.covariance, records.covariance, rtol=1e-15)


def test_noise_is_that_of_the_options():
    t = np.arange(11.0)
    bare = Odometry(t[:-1], t[1:], 1.0, 0.0)
    options = Options(node="pose2", odometry_way_noise=0.1, odometry_time_noise=0.0)
    whole = compounded(bare, np.empty(0), options)
    assert whole.covariances_flu[0, 0, 0] == pytest.approx(10 * 0.1**2)


def test_planar_records_of_a_vehicle_in_space_stay_in_their_plane():
    covariance = odometry_covariance(0.05, 1e-3, 2)
    whole = compounded(planar(np.random.default_rng(10), covariance=covariance), np.empty(0), SPACE)
    assert whole.dimension == 3
    assert whole.down[0] == 0.0
    leaning = 60 * in_space(covariance)[0, 3, 3]
    about = whole.covariances_flu[0, 3:5, 3:5]
    np.testing.assert_allclose(about, leaning * np.eye(2), rtol=1e-9, atol=1e-12)


def test_full_turns_and_long_ways():
    t = np.arange(7201.0)
    around = Odometry(t[:-1], t[1:], 1.0, 0.0, about_down=0.5, covariance=1e-6 * np.eye(3))
    whole = compounded(around, np.array([100.0]), PLANE)
    expected = np.remainder(50.0 + np.pi, 2.0 * np.pi) - np.pi
    assert whole.about_down[0] == pytest.approx(expected, abs=1e-9)
    # 14.4 km come in parts that a record may hold, and selecting checks that.
    straight = Odometry(t[:-1], t[1:], 2.0, 0.0, covariance=1e-6 * np.eye(3))
    parts = compounded(straight, np.empty(0), PLANE)
    assert len(parts[:]) == 3
    assert parts.forward.sum() == pytest.approx(14400.0)


def test_no_records_are_none():
    empty = planar(np.random.default_rng(11), n=2)[:0]
    assert len(compounded(empty, np.array([1.0]), PLANE)) == 0


def test_a_record_alone_can_be_cut():
    one = Odometry(0.0, 10.0, 20.0, 0.0, covariance=np.eye(3))
    parts = compounded(one, np.array([4.0]), PLANE)
    np.testing.assert_allclose(parts.forward, [8.0, 12.0])
