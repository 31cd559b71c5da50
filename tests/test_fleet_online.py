"""Online fleets: recovery, an independent batch, consistency, targets, clocks, what is past."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from ubl_graph.beacon import Beacon
from ubl_graph.cooperative.fleet import Fleet, Member, Target
from ubl_graph.errors import ConfigurationError
from ubl_graph.measurements import (
    Depth,
    Heading,
    Odometry,
    OneWayRange,
    PositionFix,
    SlantRange,
)
from ubl_graph.online.fleet_estimator import FleetEstimator
from ubl_graph.online.fleet_replay import bare, stream
from ubl_graph.options import Options
from ubl_graph.segment import Segment, Start
from ubl_graph.sim.fleets import random_fleet

PLAIN = Options(
    node="pose2",
    estimate_sound_speed=False,
    odometry_scale_sigma=0.0,
    odometry_turn_bias_sigma_deg=0.0,
)
EAST = np.pi / 2.0


def run(fleet, lag=300.0, every=1, end=np.inf):
    """An estimator that has seen a fleet's records as they came, solved at every one."""
    estimator = FleetEstimator(bare(fleet), lag)
    for i, (t, vehicle, record) in enumerate(stream(fleet)):
        if t > end:
            break
        estimator.add(vehicle, record)
        if not isinstance(record, Odometry) and i % every == 0:
            estimator.update()
    estimator.update()
    return estimator


def straight(name, start, options=PLAIN, n=60, sigma=0.5, speed=1.0, covariance=None):
    """A vehicle that goes east from where it starts, with a second's odometry."""
    t = np.arange(n + 1.0)
    noise = np.diag([0.05, 0.02, 1e-3]) ** 2 if covariance is None else covariance
    odometry = Odometry(t[:-1], t[1:], speed, 0.0, about_down=0.0, covariance=noise)
    known = None if start is None else Start(0.0, *start, 0.0, sigma, EAST, 0.01)
    return Member(name, Segment(start=known, odometry=odometry), options=options)


@pytest.mark.parametrize("kind", ["slant_range", "two_way_range", "one_way_range"])
def test_noiseless_records_give_the_truth(kind):
    fleet, truths = random_fleet(3, 3, 240.0, kind=kind, noise=0.0, targets=1)
    # One-way, the clocks are off; what is known of them comes from the ranges alone.
    tolerance = 0.3 if kind == "one_way_range" else 1e-3
    estimator = run(fleet, 100.0)
    for name in fleet.vehicle_names:
        estimate = estimator.estimate(name, 240.0)
        off = estimate.position - truths[name].position(240.0)[0]
        assert np.abs(off).max() < tolerance
        turn = estimate.heading - truths[name].heading(240.0)[0]
        assert np.abs(np.angle(np.exp(1j * turn))) < 1e-3
        assert estimate.status == "ok", estimate.reasons
    target = estimator.target("T0")
    assert target.status == "ok"
    assert np.abs(target.position - truths["T0"].position(0.0)[0]).max() < 10.0 * tolerance


def oracle(fleet):
    """All 1 Hz poses of a fleet by scipy's least squares: ends, and their covariances.

    Ranges at whole seconds, slant or one-way with offset and drift (in millionths) of each clock;
    SE(2) by complex numbers.
    """
    names = fleet.vehicle_names
    n = len(fleet.vehicles[0].segment.odometry)
    columns = 3 * (n + 1) * len(names)

    def split(q):
        return q[:columns].reshape(len(names), n + 1, 3)

    def residuals(q):
        clocks = q[columns:].reshape(len(names), 2) * [1.0, 1e-6]
        options = fleet.options
        out = [clocks[:, 0] / options.clock_offset_sigma, clocks[:, 1] / options.clock_drift_sigma]
        poses = split(q)
        for i, (pose, member) in enumerate(zip(poses, fleet.vehicles, strict=True)):
            start, odometry = member.segment.start, member.segment.odometry
            out.append((pose[0, :2] - [start.east, start.north]) / start.sigma)
            heading = EAST - pose[0, 2] - start.heading
            out.append(np.array([np.angle(np.exp(1j * heading)) / start.heading_sigma]))
            z, turn = pose[:, 0] + 1j * pose[:, 1], np.diff(pose[:, 2])
            moved = (z[1:] - z[:-1]) * np.exp(-1j * pose[:-1, 2])
            told = odometry.forward - 1j * odometry.right
            off = turn + odometry.about_down
            gap = (moved - told) * np.exp(1j * odometry.about_down)
            # The logarithm's translation: V(off)^-1 gap.
            v = np.where(np.abs(off) < 1e-8, 1.0, (np.exp(1j * off) - 1.0) / (1j * off + 1e-300))
            along = gap / v
            error = np.stack([along.real, along.imag, off], axis=1)
            white = np.linalg.inv(np.linalg.cholesky(odometry.covariances_flu))
            out.append(np.einsum("mij,mj->mi", white, error).ravel())
            fixes = member.segment.position
            if fixes is not None:
                k = np.round(fixes.t).astype(int)
                out.append(((pose[k, :2] - fixes.position) / fixes.sigma[:, None]).ravel())
            for r in ranges_of(member.segment):
                j = names.index(r.beacon[0])
                if isinstance(r, SlantRange):
                    k = round(r.t[0])
                    away = np.linalg.norm(pose[k, :2] - poses[j, k, :2])
                    out.append((away - r.distance) / r.sigma)
                    continue
                sent, heard = r.t_transmit[0], r.t_receive[0]
                away = np.linalg.norm(pose[round(heard), :2] - poses[j, round(sent), :2])
                off = clocks[i] @ [1.0, heard] - clocks[j] @ [1.0, sent]
                out.append((away / 1500.0 + off - r.travel_time) / r.sigma)
        return np.concatenate(out)

    first = []
    for member in fleet.vehicles:
        start, odometry = member.segment.start, member.segment.odometry
        yaw = EAST - start.heading + np.concatenate([[0.0], np.cumsum(-odometry.about_down)])
        way = (odometry.forward - 1j * odometry.right) * np.exp(1j * yaw[:-1])
        z = start.east + 1j * start.north + np.concatenate([[0.0], np.cumsum(way)])
        first.append(np.stack([z.real, z.imag, yaw], axis=1))
    begin = np.concatenate([np.ravel(first), np.zeros(2 * len(names))])
    found = least_squares(residuals, begin, jac="3-point", x_scale="jac", xtol=1e-13)
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    poses = split(found.x)
    last = [3 * ((i + 1) * (n + 1) - 1) + np.arange(3) for i in range(len(names))]
    return poses[:, -1], [covariance[np.ix_(k, k)] for k in last]


def ranges_of(segment):
    """Slant and one-way ranges of a segment, one by one."""
    kinds = (segment.slant_range, segment.one_way_range)
    return [rows[k] for rows in kinds if rows is not None for k in range(len(rows))]


def small_fleet(seed=0, n=30, loss="none"):
    """Two vehicles that turn, ranges every three seconds and a fix, with noise."""
    rng = np.random.default_rng(seed)
    options = replace(PLAIN, loss=loss)
    t = np.arange(n + 1.0)
    covariance = np.diag([0.05, 0.03, 0.004]) ** 2
    members = []
    for name, east in (("A", 0.0), ("B", 120.0)):
        noise = rng.standard_normal((n, 3)) * np.sqrt(np.diag(covariance))
        odometry = Odometry(
            t[:-1],
            t[1:],
            1.5 + noise[:, 0],
            noise[:, 1],
            about_down=0.03 + noise[:, 2],
            covariance=covariance,
        )
        start = Start(0.0, east, 30.0, 0.0, 1.0, 0.4, 0.05)
        when = np.arange(3.0, n + 1.0, 6.0) + (3.0 if name == "B" else 0.0)
        when = when[when <= n]
        peer = "B" if name == "A" else "A"
        distance = 120.0 + rng.standard_normal(len(when))
        ranges = SlantRange(when, np.full(len(when), peer), distance, 1.0)
        fix = PositionFix(20.0, 20.5, 51.5, sigma=2.0) if name == "A" else None
        segment = Segment(start=start, odometry=odometry, slant_range=ranges, position=fix)
        members.append(Member(name, segment, options=options))
    return Fleet(tuple(members), options=options)


def test_it_equals_an_independent_batch_solution_before_anything_leaves_the_window():
    fleet = small_fleet()
    estimator = run(fleet, 1000.0)
    expected, covariances = oracle(fleet)
    for i, name in enumerate(fleet.vehicle_names):
        estimate = estimator.estimate(name, 30.0)
        sigma = np.sqrt(np.diag(covariances[i]))
        off = estimate.position[:2] - expected[i, :2]
        assert (np.abs(off) < 0.02 * sigma[:2]).all()
        turn = EAST - estimate.heading - expected[i, 2]
        assert np.abs(np.angle(np.exp(1j * turn))) < 0.02 * sigma[2]
        np.testing.assert_allclose(
            estimate.covariance[:2, :2], covariances[i][:2, :2], rtol=0.03, atol=0.01
        )
        assert estimate.heading_sigma == pytest.approx(sigma[2], rel=0.02)


@pytest.mark.parametrize("drift", [1e-6, 1e-3])
def test_it_equals_an_independent_solution_with_clocks(drift):
    """Heard a second after it was sent, or in the same second: half of that is the clocks'."""
    fleet = small_fleet()
    options = replace(fleet.options, clock_offset_sigma=1.0, clock_drift_sigma=drift)
    members = []
    for member in fleet.vehicles:
        segment = member.segment
        peer, t = segment.slant_range.beacon, segment.slant_range.t
        sent = t - 1.0 if member.name == "A" else t
        start = segment.start if member.name == "A" else replace(segment.start, east=751.0)
        heard = OneWayRange(peer, sent, t, 7e-4)
        segment = replace(segment, start=start, slant_range=None, one_way_range=heard)
        members.append(replace(member, segment=segment, options=options))
    fleet = Fleet(tuple(members), options=options)
    estimator = run(fleet, 1000.0)
    expected, covariances = oracle(fleet)
    for i, name in enumerate(fleet.vehicle_names):
        pose = estimator.smoothed(name, 30.0)
        np.testing.assert_allclose(pose.position[:2], expected[i, :2], atol=0.02)
        np.testing.assert_allclose(
            pose.covariance[:2, :2], covariances[i][:2, :2], rtol=0.005, atol=0.005
        )


def test_it_equals_the_batch_with_what_is_older_marginalised():
    fleet = small_fleet(1)
    full, short = run(fleet, 1000.0), run(fleet, 9.0)
    for name in fleet.vehicle_names:
        one, other = full.estimate(name, 30.0), short.estimate(name, 30.0)
        sigma = np.sqrt(np.diag(one.covariance))[:2]
        # The past stays linearised where it left, so that a tenth of a sigma may differ.
        assert (np.abs(one.position - other.position)[:2] < 0.1 * sigma).all()
        np.testing.assert_allclose(
            other.covariance[:2, :2], one.covariance[:2, :2], rtol=0.1, atol=0.02
        )
    assert short.health()["window"]["nodes"] < full.health()["window"]["nodes"]


def test_marginalisation_keeps_all_information_where_the_problem_is_linear():
    """Fixes and a heading that is all but known: the fixed lag equals the whole mission."""
    covariance = np.diag([0.1, 0.1, 1e-7]) ** 2
    rng = np.random.default_rng(2)
    member = straight("A", (0.0, 0.0), n=200, covariance=covariance)
    start = replace(member.segment.start, heading_sigma=1e-6)
    t = np.arange(5.0, 200.0, 5.0)
    east, north = t + rng.standard_normal(len(t)), rng.standard_normal(len(t))
    fixes = PositionFix(t, east, north, sigma=1.0)
    segment = replace(member.segment, start=start, position=fixes)
    fleet = Fleet((replace(member, segment=segment),), options=PLAIN)
    full, short = run(fleet, 1e4), run(fleet, 21.0)
    one, other = full.estimate("A", 200.0), short.estimate("A", 200.0)
    np.testing.assert_allclose(other.position, one.position, atol=1e-4)
    np.testing.assert_allclose(other.covariance, one.covariance, rtol=1e-3, atol=1e-6)
    assert short.health()["window"]["rows"] < 10


def test_smoothed_poses_leave_the_window_in_order_and_are_better_than_current_ones():
    now, late = [], []
    for seed in range(2):
        fleet, truths = random_fleet(seed, 3, 600.0, fixed=1)
        estimator = FleetEstimator(bare(fleet), 150.0)
        left = {name: [] for name in fleet.vehicle_names}
        for t, vehicle, record in stream(fleet):
            estimator.add(vehicle, record)
            if isinstance(record, Odometry):
                continue
            estimator.update()
            for name in fleet.vehicle_names:
                left[name] += estimator.delayed(name)
                if t > 200.0:
                    estimate = estimator.estimate(name)
                    truth = truths[name].position(estimate.t)[0]
                    now.append(np.linalg.norm(estimate.position - truth))
        for name, poses in left.items():
            t = np.array([p.t for p in poses])
            assert (np.diff(t) > 0.0).all()
            assert t[-1] > 400.0
            truth = truths[name].position(t)
            off = np.array([p.position for p in poses]) - truth
            late += np.linalg.norm(off[t > 100.0], axis=1).tolist()
    assert np.sqrt(np.mean(np.square(late))) < np.sqrt(np.mean(np.square(now)))


@pytest.mark.slow
def test_errors_are_as_large_as_the_covariances_say():
    ends = {f"V{i}": [] for i in range(3)}
    headings = []
    for seed in range(30):
        fleet, truths = random_fleet(seed, 3, 300.0, every=10.0, fixed=1)
        estimator = run(fleet, 100.0)
        for name, squares in ends.items():
            estimate = estimator.estimate(name, 300.0)
            off = (estimate.position - truths[name].position(300.0)[0])[:2]
            squares.append(off @ np.linalg.solve(estimate.covariance[:2, :2], off))
            turn = np.angle(np.exp(1j * (estimate.heading - truths[name].heading(300.0)[0])))
            headings.append(turn / estimate.heading_sigma)
    for squares in ends.values():
        low, high = chi2.ppf([0.001, 0.999], 60) / 30.0
        assert low < np.mean(squares) < high
    assert 0.8 < np.sqrt(np.mean(np.square(headings))) < 1.25


def test_the_order_of_arrival_does_not_matter_inside_the_lag():
    fleet, _ = random_fleet(5, 3, 120.0, every=4.0)
    records = list(stream(fleet))
    once = FleetEstimator(bare(fleet), 200.0)
    for _, vehicle, record in records:
        once.add(vehicle, record)
        if not isinstance(record, Odometry):
            once.update()
    shuffled = FleetEstimator(bare(fleet), 200.0)
    rng = np.random.default_rng(0)
    for i, at in enumerate(rng.permutation(len(records))):
        _, vehicle, record = records[at]
        assert shuffled.add(vehicle, record).accepted
        if i % 40 == 39:
            shuffled.update()
    once.update()
    shuffled.update()
    for name in fleet.vehicle_names:
        one, other = once.estimate(name, 120.0), shuffled.estimate(name, 120.0)
        sigma = np.sqrt(np.diag(one.covariance))[:2]
        assert (np.abs(one.position - other.position)[:2] < 0.02 * sigma).all()
        np.testing.assert_allclose(
            one.covariance[:2, :2], other.covariance[:2, :2], rtol=0.02, atol=0.02
        )


def test_between_nodes_and_ahead_of_them_it_goes_by_odometry():
    fleet, truths = random_fleet(6, 2, 100.0, noise=0.0)
    estimator = run(fleet, 60.0)
    for t in (70.0, 81.3, 99.0):
        pose = estimator.smoothed("V0", t)
        np.testing.assert_allclose(pose.position, truths["V0"].position(t)[0], atol=2e-3)
    ahead = estimator.estimate("V0", 130.0)
    later = estimator.estimate("V0", 190.0)
    assert np.trace(later.covariance) > np.trace(ahead.covariance)


def on_a_ring(target, at, moves=(0.0, 0.0)):
    """Slant ranges (M,) to a target, that may move, from places (M, 2) at times (M,)."""
    t, places = at
    there = np.asarray(target) + t[:, None] * np.asarray(moves)
    return SlantRange(t, np.full(len(t), "T"), np.linalg.norm(places - there, axis=1), 1.0)


def test_a_target_beside_a_straight_track_has_a_mirror_image_until_the_track_turns():
    target = Target("T", [0.0, 0.0, 0.0], sigma=(1e4, 1e4, 0.0))
    fleet = Fleet((straight("A", (0.0, 0.0)),), targets=(target,), options=PLAIN)
    estimator = FleetEstimator(bare(fleet), 100.0)
    noise = np.diag([0.05, 0.02, 1e-3]) ** 2
    east, north, turned = 0.0, 0.0, False
    seen = []
    for k in range(240):
        turned = k >= 120
        way = (0.0, 2.0) if turned else (2.0, 0.0)
        # The bow turns to the north at once after two minutes.
        left = EAST if k == 120 else 0.0
        forward, right = (0.0, -2.0) if k == 120 else (2.0, 0.0)
        step = Odometry(k, k + 1.0, forward, right, about_down=-left, covariance=noise)
        estimator.add("A", step)
        east, north = east + way[0], north + way[1]
        if k % 10 == 9:
            t = np.array([k + 1.0])
            estimator.add("A", on_a_ring((100.0, 80.0), (t, np.array([[east, north]]))))
            estimator.update()
            seen.append(estimator.target("T").status)
            if k == 99:
                both = estimator.target("T")
    assert seen[0] == "initialising"
    assert both.status == "ambiguous"
    np.testing.assert_allclose(sorted([both.position[1], both.rival[1]]), [-80.0, 80.0], atol=10.0)
    assert seen[-1] == "ok"
    found = estimator.target("T")
    off = (found.position - [100.0, 80.0, 0.0])[:2]
    assert np.linalg.norm(off) < 5.0
    assert off @ np.linalg.solve(found.covariance[:2, :2], off) < 14.0


def test_a_target_in_steady_motion_is_followed():
    target = Target("T", [0.0, 200.0, 0.0], sigma=(300.0, 300.0, 0.0), velocity_sigma=(1, 1, 0))
    a = straight("A", (0.0, 0.0), n=400)
    b = straight("B", (0.0, 500.0), n=400, speed=1.5)
    fleet = Fleet((a, b), targets=(target,), options=PLAIN)
    t = np.arange(5.0, 400.0, 5.0)
    for speed, name in ((1.0, "A"), (1.5, "B")):
        north = 0.0 if name == "A" else 500.0
        track = np.stack([speed * t, np.full(len(t), north)], axis=1)
        ranges = on_a_ring((100.0, 150.0), (t, track), (0.3, 0.2))
        i = fleet.vehicle_names.index(name)
        member = fleet.vehicles[i]
        member = replace(member, segment=replace(member.segment, slant_range=ranges))
        vehicles = tuple(member if v.name == name else v for v in fleet.vehicles)
        fleet = replace(fleet, vehicles=vehicles)
    estimator = run(fleet, 100.0)
    found = estimator.target("T")
    assert found.status == "ok"
    truth = np.array([100.0, 150.0]) + found.t * np.array([0.3, 0.2])
    np.testing.assert_allclose(found.position[:2], truth, atol=3.0)
    np.testing.assert_allclose(found.velocity[:2], [0.3, 0.2], atol=0.03)


def test_a_vehicle_without_a_start_is_found_by_its_ranges_and_harms_nobody_before():
    rng = np.random.default_rng(4)
    beacons = (Beacon("B1", [0.0, 300.0, 0.0]), Beacon("B2", [200.0, -200.0, 0.0]))
    beacons += (Beacon("B3", [400.0, 200.0, 0.0]),)
    places = {b.name: b.position[:2] for b in beacons}
    n = 150
    known, lost = straight("A", (0.0, 0.0), n=n), straight("X", None, n=n)
    alone = Fleet((known,), beacons, options=PLAIN)
    both = Fleet((known, lost), beacons, options=PLAIN)
    one, two = FleetEstimator(bare(alone)), FleetEstimator(bare(both))
    for k in range(n):
        for estimator in (one, two):
            for name in estimator.fleet.vehicle_names:
                member = both.member(name)
                estimator.add(name, member.segment.odometry[k])
        t = k + 1.0
        if k % 10 == 9 and k < 60:
            name = f"B{1 + k // 10 % 3}"
            distance = np.linalg.norm(places[name] - [t, 0.0]) + rng.standard_normal()
            for estimator in (one, two):
                estimator.add("A", SlantRange(t, name, distance, 1.0))
        if k % 10 == 4 and k > 70:
            name = ("B1", "B2", "B3", "A")[k // 10 % 4]
            here = np.array([50.0 + t, 100.0])
            there = places.get(name, np.array([t, 0.0]))
            two.add("X", SlantRange(t, name, np.linalg.norm(here - there), 1.0))
        one.update()
        two.update()
        if k == 69:
            a, b = one.estimate("A"), two.estimate("A")
            np.testing.assert_allclose(a.position, b.position, atol=1e-6)
            waiting = two.estimate("X")
            assert waiting.status == "initialising"
            assert waiting.position is None
    found = two.estimate("X")
    assert found.position is not None, found
    off = (found.position - [50.0 + n, 100.0, 0.0])[:2]
    assert off @ np.linalg.solve(found.covariance[:2, :2], off) < 14.0


def test_spatial_vehicles_with_depth_and_compass():
    options = replace(PLAIN, node="pose3", heading_bias_sigma_deg=0.0)
    n = 100
    t = np.arange(n + 1.0)
    noise = np.diag([0.05, 0.05, 0.05, 1e-3, 1e-3, 1e-3]) ** 2
    members = []
    for name, north in (("A", 0.0), ("B", 200.0)):
        # Down by a metre in ten, with the bow level.
        steps = Odometry(t[:-1], t[1:], 1.5, 0.0, 0.1, 0.0, 0.0, 0.0, covariance=noise)
        start = Start(0.0, 0.0, north, -10.0, 1.0, EAST, 0.05)
        when = np.arange(7.0, n, 6.0)
        ranges = SlantRange(when, "B" if name == "A" else "A", np.full(len(when), 200.0), 0.5)
        segment = Segment(
            start=start,
            odometry=steps,
            slant_range=ranges if name == "A" else None,
            depth=Depth(t, 10.0 + 0.1 * t, 0.1),
            heading=Heading(t, EAST, 0.02),
        )
        members.append(Member(name, segment, options=options))
    fleet = Fleet(tuple(members), options=options)
    estimator = run(fleet, 50.0)
    for name, north in (("A", 0.0), ("B", 200.0)):
        estimate = estimator.estimate(name, 100.0)
        np.testing.assert_allclose(estimate.position, [150.0, north, -20.0], atol=0.05)
        assert estimate.heading == pytest.approx(EAST, abs=1e-3)
        assert estimate.heading_sigma < 0.02
        assert np.linalg.eigvalsh(estimate.covariance)[0] > 0.0
        assert np.sqrt(estimate.covariance[2, 2]) < 0.2


def test_odometry_that_reads_short_and_turns_too_far_is_learned():
    """Scale and turning bias are one state of each vehicle for the whole window."""
    options = Options(
        node="pose2",
        estimate_sound_speed=False,
        odometry_scale_sigma=0.05,
        odometry_turn_bias_sigma_deg=0.1,
    )
    n, scale, bias = 400, 0.03, float(np.deg2rad(0.05))
    t = np.arange(n + 1.0)
    member = straight("A", (0.0, 0.0), options, n)
    # It truly goes straight; what it reads turns clockwise and is too short.
    steps = Odometry(
        t[:-1],
        t[1:],
        2.0 * np.cos(0.5 * bias) / (1.0 + scale),
        2.0 * np.sin(0.5 * bias) / (1.0 + scale),
        about_down=bias,
        covariance=np.diag([0.02, 0.02, 1e-4]) ** 2,
    )
    when = np.arange(20.0, n, 20.0)
    fixes = PositionFix(when, 2.0 * when, 0.0 * when, sigma=0.5)
    segment = replace(member.segment, odometry=steps, position=fixes)
    fleet = Fleet((replace(member, segment=segment),), options=options)
    estimator = run(fleet, 100.0)
    estimate = estimator.estimate("A", 400.0)
    np.testing.assert_allclose(estimate.position[:2], [800.0, 0.0], atol=0.3)
    # Without fixes it goes on right.
    learned = estimator.estimate("A", 430.0)
    np.testing.assert_allclose(learned.position[:2], [860.0, 0.0], atol=2.0)
    off = learned.position[:2] - [860.0, 0.0]
    assert off @ np.linalg.solve(learned.covariance[:2, :2], off) < 9.0


@pytest.mark.parametrize("node", ["pose2", "pose3"])
def test_frequent_fixes_make_few_nodes(node):
    n = 200
    options = replace(PLAIN, node=node)
    member = straight("A", (0.0, 0.0), options, n=n)
    t = np.arange(1.0, n + 1.0)
    segment = replace(member.segment, position=PositionFix(t, t, 0.0 * t, 0.0 * t, sigma=0.01))
    fleet = Fleet((replace(member, segment=segment),), options=options)
    estimator = run(fleet, 100.0)
    assert estimator.health()["window"]["nodes"] < 70
    estimate = estimator.estimate("A")
    np.testing.assert_allclose(estimate.position, [n, 0.0, 0.0], atol=0.02)
    assert np.sqrt(estimate.covariance[0, 0]) < 0.011


def test_readings_of_a_compass_count_between_nodes_too():
    options = replace(PLAIN, heading_bias_sigma_deg=0.0)
    n = 120
    covariance = np.diag([0.05, 0.02, 1e-5]) ** 2
    member = straight("A", (0.0, 0.0), options, n, covariance=covariance)
    rng = np.random.default_rng(8)
    t = np.arange(1.0, n + 1.0)
    read = EAST + 0.02 * rng.standard_normal(n)
    segment = replace(
        member.segment,
        start=replace(member.segment.start, heading_sigma=0.5),
        heading=Heading(t, read, 0.02),
    )
    fleet = Fleet((replace(member, segment=segment),), options=options)
    estimator = run(fleet, 300.0)
    estimator.update()
    estimate = estimator.estimate("A")
    # A hundred readings are ten times as good as one.
    assert estimate.heading_sigma == pytest.approx(0.02 / np.sqrt(120), rel=0.1)
    assert abs(estimate.heading - EAST) < 4.0 * estimate.heading_sigma


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"node": "point"}, "poses of one kind"),
        ({"estimate_beacons": True}, "know their beacons"),
    ],
)
def test_what_batch_smoothing_alone_takes_is_refused(change, text):
    options = replace(PLAIN, **change)
    start = Start(0.0, 0.0, 0.0)
    fleet = Fleet((Member("A", Segment(start=start), options=options),), options=options)
    with pytest.raises(ConfigurationError, match=text) as caught:
        FleetEstimator(fleet)
    assert "\n" not in str(caught.value)
    assert "smooth_fleet" in str(caught.value)


def test_a_fleet_with_records_is_no_configuration():
    fleet, _ = random_fleet(0, 2, 30.0)
    with pytest.raises(ConfigurationError, match="has records"):
        FleetEstimator(fleet)
    with pytest.raises(ConfigurationError, match="lag"):
        FleetEstimator(bare(fleet), lag=0.0)
