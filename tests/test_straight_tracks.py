"""Straight tracks whose odometry is noisy, and beacons in line: what no ping can tell is not told.

The oracle is symmetry: mirrored in the vertical plane through the beacons and along the track,
every range stays the same, whatever the noise of the odometry seems to say.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ubl_graph import Beacon, Mission, Options, Segment, SoundSpeedProfile, smooth
from ubl_graph.graph import build_problem, model_segment
from ubl_graph.sim import Sea, Truth, ahrs, dvl, lawn_mower, pressure, two_way_pings
from ubl_graph.sim.tracks import constant_velocity
from ubl_graph.smoother import smooth as solve
from ubl_graph.solve.evidence import evidence, on_same_terms
from ubl_graph.steadiness import log_mass, sees_shape, wandering

PROFILE = SoundSpeedProfile.constant(1500.0)
DEEP = -4000.0


def pinged(
    truth: Truth, beacons: tuple[Beacon, ...], seed: int, *, odometry: bool = True, name: str = ""
) -> Segment:
    """Pings every 10 s, depths, and a DVL with the noise that it states."""
    rng = np.random.default_rng(seed)
    end = truth.span[1] - 15.0
    t = np.arange(0.0, end)
    moved = {"velocity": dvl(truth, t, rng), "attitude": ahrs(truth, t)} if odometry else {}
    return Segment(
        name=name,
        two_way_range=two_way_pings(
            truth, beacons, np.arange(2.0, end - 6.0, 10.0), Sea(PROFILE), rng
        ),
        depth=pressure(truth, t[::5], rng),
        **moved,
    )


def line(off: float, duration: float = 900.0) -> Truth:
    """Eastward, `off` metres north of the beacons' line, 60 m above them."""
    return constant_velocity([-600.0, off, DEEP + 60.0], [1.4, 0.0, 0.0], (0.0, duration + 20.0))


def beacons(*east: float) -> tuple[Beacon, ...]:
    return tuple(Beacon(f"B{i + 1}", [e, 0.0, DEEP]) for i, e in enumerate(east))


def mission(some: tuple[Beacon, ...], *segments: Segment, **options: object) -> Mission:
    return Mission(segments, some, PROFILE, options=Options(**options))


def on_truth(result, truth: Truth, index: int = 0) -> list[float]:
    """How far each hypothesis of a segment is from the truth, rms, m."""
    out = []
    for hypothesis in result.segments[index].hypotheses:
        track = hypothesis.trajectory
        gap = track.position - truth.position(track.t)
        out.append(float(np.sqrt(np.mean(np.sum(gap[:, :2] ** 2, axis=1)))))
    return out


@pytest.mark.parametrize("seed", range(6))
def test_noise_of_the_odometry_tells_no_side(seed):
    truth = line(490.0, 1500.0)
    some = beacons(300.0)
    result = smooth(mission(some, pinged(truth, some, seed)))
    assert result.status == "unobservable"
    weights = [h.weight for h in result.hypotheses[""]]
    assert weights == pytest.approx([0.5, 0.5], abs=0.02)
    off = on_truth(result, truth)
    assert min(off) < 30.0 and max(off) > 900.0


def test_a_turn_that_the_odometry_sees_tells_the_side():
    some = beacons(0.0)
    truth = lawn_mower(
        [300.0, -400.0], depth=-DEEP - 60.0, lines=3, length=500.0, spacing=80.0, speed=1.5
    )
    result = smooth(mission(some, pinged(truth, some, 1)))
    assert result.status == "converged"
    assert result.hypotheses[""][0].weight > 0.99
    assert on_truth(result, truth)[0] < 15.0


@pytest.mark.parametrize("east", [(-500.0, 500.0), (-500.0, 0.0, 500.0)])
def test_beacons_in_line_with_the_track_leave_its_image(east):
    some, truth = beacons(*east), line(300.0)
    result = smooth(mission(some, pinged(truth, some, 3)))
    assert result.status == "unobservable"
    assert result.hypotheses[""][0].weight == pytest.approx(0.5, abs=0.02)
    off = on_truth(result, truth)
    assert min(off) < 1.0 and max(off) == pytest.approx(600.0, abs=2.0)


def test_each_of_several_lines_has_its_image():
    some, tracks = beacons(-500.0, 500.0), (line(300.0), line(-260.0))
    segments = [pinged(t, some, k, name=f"L{k}") for k, t in enumerate(tracks)]
    result = smooth(mission(some, *segments))
    for k, track in enumerate(tracks):
        assert result.segments[k].status == "unobservable"
        assert min(on_truth(result, track, k)) < 1.0
        assert max(on_truth(result, track, k)) > 500.0


def test_two_beacons_without_odometry_leave_the_image_of_any_track():
    """Whatever the track does, the plane through both beacons mirrors it."""
    some = beacons(-700.0, 700.0)
    truth = lawn_mower(
        [-200.0, 350.0],
        depth=-DEEP - 60.0,
        lines=4,
        length=300.0,
        spacing=60.0,
        speed=1.5,
        course=np.deg2rad(30.0),
    )
    assert truth.position(np.linspace(*truth.span))[:, 1].min() > 20.0
    result = smooth(mission(some, pinged(truth, some, 2, odometry=False)))
    assert result.status == "unobservable"
    first, second = result.hypotheses[""][:2]
    assert first.weight == pytest.approx(second.weight, abs=1e-3)
    assert first.cost == pytest.approx(second.cost, abs=1e-3)
    image = second.trajectory.position * [1.0, -1.0, 1.0]
    np.testing.assert_allclose(first.trajectory.position, image, atol=0.05)
    assert min(on_truth(result, truth)) < 10.0


def test_a_track_that_crosses_the_mirror_is_found_folded_or_not():
    """Having come to the mirror a vehicle may go on or turn back; a third beacon tells."""
    some = (*beacons(-700.0, 700.0), Beacon("off", [0.0, 40.0, DEEP]))
    truth = lawn_mower(
        [-200.0, -150.0], depth=-DEEP - 60.0, lines=3, length=300.0, spacing=60.0, speed=1.5
    )
    result = smooth(mission(some, pinged(truth, some, 2, odometry=False)))
    assert min(on_truth(result, truth)) < 10.0


def test_the_mass_is_summed_over_how_much_the_vehicle_wanders():
    """Against the same sum made here, over scales of the same prior, by whole evidences."""
    some, truth = beacons(300.0), line(490.0, 400.0)
    made = mission(some, pinged(truth, some, 1), loss="none")
    result = solve(made)
    problem = build_problem(made, [model_segment(made.segments[0], made.options)])
    layout = problem.layout
    x = np.zeros(layout.size)
    track = result.trajectory
    layout.put(x, "position", track.position)
    layout.put(x, "velocity", track.velocity)
    mass, at = log_mass(problem, x)
    free = evidence(problem, x)
    np.testing.assert_allclose(at, free.x, atol=1e-6)
    span = float(np.ptp(track.t))
    least = 3.0 * 0.02**2 / span**3
    count = int(np.ceil(np.log(1.0 / least) / np.log(100.0)))
    scales = np.geomspace(1.0, least, count + 1)
    values = [evidence(wandering(problem, q), free.x).log for q in scales]
    prior = [0.5 / count] * count + [0.5]
    expected = np.logaddexp.reduce(np.log(prior) + values)
    assert mass == pytest.approx(expected, abs=0.02)
    # A straight track is best explained by a vehicle that goes straight.
    assert np.argmax(values) >= count - 3
    same = on_same_terms(wandering(problem, scales[-1]), free, free.x)
    assert same.log == pytest.approx(values[-1], abs=0.02)


def test_only_who_measures_the_shape_can_mistake_noise_for_it():
    some, truth = beacons(-500.0, 500.0), line(300.0, 300.0)
    for odometry in (True, False):
        made = mission(some, pinged(truth, some, 1, odometry=odometry))
        model = model_segment(made.segments[0], made.options)
        assert sees_shape(build_problem(made, [model])) == odometry
    pose = replace(made, options=Options(node="pose2"), segments=(pinged(truth, some, 1),))
    model = model_segment(pose.segments[0], pose.options)
    assert sees_shape(build_problem(pose, [model]))
