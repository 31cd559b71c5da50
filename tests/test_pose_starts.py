"""The search of start poses: random places, outliers, mirror images, one beacon, real tracks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import loadmat

from ubl_graph.arrays import FloatArray
from ubl_graph.errors import UnobservableError
from ubl_graph.pose_chain import KNOT, SHARED, Chain
from ubl_graph.pose_starts import PoseStart, find_pose_starts
from ubl_graph.pose_windows import Anchors, ReckonedTrack, TrackRanges, Unknowns

THREE = np.array([[400.0, 0.0, -20.0], [-250.0, 300.0, -25.0], [-100.0, -350.0, -15.0]])
#: Where the antenna sits in the body: forward, left, m.
LEVER = 0.8 - 0.3j
WAY_NOISE, TURN_NOISE = 0.02, np.radians(0.1)


@dataclass(frozen=True)
class Case:
    """A true track (complex east + i north, yaw) with its odometry and ranges."""

    track: ReckonedTrack
    ranges: TrackRanges
    place: FloatArray
    yaw: FloatArray


def composed(
    steps: FloatArray, turns: FloatArray, place: complex, yaw: float
) -> tuple[FloatArray, FloatArray]:
    """Places and yaws of a chain of steps (complex, body axes) and turns, one after the other."""
    places, yaws = [place], [yaw]
    for step, turn in zip(steps, turns, strict=True):
        places.append(places[-1] + step * np.exp(1j * yaws[-1]))
        yaws.append(yaws[-1] + turn)
    return np.array(places), np.array(yaws)


def case(
    seed: int = 0,
    beacons: FloatArray = THREE,
    bend: float = 0.02,
    bias: float = 0.0,
    scale: float = 0.0,
    range_scale: float = 0.0,
    noise: float = 0.0,
    outliers: float = 0.0,
) -> Case:
    """A track of 600 m at 2 m/s from a random place, bending by about so much per metre."""
    rng = np.random.default_rng([seed, 6])
    t = np.arange(301.0)
    way = np.full(300, 2.0)
    turns = bend * way * np.sin(0.03 * t[:-1] + rng.uniform(0.0, 6.0)) + 0.2 * bend * way
    place = complex(*rng.uniform(-250.0, 250.0, 2))
    z, yaw = composed(way + 0j, turns, place, float(rng.uniform(-np.pi, np.pi)))
    slip = noise * WAY_NOISE * np.sqrt(way) * (rng.normal(size=300) + 1j * rng.normal(size=300))
    skew = noise * TURN_NOISE * np.sqrt(way) * rng.normal(size=300)
    # What is turned too far clockwise is lacking counter-clockwise.
    q, q_yaw = composed((way + slip) / (1.0 + scale), turns + skew - bias, 0j, 0.0)
    rows = np.arange(2, 300, 3)
    beacon = beacons[rng.integers(0, len(beacons), len(rows))]
    antenna = z[rows] + LEVER * np.exp(1j * yaw[rows])
    gap = antenna - (beacon[:, 0] + 1j * beacon[:, 1])
    distance = np.hypot(np.abs(gap), -2.0 - beacon[:, 2]) * np.exp(range_scale)
    distance += 0.5 * noise * rng.normal(size=len(rows))
    wrong = rng.random(len(rows)) < outliers
    distance[wrong] = rng.uniform(1.0, 900.0, int(wrong.sum()))
    seen = q[rows] + LEVER * np.exp(1j * q_yaw[rows])
    total = 2.0 * t
    return Case(
        ReckonedTrack(
            t,
            np.stack([q.real, q.imag, np.full(301, -2.0)], axis=1),
            q_yaw,
            WAY_NOISE**2 * total,
            TURN_NOISE**2 * total,
        ),
        TrackRanges(
            t[rows],
            np.stack([seen.real, seen.imag, np.full(len(rows), -2.0)], axis=1),
            beacon,
            distance,
            np.full(len(rows), 0.5),
        ),
        z,
        yaw,
    )


def miss(start: PoseStart, truth: FloatArray) -> float:
    """Root-mean-square error in the plane, m."""
    gap = start.position[:, 0] + 1j * start.position[:, 1] - truth
    return float(np.sqrt(np.mean(np.abs(gap) ** 2)))


@settings(max_examples=6, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    bias=st.floats(-3e-3, 3e-3),
    scale=st.floats(-0.02, 0.02),
    range_scale=st.floats(-0.02, 0.02),
)
def test_noiseless_tracks_are_found_wherever_they_lie(
    seed: int, bias: float, scale: float, range_scale: float
) -> None:
    made = case(seed, bias=bias, scale=scale, range_scale=range_scale)
    # Priors so wide that they pull next to nothing.
    unknowns = Unknowns(turn_bias=0.01, scale=1.0, range_scale=1.0)
    best = find_pose_starts(made.track, made.ranges, unknowns)[0]
    assert miss(best, made.place) < 0.02
    assert np.abs(np.angle(np.exp(1j * (best.yaw - made.yaw)))).max() < 1e-3
    assert best.turn_bias == pytest.approx(bias, abs=1e-5)
    assert best.scale == pytest.approx(scale, abs=2e-4)
    assert best.range_scale == pytest.approx(range_scale, abs=2e-4)
    assert best.cost < 0.05


@pytest.mark.parametrize("seed", range(6))
def test_a_third_of_outliers_does_no_harm(seed: int) -> None:
    made = case(seed, noise=1.0, outliers=0.3)
    best, *others = find_pose_starts(made.track, made.ranges, Unknowns(scale=0.01))
    assert miss(best, made.place) < 1.5
    assert all(other.cost > best.cost + 10.0 for other in others)


def test_a_straight_track_between_two_beacons_has_a_mirror_image() -> None:
    made = case(3, beacons=THREE[:2], bend=0.0)
    starts = find_pose_starts(made.track, made.ranges)
    baseline = THREE[1, :2] - THREE[0, :2]
    along = complex(*baseline) / np.linalg.norm(baseline)
    origin = complex(*THREE[0, :2])
    # The lever arm to the left of the track is mirrored to its right: that much is left over.
    mirror = origin + along * np.conj((made.place - origin) / along)
    assert min(miss(s, made.place) for s in starts[:2]) < 0.02
    assert min(miss(s, mirror) for s in starts[:2]) < 2.0
    assert starts[1].cost < starts[0].cost + 2.0


def test_a_bend_tells_the_mirror_image_apart() -> None:
    made = case(3, beacons=THREE[:2], noise=1.0)
    starts = find_pose_starts(made.track, made.ranges, Unknowns(scale=0.01))
    assert miss(starts[0], made.place) < 2.0
    assert all(other.cost > starts[0].cost + 20.0 for other in starts[1:])


def test_one_beacon_leaves_a_circle_and_answers_stand_all_around_it() -> None:
    made = case(5, beacons=THREE[:1])
    starts = find_pose_starts(made.track, made.ranges)
    assert len(starts) == 8
    assert all(s.cost < 0.05 for s in starts)
    centre = complex(*THREE[0, :2])
    turned = np.array([np.angle(np.exp(1j * (s.yaw[0] - made.yaw[0]))) for s in starts])
    for start, turn in zip(starts, turned, strict=True):
        assert miss(start, centre + (made.place - centre) * np.exp(1j * turn)) < 0.05
    gaps = np.diff(np.concatenate([np.sort(turned), [np.sort(turned)[0] + 2.0 * np.pi]]))
    assert gaps.max() < np.radians(100.0)


def test_a_known_heading_picks_from_the_circle() -> None:
    made = case(5, beacons=THREE[:1])
    anchors = replace(known(made, 0.0), sigma=np.full((1, 3), np.inf))
    best, *others = find_pose_starts(made.track, made.ranges, anchors=anchors)
    assert miss(best, made.place) < 0.1
    assert not others


def known(made: Case, t: float) -> Anchors:
    """The true pose at a node's time."""
    i = int(np.searchsorted(made.track.t, t))
    position = np.array([[made.place[i].real, made.place[i].imag, -2.0]])
    return Anchors(
        np.array([t]), position, np.full((1, 3), 0.1), made.yaw[i : i + 1], np.array([0.01])
    )


def test_a_known_pose_alone_is_enough_wherever_it_is() -> None:
    made = case(7)
    empty = np.empty(0)
    nothing = TrackRanges(empty, np.empty((0, 3)), np.empty((0, 3)), empty, empty)
    for t in (0.0, 170.0, 300.0):
        (only,) = find_pose_starts(made.track, nothing, anchors=known(made, t))
        assert miss(only, made.place) < 1e-6
    with pytest.raises(UnobservableError, match="give a start position"):
        find_pose_starts(made.track, nothing)


def test_a_vehicle_whose_level_is_unknown() -> None:
    made = case(8)
    beacons = np.array([[200.0, 0.0, -150.0], [-150.0, 200.0, -90.0], [-50.0, -200.0, -130.0]])
    high = case(8, beacons=beacons)
    lifted = replace(high.track, position=high.track.position + np.array([0.0, 0.0, 30.0]))
    ranges = replace(high.ranges, antenna=high.ranges.antenna + np.array([0.0, 0.0, 30.0]))
    best = find_pose_starts(lifted, ranges, Unknowns(up=100.0))[0]
    assert miss(best, made.place) < 0.05
    np.testing.assert_allclose(best.position[:, 2], -2.0, atol=0.1)


def test_jacobians_against_central_differences() -> None:
    made = case(9, noise=1.0)
    anchors = known(made, 100.0)
    unknowns = Unknowns(turn_bias=0.01, scale=0.01, range_scale=0.01, up=3.0)
    chain = Chain(made.track, made.ranges, unknowns, anchors)
    assert chain.windows > 3
    rng = np.random.default_rng(0)
    theta = np.zeros((2, SHARED + KNOT))
    theta[:] = [3e-3, 0.02, 0.01, made.place[0].real, made.place[0].imag, -2.0, made.yaw[0]]
    theta = chain.predict(theta, chain.windows)
    theta += 0.01 * rng.normal(size=theta.shape)
    step = 1e-6
    for rows_of in (chain.range_rows, chain.anchor_rows, chain.joint_rows):
        rows = rows_of(theta, chain.windows)
        full = np.zeros((*rows.residual.shape, theta.shape[1]))
        for row, w in enumerate(rows.window):
            columns = np.r_[:SHARED, SHARED + KNOT * w : SHARED + KNOT * (w + 2)]
            full[:, row, columns] = rows.jacobian[:, row]
        for column in range(theta.shape[1]):
            nudge = np.zeros(theta.shape[1])
            nudge[column] = step
            up, down = (rows_of(theta + s * nudge, chain.windows).residual for s in (1, -1))
            slope = (up - down) / (2.0 * step)
            scale = 1.0 + np.abs(slope).max()
            np.testing.assert_allclose(full[:, :, column] / scale, slope / scale, atol=1e-6)


def test_answers_do_not_depend_on_the_order_of_the_ranges() -> None:
    made = case(10, noise=1.0)
    shuffled = np.random.default_rng(1).permutation(len(made.ranges.t))
    r = made.ranges
    mixed = TrackRanges(
        r.t[shuffled],
        r.antenna[shuffled],
        r.beacon[shuffled],
        r.distance[shuffled],
        r.sigma[shuffled],
    )
    one, two = (find_pose_starts(made.track, ranges)[0] for ranges in (r, mixed))
    np.testing.assert_allclose(one.position, two.position, atol=1e-9)
    assert one.cost == pytest.approx(two.cost, abs=1e-9)


def growing(way: FloatArray, lasted: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Variances of place and heading by the default growing noise of the options."""
    place = 0.02**2 * way + 1e-3**2 * lasted
    return place, np.radians(0.1) ** 2 * way + np.radians(0.01) ** 2 * lasted


def goats() -> tuple[ReckonedTrack, TrackRanges, list[str]]:
    """goats_15 as a composed track, with the beacon of each range."""
    text = Path(gtsam.findExampleDataFile("goats_15.pyfg")).read_text()
    lines = [line.split() for line in text.splitlines()]
    beacons = {w[1]: [float(w[2]), float(w[3]), 0.0] for w in lines if w[0] == "VERTEX_XY"}
    edges = np.array([[float(v) for v in w[4:7]] for w in lines if w[0] == "EDGE_SE2"])
    ranges = [w for w in lines if w[0] == "EDGE_RANGE"]
    z, yaw = composed(edges[:, 0] + 1j * edges[:, 1], edges[:, 2], 0j, 0.0)
    t = np.arange(len(z), dtype=np.float64)
    way = np.concatenate([[0.0], np.cumsum(np.hypot(edges[:, 0], edges[:, 1]))])
    position = np.stack([z.real, z.imag, np.zeros(len(z))], axis=1)
    pose = np.array([int(w[2][1:]) for w in ranges])
    return (
        ReckonedTrack(t, position, yaw, *growing(way, t)),
        TrackRanges(
            t[pose],
            position[pose],
            np.array([beacons[w[3]] for w in ranges]),
            np.array([float(w[4]) for w in ranges]),
            np.sqrt([float(w[5]) for w in ranges]),
        ),
        [w[3] for w in ranges],
    )


@pytest.mark.parametrize(("left_out", "limit"), [("", 3.0), ("L0", 6.0), ("L1", 4.0), ("L2", 4.0)])
def test_goats_15_is_found_without_any_one_beacon(left_out: str, limit: float) -> None:
    track, ranges, names = goats()
    used = np.array([name != left_out for name in names])
    part = TrackRanges(
        ranges.t[used],
        ranges.antenna[used],
        ranges.beacon[used],
        ranges.distance[used],
        ranges.sigma[used],
    )
    best, *others = find_pose_starts(track, part, Unknowns(scale=0.01))
    pose = ranges.t.astype(int)
    model = np.linalg.norm(best.position[pose] - ranges.beacon, axis=1)
    shown = ~used if left_out else used
    assert np.median(np.abs(model - ranges.distance)[shown]) < limit
    assert all(other.cost > 1.5 * best.cost for other in others)


def plaza() -> tuple[ReckonedTrack, TrackRanges, FloatArray]:
    """Plaza2 as a composed track, its raw ranges, and the true places at the track's times."""
    data = loadmat(gtsam.findExampleDataFile("Plaza2_.mat"))
    truth, steps, beacons, ranges = (data[k].astype(float) for k in ("GT", "DR", "TL", "TD"))
    t = truth[:, 0]
    # Twist of constant speed and turning: the chord of its arc.
    half = 0.5 * steps[:, 2]
    chord = steps[:, 1] * np.sinc(half / np.pi) * np.exp(1j * half)
    z, yaw = composed(chord, steps[:, 2], 0j, 0.0)
    way = np.concatenate([[0.0], np.cumsum(steps[:, 1])])
    place = {int(b[0]): [b[1], b[2], 0.0] for b in beacons}
    flat = np.zeros(len(ranges))
    antenna = [np.interp(ranges[:, 0], t, part) for part in (z.real, z.imag)]
    return (
        ReckonedTrack(
            t, np.stack([z.real, z.imag, np.zeros(len(t))], axis=1), yaw, *growing(way, t - t[0])
        ),
        TrackRanges(
            ranges[:, 0],
            np.stack([*antenna, flat], axis=1),
            np.array([place[int(i)] for i in ranges[:, 2]]),
            ranges[:, 3],
            np.full(len(ranges), 0.5),
        ),
        truth[:, 1] + 1j * truth[:, 2],
    )


def test_plaza2_is_found_with_its_turn_bias_and_range_scale() -> None:
    track, ranges, truth = plaza()
    unknowns = Unknowns(turn_bias=np.radians(0.5), scale=0.01, range_scale=0.1)
    best = find_pose_starts(track, ranges, unknowns)[0]
    assert miss(best, truth) < 0.4
    # 0.00054 rad per 0.1 s too far clockwise; ranges 6.8 to 7.1 % long.
    assert best.turn_bias == pytest.approx(0.0054, abs=5e-4)
    assert best.range_scale == pytest.approx(np.log(1.07), abs=5e-3)


def test_plaza2_with_one_beacon_follows_a_known_start() -> None:
    track, ranges, truth = plaza()
    for beacon in np.unique(ranges.beacon, axis=0):
        here = (ranges.beacon == beacon).all(axis=1)
        part = TrackRanges(
            ranges.t[here],
            ranges.antenna[here],
            ranges.beacon[here],
            ranges.distance[here] / 1.07,
            ranges.sigma[here],
        )
        start = Anchors(
            track.t[:1],
            np.array([[truth[0].real, truth[0].imag, 0.0]]),
            np.full((1, 3), 0.1),
            np.array([-2.021089 + np.pi]),
            np.array([0.01]),
        )
        unknowns = Unknowns(turn_bias=np.radians(0.5), scale=0.01)
        # Dead reckoning alone is 32 m off.
        assert miss(find_pose_starts(track, part, unknowns, start)[0], truth) < 10.0
