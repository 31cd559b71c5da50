"""Dilution of precision, rank and mirror images against closed forms, papers and dense algebra."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from problems import everything
from scipy import sparse

import ubl_graph
from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.beacon import Beacon
from ubl_graph.errors import ConfigurationError, DataError
from ubl_graph.graph import build_problem, model_segment
from ubl_graph.mission import Mission, Segment, Start
from ubl_graph.observability import (
    dops,
    graph_dops,
    mirror_image,
    observability,
    rank,
    window_design,
    window_dops,
)
from ubl_graph.observability.directions import reduced
from ubl_graph.options import Options
from ubl_graph.sim import (
    Sea,
    ahrs,
    constant_velocity,
    dvl,
    pressure,
    straight_pass,
    two_way_pings,
    xue_pass,
)

SQUARE = 750.0 * np.array([[0.0, 1.0], [-1.0, 0.0], [0.0, -1.0], [1.0, 0.0]])


def static(vehicle, beacons, **kwargs):
    offset = np.asarray(vehicle) - beacons
    return window_design(offset[:, None], np.zeros((len(beacons), 1)), 0, **kwargs)


# --- dilution of precision


@pytest.mark.parametrize("height", [0.0, 300.0, 1500.0])
def test_in_the_middle_of_a_square_the_dilution_is_that_of_the_grazing_angle(height):
    beacons = np.column_stack([SQUARE, np.full(4, -height)])
    slant = np.hypot(750.0, height)
    found = dops(*static([0.0, 0.0, 0.0], beacons))
    assert found.total == pytest.approx(slant / 750.0, rel=1e-12)
    if height:
        found = dops(*static([0.0, 0.0, 0.0], beacons, vertical=True))
        expected = np.sqrt((slant / 750.0) ** 2 + (slant / height) ** 2 / 4.0)
        assert found.position == pytest.approx(expected, rel=1e-12)


def test_a_vehicle_at_rest_seen_before_and_after_has_position_and_velocity_apart():
    """Each of four beacons is asked at -tau and +tau: A'A is diagonal and can be read off."""
    tau = 17.0
    beacons = np.column_stack([np.tile(SQUARE, (2, 1)), np.zeros(8)])
    elapsed = np.repeat([-tau, tau], 4)[:, None]
    found = dops(*window_design(-beacons[:, None], elapsed, 1))
    assert found.position == pytest.approx(np.sqrt(2.0 / 4.0), rel=1e-12)
    assert found.velocity == pytest.approx(np.sqrt(2.0 / 4.0) / tau, rel=1e-12)
    assert found.acceleration == 0.0


@pytest.mark.parametrize(
    ("track", "order", "paper", "within"),
    [
        ("straight", 0, 1.5000, 1e-3),
        ("accelerating", 0, 1.5029, 1e-3),
        ("spiral", 0, 1.4982, 5e-3),
        ("straight", 1, 0.7975, 0.01),
        ("accelerating", 1, 0.8006, 0.01),
        ("spiral", 1, 0.7867, 0.01),
        ("straight", 2, 1.6857, 0.02),
        ("accelerating", 2, 1.6747, 0.02),
        ("spiral", 2, 1.4260, 0.02),
    ],
)
def test_the_windows_of_xue_2024_have_the_papers_trdop(track, order, paper, within):
    mission, truth = xue_pass(track, noise=0.0)
    epoch, found = window_dops(mission, mission.segments[0], truth.position, order=order)
    assert len(epoch) == 94
    assert found.total.mean() == pytest.approx(paper, rel=within)
    parts = found.position**2 + found.velocity**2 + found.acceleration**2
    np.testing.assert_allclose(found.total**2, parts)


def test_as_many_pings_as_parameters_or_fewer_dilute_without_limit():
    mission, truth = xue_pass(noise=0.0)
    _, few = window_dops(mission, mission.segments[0], truth.position, pings=5, order=2)
    assert np.isinf(few.total).all()
    with pytest.raises(DataError, match="101 two-way ranges, less than a window of 102"):
        window_dops(mission, mission.segments[0], truth.position, pings=102)


def test_what_is_open_is_infinite_and_what_is_not_stays_finite():
    """Beacons due north alone: north is known by all of them, east by none."""
    found = dops([[0.0, 1.0], [0.0, 1.0]], {"position": [1], "velocity": [0]})
    assert found.position == pytest.approx(np.sqrt(0.5))
    assert np.isinf(found.velocity)
    # An unknown that is summed nowhere costs what it is correlated with.
    both = dops([[1.0, 1.0], [1.0, -1.0], [1.0, 1.0]], {"position": [0]})
    alone = dops([[1.0], [1.0], [1.0]], {"position": [0]})
    assert both.position > alone.position


angles = st.floats(0.0, 2.0 * np.pi)
shifts = st.tuples(*[st.floats(-1e4, 1e4)] * 3)


@given(angles, shifts, st.integers(0, 2), st.integers(0, 1000))
def test_dilution_knows_neither_north_nor_zero(angle, shift, order, seed):
    rng = np.random.default_rng(seed)
    vehicle = rng.uniform(-500.0, 500.0, (9, 2, 3))
    beacons = rng.uniform(-1000.0, 1000.0, (9, 1, 3)) - [0.0, 0.0, 2500.0]
    elapsed = np.sort(rng.uniform(-40.0, 40.0, (9, 2)), axis=0)
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    here = dops(*window_design(vehicle - beacons, elapsed, order))
    moved = (vehicle @ turn.T + shift) - (beacons @ turn.T + shift)
    there = dops(*window_design(moved, elapsed, order))
    for name in ("position", "velocity", "acceleration"):
        np.testing.assert_allclose(getattr(there, name), getattr(here, name), rtol=1e-6)


@pytest.mark.parametrize(("motion", "order"), [("velocity", 1), ("acceleration", 2)])
def test_a_graph_that_is_a_windows_least_squares_has_its_dilution(motion, order):
    """No motion noise, exact depth, exact speed of sound: what is left is the polynomial."""
    mission, truth = straight_pass(duration=48.0, noise=0.0)
    options = Options(
        motion=f"constant_{motion}",
        acceleration_psd=1e-14,
        jerk_psd=1e-17,
        estimate_sound_speed=False,
        loss="none",
    )
    depth = replace(mission.segments[0].depth, sigma=np.full(49, 1e-5))
    segment = replace(mission.segments[0], depth=depth)
    mission = replace(mission, segments=(segment,), options=options)
    result = ubl_graph.smooth(mission)
    found = graph_dops(mission, result.segments[0])
    track = result.segments[0].trajectory
    rows = segment.two_way_range
    times = np.stack([rows.t_transmit, rows.t_receive], axis=1)
    where = np.stack([b.position for b in mission.beacons])[mission.beacon_numbers(rows.beacon)]
    offset = truth.position(times.ravel()).reshape(*times.shape, 3) - where[:, None]
    nodes = np.arange(0, len(track.t), 5)
    for node in nodes:
        window = dops(*window_design(offset, times - track.t[node], order))
        for name in ("position", "velocity", "acceleration"):
            expected = getattr(window, name)
            assert getattr(found, name)[node] == pytest.approx(expected, rel=2e-3), name
    with_up = graph_dops(mission, result.segments[0], vertical=True)
    assert (with_up.position >= found.position).all()


def test_dilution_of_what_has_no_ranges_is_refused():
    mission, _ = straight_pass(duration=40.0)
    result = ubl_graph.smooth(mission)
    for lacking in (
        replace(result.segments[0], residuals=None),
        replace(result.segments[0], trajectory=replace(result.trajectory[""], joint=None)),
    ):
        with pytest.raises(DataError, match="no ranges or no covariances"):
            graph_dops(mission, lacking)


# --- rank


def cao_window(north, east, *, vertical):
    """Ten ranges to virtual beacons of a straight way east, 1 m/s, 10 s apart (Cao 2017)."""
    beacons = np.zeros((10, 3))
    beacons[:, 0] = 10.0 * np.arange(9, -1, -1)
    beacons[:, 2] = -4000.0
    return static([east, north, -4100.0], beacons, vertical=vertical)[0]


@pytest.mark.parametrize("north", [-2000.0, -1.0, 0.0, 35.0, 3000.0])
@pytest.mark.parametrize("east", [-2500.0, -300.0, 1200.0])
def test_a_straight_track_leaves_one_direction_open_with_depth_and_none_without(north, east):
    states = {"position": [0, 1, 2]}
    solid = rank(cao_window(north, east, vertical=True), states)
    assert (solid.rank, solid.deficiency) == (2, 1)
    # It turns about the line through the beacon along the course.
    assert solid.singular_values[2] < 1e-12
    (word,) = solid.unobserved
    assert "0/180" in word or "vertically" in word
    flat = rank(cao_window(north, east, vertical=False), {"position": [0, 1]})
    assert flat.rank == (1 if north == 0.0 else 2)
    assert flat.unobserved == (("position along 0/180 degrees",) if north == 0.0 else ())


def test_names_and_scales():
    nothing = rank(np.zeros((3, 4)), {"position": [0, 1, 2], "sound_speed": [3]})
    assert nothing.unobserved == ("position in every direction", "sound_speed")
    weak = rank([[1.0, 0.0], [0.0, 0.1]], {"position": [0, 1]}, scale=[5.0, 5.0], least=2.0)
    assert weak.singular_values.tolist() == [5.0, 0.5]
    assert (weak.rank, weak.unobserved) == (1, ("position along 0/180 degrees",))


@given(st.integers(0, 10_000))
def test_elimination_leaves_schurs_complement(seed):
    rng = np.random.default_rng(seed)
    dense = rng.standard_normal((30, 9)) * (rng.random((30, 9)) < 0.5)
    dense[:9] += 3.0 * np.eye(9)
    turn = np.array([0, 0, 1, 1, 2, 2, -1, -1, -1])
    left = reduced(sparse.csr_array(dense), turn)
    free, kept = dense[:, :6], dense[:, 6:]
    projected = kept - free @ np.linalg.lstsq(free, kept, rcond=None)[0]
    np.testing.assert_allclose(left.T @ left, projected.T @ projected, atol=1e-9)


def test_elimination_of_a_real_problem():
    """All kinds of rows; what is left must be the dense Schur complement of the same Jacobian."""
    mission = everything()
    problem = build_problem(mission, [model_segment(s, mission.options) for s in mission.segments])
    layout = problem.layout
    x = np.zeros(layout.size)
    layout.put(x, "position", np.tile([50.0, 20.0, -10.0], (layout.node_count, 1)))
    _, jacobian = problem.linearize(x, problem.frozen(x))
    turn = np.repeat(np.arange(layout.node_count), layout.node_width)
    turn[turn == layout.node_count - 1] = -1
    turn = np.append(turn, np.full(layout.size - len(turn), -1))
    left = reduced(jacobian, turn)
    dense = jacobian.toarray()
    free, kept = dense[:, turn >= 0], dense[:, turn < 0]
    rest = np.linalg.qr(np.hstack([free, kept]), mode="r")[free.shape[1] :, free.shape[1] :]
    np.testing.assert_allclose(left.T @ left, rest.T @ rest, rtol=1e-6, atol=1e-9)


# --- missions


ONE = (Beacon("B", [0.0, 0.0, -200.0]),)


def pass_by(*, beacons=ONE, start=None, odometry=True, depth=True, turn=False, noise=1.0):
    """A vehicle passing one beacon on a straight course, or with a turn in the middle."""
    rng = np.random.default_rng(3)
    truth = constant_velocity([-600.0, 400.0, -60.0], [1.5, 0.0, 0.0], (0.0, 805.0))
    if turn:
        straight = truth.motion

        def bent(t):
            late = np.maximum(t - 400.0, 0.0)
            position, velocity = straight(t)
            position = position + np.stack([-1.5 * late, -1.5 * late, 0.0 * t], axis=1)
            return position, velocity + (late > 0.0)[:, None] * [-1.5, -1.5, 0.0]

        truth = replace(truth, motion=bent)
    sea = Sea(SoundSpeedProfile.constant(1500.0))
    sent = np.arange(0.0, 800.0, 10.0)
    times = np.arange(0.0, 803.0)
    segment = Segment(
        two_way_range=two_way_pings(truth, beacons, sent, sea, rng, noise=noise),
        velocity=dvl(truth, times, rng, noise=noise) if odometry else None,
        attitude=ahrs(truth, times) if odometry else None,
        depth=pressure(truth, times, rng, noise=noise) if depth else None,
        start=start,
    )
    return Mission((segment,), beacons, sea.profile), truth


def test_a_straight_pass_by_one_beacon_has_a_mirror_image():
    mission, _ = pass_by(noise=0.0)
    (report,) = observability(mission).values()
    mirror = report.mirror
    assert mirror.ambiguous
    assert mirror.separation == pytest.approx(800.0, abs=1.0)
    assert mirror.range_sigmas < 0.05
    assert mirror.cost < 0.01
    assert "nothing tells it apart" in report.summary


@pytest.mark.parametrize(
    "change",
    [
        {"start": Start(0.0, -600.0, 400.0, sigma=20.0)},
        {"turn": True},
        {"beacons": (*ONE, Beacon("C", [50.0, 300.0, -210.0]))},
    ],
    ids=["start", "turn", "second beacon"],
)
def test_a_start_a_turn_or_a_second_beacon_tells_the_image_apart(change):
    mission, _ = pass_by(**change)
    (report,) = observability(mission).values()
    assert report.mirror is not None
    assert not report.mirror.ambiguous
    assert "nothing tells it apart" not in report.summary


def test_without_depth_a_straight_pass_is_open_across():
    told = observability(pass_by()[0])[""].measured
    mission, _ = pass_by(depth=False)
    report = observability(mission)[""]
    assert report.measured.deficiency > told.deficiency
    assert any(word.startswith("position") for word in report.measured.unobserved)


def test_without_odometry_one_beacon_leaves_the_turn_about_it_open():
    mission, _ = pass_by(odometry=False)
    result = ubl_graph.smooth(mission)
    assert result.status == "unobservable"
    report = observability(mission, result)[""]
    assert report.measured.deficiency >= 1
    assert {w.split()[0] for w in report.measured.unobserved} >= {"position", "velocity"}
    assert report.mirror.ambiguous
    assert report.mirror.range_sigmas < 1e-6


def test_four_beacons_tell_everything_and_the_heading_bias_hides_in_the_misalignment():
    (report,) = observability(straight_pass()[0]).values()
    assert report.measured.deficiency == 0
    assert report.measured.unobserved == ()
    assert not report.mirror.ambiguous
    # Without priors DVL misalignment about up and heading bias are one; with them both are known.
    report = observability(pass_by(turn=True)[0])[""]
    assert {w.split()[0] for w in report.measured.unobserved} >= {
        "dvl_misalignment",
        "heading_bias",
    }
    assert report.informed.deficiency < report.measured.deficiency


def test_a_start_that_was_left_out_and_segments_without_ranges():
    wrong = Start(0.25, 3000.0, 3000.0, sigma=5.0)
    mission, truth = straight_pass()
    fixed = Segment(
        "fixes", position=ubl_graph.sim.fixes(truth, [0.0, 9.0], np.random.default_rng(0))
    )
    lone = replace(mission.segments[0], name="pings", start=wrong)
    mission = replace(mission, segments=(lone, fixed))
    result = ubl_graph.smooth(mission)
    assert any("left out" in w for w in result.warnings)
    reports = observability(mission, result)
    assert list(reports) == ["pings"]
    assert len(reports["pings"].t) == len(result.trajectory["pings"].t)


@given(st.integers(0, 10_000), st.booleans())
def test_an_image_of_an_image_is_the_track_and_one_beacon_cannot_tell(seed, odometry):
    rng = np.random.default_rng(seed)
    track = np.cumsum(rng.standard_normal((20, 3)), axis=0) + rng.uniform(-500, 500, 3)
    beacon = rng.uniform(-100.0, 100.0, (1, 3))
    image = mirror_image(track, beacon, odometry=odometry)
    again = mirror_image(image, beacon, odometry=odometry)
    np.testing.assert_allclose(again, track, atol=1e-6)
    np.testing.assert_array_equal(image[:, 2], track[:, 2])
    if odometry:
        np.testing.assert_allclose(np.diff(image, axis=0), np.diff(track, axis=0), atol=1e-9)
    else:
        far = [np.linalg.norm(p - beacon, axis=1) for p in (track, image)]
        np.testing.assert_allclose(far[0], far[1], rtol=1e-9)


def test_beacons_on_a_line_are_a_mirror_whatever_the_course():
    track = np.column_stack([np.linspace(0, 300, 9), np.linspace(50, 400, 9), np.full(9, -50.0)])
    line = np.array([[0.0, 0.0, -200.0], [100.0, 20.0, -210.0], [300.0, 60.0, -190.0]])
    image = mirror_image(track, line)
    far = [np.linalg.norm(p[:, None] - line, axis=2) for p in (track, image)]
    np.testing.assert_allclose(far[0], far[1], rtol=1e-9)
    assert np.linalg.norm(image - track, axis=1).min() > 50.0


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: dops([[1.0, np.nan]], {"position": [0]}),
        lambda: dops([1.0, 2.0], {"position": [0]}),
        lambda: dops([[1.0, 0.0]], {"pos": [0]}),
        lambda: dops([[1.0, 0.0]], {"position": [2]}),
        lambda: window_design(np.ones((4, 1, 3)), np.zeros((4, 1)), 3),
        lambda: window_dops(*_passing(), pings=0),
        lambda: window_dops(*_passing(), order=-1),
        lambda: window_dops(*_passing(), pings=1000),
    ],
)
def test_what_has_no_dilution_is_refused(wrong):
    with pytest.raises((DataError, ConfigurationError)):
        wrong()


def _passing():
    mission, truth = straight_pass(duration=48.0, noise=0.0)
    return mission, mission.segments[0], truth.position
