"""Parts of online fleets: rows and priors against other formulas, odometry, simulated fleets."""

import numpy as np
import pytest

from ubl_graph.cooperative.fleet import Member
from ubl_graph.errors import ConfigurationError
from ubl_graph.factors import pose_motion
from ubl_graph.factors.poses import PoseBlock, PoseNodes
from ubl_graph.layout import Chain, Layout
from ubl_graph.measurements import Odometry
from ubl_graph.odometry_chain import compounded
from ubl_graph.odometry_noise import PLANAR
from ubl_graph.online.fleet_line import Line, moved, turns_and_ways
from ubl_graph.online.fleet_place import placed
from ubl_graph.online.fleet_prior import Prior
from ubl_graph.online.fleet_replay import bare, stream
from ubl_graph.online.fleet_rows import (
    NodePoses,
    NodeTips,
    PlanarNodes,
    PlanarOdometry,
    TargetAntenna,
)
from ubl_graph.options import Options
from ubl_graph.segment import Segment
from ubl_graph.sim.fleets import FIX_SIGMA, RANGE_SIGMA, START_SIGMA, random_fleet

ERRORS = ("odometry_scale", "odometry_turn_bias")


def layout(n, node="pose2", shared=()):
    times = np.arange(n, dtype=np.float64)
    up = np.arange(n) * -2.0
    return Layout((Chain("A", 0, times),), 2, shared=shared, node=node, still=True, held_up=up)


@pytest.mark.parametrize("small", [1.0, 1e-3, 0.0])
@pytest.mark.parametrize("names", [(), ERRORS, ERRORS[::-1], ERRORS[1:]])
def test_planar_odometry_is_the_general_one(names, small):
    rng = np.random.default_rng(1)
    n = 8
    unknowns = layout(n, shared=tuple((name, 1) for name in names))
    x = rng.standard_normal(unknowns.size)
    way, turn = np.zeros((n - 1, 3)), np.zeros((n - 1, 3))
    way[:, :2], turn[:, 2] = rng.standard_normal((n - 1, 2)), rng.standard_normal(n - 1)
    yaw = x[2 : 3 * n : 3]
    # Residual angles that are small take the series.
    turn[:, 2] = np.diff(yaw) + small * rng.standard_normal(n - 1)
    dt, white = rng.uniform(1.0, 5.0, n - 1), rng.standard_normal((n - 1, 3, 3))
    k = np.arange(n - 1)
    units = np.array([unknowns.unit(name) for name in names])
    extra = np.tile([unknowns.shared_columns(name)[0] for name in names], (n - 1, 1))
    extra = extra.astype(np.int64).reshape(n - 1, len(names))
    general = PoseBlock(
        "odometry",
        [PoseNodes(unknowns, k, moving=False), PoseNodes(unknowns, k + 1, moving=False)],
        pose_motion.odometry(way, turn, dt, names),
        white,
        PLANAR,
        extra,
        units,
    )
    planar = PlanarOdometry(general.columns, way[:, :2], turn[:, 2], dt, white, names, units)
    expected, slopes = general.evaluate(x)
    got, own = planar.evaluate(x)
    np.testing.assert_allclose(got, expected, atol=1e-12)
    np.testing.assert_allclose(own, slopes, atol=1e-11)
    some, none = planar.evaluate(x, rows=slice(2, 5), jacobian=False)
    np.testing.assert_allclose(some, expected[2:5], atol=1e-12)
    assert none is None


def test_planar_nodes_are_the_general_ones():
    rng = np.random.default_rng(2)
    unknowns = layout(5)
    x, nodes = rng.standard_normal(unknowns.size), np.array([3, 0, 4])
    one, other = PlanarNodes(unknowns, nodes), PoseNodes(unknowns, nodes, moving=False)
    np.testing.assert_array_equal(one.columns, other.columns)
    slopes = rng.standard_normal((3, 2, 12))
    a, b = one.at(x), other.at(x)
    for name in ("position", "rotation"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-15)
    np.testing.assert_allclose(one.to_columns(a, slopes), other.to_columns(b, slopes), atol=1e-14)


@pytest.mark.parametrize("node", ["pose2", "pose3"])
def test_tips_with_arms_of_their_own_move_as_finite_differences_say(node):
    rng = np.random.default_rng(3)
    unknowns = layout(4, node)
    x, nodes = rng.standard_normal(unknowns.size), np.array([2, 2, 0, 1])
    tips = NodeTips(NodePoses(unknowns, nodes), rng.standard_normal((4, 3)))
    left = rng.standard_normal((4, 1, 3))
    every = slice(None)
    _, terms = tips.at(x, every)
    slopes = tips.slopes(left, terms)[:, 0]
    for column in range(unknowns.size):
        there = [tips.at(x + s * 1e-6 * np.eye(len(x))[column], every)[0] for s in (1.0, -1.0)]
        change = np.einsum("mi,mi->m", left[:, 0], there[0] - there[1]) / 2e-6
        own = np.where(tips.columns == column, slopes, 0.0).sum(axis=1)
        np.testing.assert_allclose(own, change, atol=1e-8)
    part, terms = tips.at(x, slice(1, 3))
    np.testing.assert_allclose(part, tips.at(x, every)[0][1:3])
    np.testing.assert_allclose(tips.slopes(left[1:3], terms)[:, 0], slopes[1:3])


@pytest.mark.parametrize("size", [3, 6])
def test_targets_move_as_finite_differences_say(size):
    rng = np.random.default_rng(4)
    x, later = rng.standard_normal(8), rng.uniform(0.0, 10.0, (2, 2))
    columns = np.array([np.arange(size), np.arange(size) + 2])
    antenna = TargetAntenna(columns, later)
    gradient = rng.standard_normal((2, 2, 3))
    slopes = antenna.slopes(gradient, None, slice(None))
    for column in range(8):
        step = 1e-6 * np.eye(8)[column]
        change = antenna.positions(x + step, slice(None))[0] - antenna.positions(x, slice(None))[0]
        expected = (gradient * change).sum(axis=(1, 2)) / 1e-6
        own = np.where(columns == column, slopes, 0.0).sum(axis=1)
        np.testing.assert_allclose(own, expected, atol=1e-6)


def moments(prior):
    """Mean and covariance of a prior."""
    covariance = np.linalg.inv(prior.information)
    return covariance @ prior.rows.T @ prior.target, covariance


def correlated(rng):
    prior = Prior()
    prior.know("a", rng.standard_normal(2), np.array([1.0, 2.0]))
    prior.know("b", rng.standard_normal(2), np.array([0.5, 3.0]))
    keys = [("a", 0), ("a", 1), ("b", 0), ("b", 1)]
    prior.learn(keys, rng.standard_normal((3, 4)), rng.standard_normal(3))
    return prior


def test_states_wander_as_kalman_predicts():
    rng = np.random.default_rng(5)
    prior = correlated(rng)
    mean, covariance = moments(prior)
    phi, noise = np.array([[1.0, 2.0], [0.0, 1.0]]), np.array([[2.0, 0.3], [0.3, 1.0]])
    whole, added = np.eye(4), np.zeros((4, 4))
    whole[:2, :2], added[:2, :2] = phi, noise
    expected, spread = whole @ mean, whole @ covariance @ whole.T + added
    prior.evolve([("a", 0), ("a", 1)], phi, noise)
    got, own = moments(prior)
    order = [prior.keys.index(key) for key in (("a", 0), ("a", 1), ("b", 0), ("b", 1))]
    np.testing.assert_allclose(got[order], expected, atol=1e-10)
    np.testing.assert_allclose(own[np.ix_(order, order)], spread, atol=1e-10)
    # Without noise nothing but the names' meaning changes.
    calm = correlated(np.random.default_rng(5))
    calm.evolve([("b", 0), ("b", 1)], phi)
    _, still = moments(calm)
    whole = np.eye(4)
    whole[2:, 2:] = phi
    np.testing.assert_allclose(still, whole @ covariance @ whole.T, atol=1e-10)


def drawn(rng, n=12):
    t = np.arange(n + 1.0)
    root = 0.02 * rng.standard_normal((n, 3, 3)) + 0.05 * np.eye(3)
    return Odometry(
        t[:-1],
        t[1:],
        rng.normal(1.5, 0.2, n),
        rng.normal(0.0, 0.2, n),
        about_down=rng.normal(0.0, 0.2, n),
        covariance=root @ np.swapaxes(root, 1, 2),
    )


def line_of(node="pose2"):
    options = Options(node=node)
    return Line(Member("A", Segment(), options=options), options)


def test_a_line_compounds_as_the_batch_does():
    records = drawn(np.random.default_rng(6))
    line = line_of()
    order = np.random.default_rng(7).permutation(len(records))
    assert line.take(records[order]) == [""] * len(records)
    times = [0.0, 2.5, 3.0, 7.25, 7.75, 12.0]
    steps = line.between(times)
    expected = compounded(records, np.array(times), line.options)
    turns, ways = turns_and_ways(steps)
    np.testing.assert_allclose(ways, expected.translation, atol=1e-12)
    np.testing.assert_allclose(turns, expected.rotation_vector, atol=1e-12)
    np.testing.assert_allclose(steps.covariance, expected.covariances_flu, rtol=1e-9, atol=1e-15)


def test_a_line_knows_doubles_and_trims_overlaps():
    records = drawn(np.random.default_rng(8), 6)
    line = line_of()
    line.take(records[:2])
    line.take(records[3:])
    assert line.take(records[1]) == ["duplicate"]
    assert line.take(Odometry(0.25, 0.75, 1.0, 0.0)) == ["overlaps odometry that is there"]
    # One over the gap and beyond counts in the gap alone.
    assert line.take(Odometry(1.5, 3.5, 2.0, 0.0, covariance=np.eye(3))) == [""]
    spans = [(p.t_from, p.t_to) for p in line.pieces]
    assert spans == [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 6)]
    assert line.pieces[2].way[0] == pytest.approx(1.0)


def test_a_gap_is_bridged_with_noise_that_grows():
    line = line_of()
    line.take(drawn(np.random.default_rng(9), 3))
    spreads = [np.trace(line.between([3.0, 3.0 + dt]).covariance[0]) for dt in (1.0, 10.0, 60.0)]
    assert np.all(np.diff(spreads) > 0.0)
    psd, dt = line.options.acceleration_psd, 60.0
    assert spreads[-1] > 2.0 * psd * dt**3 / 3.0
    nothing = line_of().between([0.0, 10.0])
    assert np.sqrt(nothing.covariance[0, 0, 0]) > 10.0


def test_moving_on_in_space_is_that_in_the_plane():
    x = np.array([1.0, 2.0, 0.5])
    way, turn = np.array([1.0, 0.3, 0.0]), np.array([0.0, 0.0, 0.2])
    flat = moved(x, way, turn)
    deep = moved(np.array([1.0, 2.0, -5.0, 0.0, 0.0, 0.5]), way, turn)
    np.testing.assert_allclose(deep[[0, 1, 5]], flat, atol=1e-14)
    np.testing.assert_allclose(deep[2:5], [-5.0, 0.0, 0.0], atol=1e-14)


def test_two_circles_have_two_points_in_common_and_three_have_one():
    def to(*centres):
        places = np.array(centres)
        distance = np.linalg.norm(places - [3.0, 4.0], axis=1)

        def residuals(q):
            return (np.linalg.norm(q[:, None] - places, axis=2) - distance) / 0.1

        return residuals

    starts = np.stack(np.meshgrid(np.linspace(-9, 9, 7), np.linspace(-9, 9, 7)), -1).reshape(-1, 2)
    two = placed(to([0.0, 0.0], [10.0, 0.0]), starts)
    np.testing.assert_allclose(sorted([two.value[1], two.rival[1]]), [-4.0, 4.0], atol=1e-3)
    three = placed(to([0.0, 0.0], [10.0, 0.0], [0.0, 10.0]), starts)
    np.testing.assert_allclose(three.value, [3.0, 4.0], atol=1e-3)
    assert three.rival is None
    assert placed(to([0.0, 0.0]), starts) is None


@pytest.mark.parametrize("kind", ["slant_range", "two_way_range", "one_way_range"])
def test_simulated_fleets_are_what_they_say(kind):
    fleet, truths = random_fleet(1, 4, 400.0, kind=kind, targets=1, fixed=2)
    again, _ = random_fleet(1, 4, 400.0, kind=kind, targets=1, fixed=2)
    quiet, _ = random_fleet(1, 4, 400.0, kind=kind, targets=1, fixed=2, noise=0.0)
    ranges = 0
    for member, same, exact in zip(fleet.vehicles, again.vehicles, quiet.vehicles, strict=True):
        truth = truths[member.name]
        odometry = exact.segment.odometry
        # Without noise odometry leads from the start to the end.
        x = np.array([*truth.position(0.0)[0, :2], 0.5 * np.pi - truth.heading(0.0)[0]])
        for way, turn in zip(odometry.translation, odometry.rotation_vector, strict=True):
            x = moved(x, way, turn)
        np.testing.assert_allclose(x[:2], truth.position(400.0)[0, :2], atol=1e-8)
        np.testing.assert_array_equal(
            member.segment.odometry.forward, same.segment.odometry.forward
        )
        assert abs(member.segment.start.east - truth.position(0.0)[0, 0]) < 5.0 * START_SIGMA
        records = getattr(member.segment, kind)
        ranges += 0 if records is None else len(records)
        if kind == "slant_range" and records is not None:
            for t, peer, distance in zip(records.t, records.beacon, records.distance, strict=True):
                here, there = (truths[n].position(t)[0] for n in (member.name, str(peer)))
                assert abs(np.linalg.norm(here - there) - distance) < 5.0 * RANGE_SIGMA
    assert ranges > 70
    fixes = fleet.vehicles[0].segment.position
    truth = truths["V0"].position(fixes.t)
    assert np.abs(fixes.east - truth[:, 0]).max() < 5.0 * FIX_SIGMA
    assert fleet.vehicles[2].segment.position is None
    with pytest.raises(ConfigurationError, match="nobody to range"):
        random_fleet(1, 1)


def test_the_stream_has_every_record_in_order():
    fleet, _ = random_fleet(2, 3, 60.0)
    records = list(stream(fleet))
    t = np.array([r[0] for r in records])
    assert (np.diff(t) >= 0.0).all()
    count = sum(len(rows) for m in fleet.vehicles for rows in m.segment.records().values())
    assert len(records) == count
    assert all(not m.segment.records() for m in bare(fleet).vehicles)
    assert bare(fleet).vehicles[0].segment.start == fleet.vehicles[0].segment.start
