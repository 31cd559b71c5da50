from __future__ import annotations

import csv
import json
import math
import pickle
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq

from ubl_graph.acoustics import SoundSpeedProfile, TravelTimes, eigenray, straight
from ubl_graph.errors import ConfigurationError, DataError, NoDirectRayError

# A thermocline over a sound channel, with an isovelocity layer and steps of either sign.
OCEAN = SoundSpeedProfile(
    [0.0, 20.0, 60.0, 150.0, 180.0, 400.0, 900.0, 1500.0],
    [1512.0, 1512.0, 1509.0, 1495.0, 1496.0, 1484.0, 1480.5, 1489.0],
)
LINEAR = SoundSpeedProfile([0.0, 2000.0], [1480.0, 1512.0])
EXAMPLES = settings(max_examples=60, deadline=None, derandomize=True)


def arc_time(x: float, dz: float, ca: float, cb: float, g: float) -> float:
    """Closed form of the time between two points in a constant gradient."""
    return math.acosh(1.0 + g * g * (x * x + dz * dz) / (2.0 * ca * cb)) / abs(g)


def random_ends(rows: int, seed: int, depth: tuple[float, float] = (1.0, 1450.0), far=1500.0):
    rng = np.random.default_rng(seed)
    a, b = (np.c_[rng.uniform(-far, far, (rows, 2)), -rng.uniform(*depth, rows)] for _ in "ab")
    return a, b


def difference(time, a, b, which: str, step: float = 0.05) -> np.ndarray:
    """Fourth-order finite differences of a time by one end."""
    columns = []
    for axis in np.eye(3):

        def at(k: int, axis=axis) -> np.ndarray:
            shift = k * step * axis
            return time(a + shift, b) if which == "a" else time(a, b + shift)

        columns.append((8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * step))
    return np.stack(columns, axis=1)


def textbook(profile: SoundSpeedProfile, p: float, lo: float, hi: float) -> tuple[float, float]:
    """Distance and time of a ray without turning, by quadrature over the depth."""
    marks = [lo, *[z for z in profile.depth if lo < z < hi], hi]
    x = t = 0.0
    for z1, z2 in pairwise(marks):
        c1, c2 = (float(profile.speed_at(z)) for z in (z1, z2))

        def c(z: float, z1=z1, z2=z2, c1=c1, c2=c2) -> float:
            return c1 + (c2 - c1) * (z - z1) / (z2 - z1)

        x += quad(lambda z, c=c: p * c(z) / math.sqrt(1 - (p * c(z)) ** 2), z1, z2)[0]
        t += quad(lambda z, c=c: 1 / c(z) / math.sqrt(1 - (p * c(z)) ** 2), z1, z2)[0]
    return x, t


@st.composite
def profiles(draw: st.DrawFn) -> SoundSpeedProfile:
    n = draw(st.integers(2, 12))
    thickness = draw(st.lists(st.floats(0.5, 300.0), min_size=n, max_size=n))
    speed = draw(st.lists(st.floats(1430.0, 1560.0), min_size=n, max_size=n))
    if draw(st.booleans()):
        speed[n // 2] = speed[n // 2 - 1]
    return SoundSpeedProfile(np.cumsum(thickness) - thickness[0], speed)


points = st.tuples(st.floats(-1500.0, 1500.0), st.floats(-1500.0, 1500.0), st.floats(-1500.0, -0.5))


# ---------------------------------------------------------------- profile


@pytest.mark.parametrize(
    ("depth", "speed", "text"),
    [
        ([0, 10], [1500, 150], r"speed\[1\] is 150 m/s.*1300.*metres per second"),
        ([0, 10], [1800, 1500], r"speed\[0\] is 1800 m/s"),
        ([0, 10], [1500, np.nan], r"speed\[1\] is nan"),
        ([0, np.inf], [1500, 1500], r"depth\[1\] is inf"),
        ([0, 10, 10], [1500, 1500, 1501], r"depth\[2\] is 10 m, not below.*sort"),
        ([0, 10, 5], [1500, 1500, 1501], r"depth\[2\] is 5 m"),
        ([0, 10], [1500], "2 depths but 1 speeds"),
        ([], [], "empty"),
        ([[0, 10]], [[1500, 1500]], "shape"),
        (["a"], [1500], "not an array of numbers"),
    ],
)
def test_a_wrong_profile_is_refused_with_index_and_value(depth, speed, text):
    with pytest.raises(DataError, match=text):
        SoundSpeedProfile(depth, speed)


def test_profile_keeps_read_only_copies_of_its_samples():
    depth, speed = np.array([0.0, 10.0]), np.array([1500.0, 1501.0])
    profile = SoundSpeedProfile(depth, speed)
    speed[0] = 1400.0
    assert profile.speed[0] == 1500.0
    with pytest.raises(ValueError, match="read-only"):
        profile.speed[0] = 1400.0
    assert depth.flags.writeable


def test_profiles_compare_hash_and_pickle_by_their_samples():
    same = SoundSpeedProfile(OCEAN.depth, OCEAN.speed)
    assert same == OCEAN and hash(same) == hash(OCEAN)
    assert same != LINEAR and same != 1
    assert pickle.loads(pickle.dumps(OCEAN)) == OCEAN


def test_constant_profiles_know_it():
    assert SoundSpeedProfile.constant(1500.0).is_constant
    assert SoundSpeedProfile([0, 10, 30], [1500, 1500, 1500]).is_constant
    assert not OCEAN.is_constant
    with pytest.raises(DataError, match=r"speed\[0\] is 15 m/s"):
        SoundSpeedProfile.constant(15.0)


def test_speed_is_linear_between_samples_constant_above_and_continued_below():
    depth = [-5.0, 0.0, 40.0, 1500.0, 1600.0]
    expected = [1512.0, 1512.0, 1510.5, 1489.0, 1489.0 + 100 * 8.5 / 600]
    np.testing.assert_allclose(OCEAN.speed_at(depth), expected, rtol=1e-14)


def test_continued_gradient_stops_at_the_plausible_bounds():
    down = SoundSpeedProfile([0.0, 1.0], [1500.0, 1499.0])
    up = SoundSpeedProfile([0.0, 1.0], [1500.0, 1501.0])
    assert down.speed_at(1e6) == 1300.0 and up.speed_at(1e6) == 1700.0
    assert down.speed_at(50.0) == pytest.approx(1450.0)


def test_harmonic_mean_matches_a_hand_computed_value():
    profile = SoundSpeedProfile([0, 100, 300], [1500, 1500, 1520])
    hand = 300 / (100 / 1500 + math.log1p(20 / 1500) * 200 / 20)
    assert float(profile.harmonic_mean(0.0, 300.0)) == pytest.approx(hand, rel=1e-15)
    assert float(profile.harmonic_mean(300.0, 0.0)) == pytest.approx(hand, rel=1e-15)


@pytest.mark.parametrize("ends", [(3.0, 1490.0), (-20.0, 70.0), (70.0, 80.0), (1400.0, 2000.0)])
def test_harmonic_mean_matches_quadrature(ends):
    lo, hi = ends
    marks = [lo, *[z for z in OCEAN.depth if lo < z < hi], hi]
    integral = sum(
        quad(lambda z: 1 / float(OCEAN.speed_at(z)), z1, z2, epsrel=1e-13)[0]
        for z1, z2 in pairwise(marks)
    )
    assert float(OCEAN.harmonic_mean(lo, hi)) == pytest.approx((hi - lo) / integral, rel=1e-13)


@pytest.mark.parametrize("depth", [0.0, 37.0, 60.0, 1700.0, -3.0])
def test_harmonic_mean_of_nearly_equal_depths_is_the_local_speed(depth):
    height = np.array([0.0, 5e-324, 1e-13, 1e-9, 1e-6, 1e-4])
    mean = OCEAN.harmonic_mean(depth, depth + height)
    np.testing.assert_allclose(mean, OCEAN.speed_at(depth + height / 2), rtol=2e-8)
    np.testing.assert_allclose(mean[:4], OCEAN.speed_at(depth), rtol=1e-12)


def test_harmonic_mean_broadcasts():
    assert OCEAN.harmonic_mean(np.zeros((3, 1)), np.arange(4.0)).shape == (3, 4)
    assert OCEAN.harmonic_mean(1.0, 2.0).shape == ()


# ---------------------------------------------------------------- straight lines


def test_straight_time_is_the_distance_over_the_harmonic_mean():
    a, b = random_ends(50, 1)
    line = straight(OCEAN, a, b)
    expected = np.linalg.norm(b - a, axis=1) / OCEAN.harmonic_mean(-a[:, 2], -b[:, 2])
    np.testing.assert_allclose(line.time, expected, rtol=1e-14)
    assert line.found.all()


@pytest.mark.parametrize("which", ["a", "b"])
def test_straight_gradients_are_exact_derivatives(which):
    a, b = random_ends(300, 2)
    analytic = getattr(straight(OCEAN, a, b), f"gradient_{which}")
    numeric = difference(lambda p, q: straight(OCEAN, p, q).time, a, b, which, 0.02)
    kink = np.abs((-(a if which == "a" else b)[:, 2])[:, None] - OCEAN.depth).min(axis=1) < 0.05
    np.testing.assert_allclose(analytic[~kink], numeric[~kink], atol=1e-13, rtol=1e-9)


@pytest.mark.parametrize("height", [0.0, 1e-14, 1e-9, 1e-5, 1e-3, 0.5, 0.999, 1.001, 3.0])
@pytest.mark.parametrize("depth", [30.0, 60.0 - 1e-6, 150.0 - 0.3, 1800.0])
def test_straight_gradients_hold_for_nearly_equal_depths(depth, height):
    a, b = np.array([0.0, 0.0, -depth]), np.array([3000.0, 0.0, -depth - height])
    line = straight(OCEAN, a, b)
    # d(1/c_h)/dz is the mean of (1/c)' weighted by the distance from the other end.
    lo, hi = depth, depth + max(height, 1e-9)
    nodes = OCEAN.nodes

    def slope(s: float) -> float:
        z = lo + s * (hi - lo)
        return -nodes.gradient[nodes.depth.searchsorted(z, "right")] / OCEAN.speed_at(z) ** 2

    breaks = [0.0, *[(z - lo) / (hi - lo) for z in OCEAN.depth if lo < z < hi], 1.0]
    weight = [
        sum(quad(f, s1, s2, epsrel=1e-12)[0] for s1, s2 in pairwise(breaks))
        for f in (lambda s: (1 - s) * slope(s), lambda s: s * slope(s))
    ]
    d = float(np.linalg.norm(b - a))
    mean = float(line.time[0]) / d
    expected_a = (-(b - a) / d * mean)[2] - d * weight[0]
    expected_b = ((b - a) / d * mean)[2] - d * weight[1]
    assert line.gradient_a[0, 2] == pytest.approx(expected_a, rel=1e-11)
    assert line.gradient_b[0, 2] == pytest.approx(expected_b, rel=1e-11)


def test_straight_is_reciprocal():
    a, b = random_ends(100, 3)
    there, back = straight(OCEAN, a, b), straight(OCEAN, b, a)
    np.testing.assert_array_equal(there.time, back.time)
    np.testing.assert_allclose(there.gradient_a, back.gradient_b, rtol=1e-13, atol=1e-18)


def test_straight_survives_coincident_ends():
    for profile in (OCEAN, SoundSpeedProfile.constant(1500.0)):
        line = straight(profile, [1.0, 2.0, -30.0], [1.0, 2.0, -30.0])
        assert line.time[0] == 0.0
        assert np.isfinite(line.gradient_a).all() and np.isfinite(line.gradient_b).all()


@pytest.mark.parametrize("function", [straight, eigenray])
def test_one_point_is_joined_to_many(function):
    a, b = random_ends(5, 4)
    many = function(OCEAN, a, b[0])
    for k in range(5):
        np.testing.assert_allclose(many.time[k], function(OCEAN, a[k], b[0]).time[0], rtol=1e-15)
    assert function(OCEAN, b[0], a).gradient_b.shape == (5, 3)


@pytest.mark.parametrize("function", [straight, eigenray])
@pytest.mark.parametrize(
    ("a", "b"), [((3, 3), (2, 3)), ((2,), (3,)), ((2, 2), (2, 2)), ((1, 1, 3), (3,))]
)
def test_shapes_that_do_not_fit_are_refused(function, a, b):
    with pytest.raises(DataError, match="shapes"):
        function(OCEAN, np.zeros(a), np.zeros(b))


# ---------------------------------------------------------------- eigenrays


def test_constant_profile_gives_exactly_the_straight_line():
    profile = SoundSpeedProfile([0, 100], [1490, 1490])
    a, b = random_ends(20, 5)
    for ray, line in zip(eigenray(profile, a, b), straight(profile, a, b), strict=True):
        np.testing.assert_array_equal(ray, line)


@pytest.mark.parametrize("gradient", [0.016, -0.016, 0.3, -0.3, 1e-7, -1e-9])
def test_constant_gradient_matches_the_closed_form_with_and_without_turning(gradient):
    profile = SoundSpeedProfile([-400.0, 600.0], [1500 - 400 * gradient, 1500 + 600 * gradient])
    x = np.array([0.0, 1.0, 100.0, 700.0, 700.0, 700.0, 700.0, 700.0])
    lo = np.array([300.0, 300.0, 300.0, 300.0, 300.0, 300.0, 300.0, 290.0])
    hi = np.array([500.0, 500.0, 400.0, 300.0, 300.0 + 1e-9, 300.01, 303.0, 320.0])
    a, b = np.c_[np.zeros((8, 2)), -lo], np.c_[x * 0.6, x * 0.8, -hi]
    ray = eigenray(profile, a, b)
    for k in range(8):
        ca, cb = (float(profile.speed_at(z)) for z in (lo[k], hi[k]))
        d2 = x[k] ** 2 + (hi[k] - lo[k]) ** 2
        u = gradient * math.sqrt(d2 / ca / cb) / 2
        # The same closed form as arccosh(...)/|g|, without its cancellation at small gradients.
        assert ray.time[k] == pytest.approx(2 * math.asinh(u) / gradient, rel=5e-15)
        if abs(gradient) > 0.1 and x[k] > 50.0:
            assert ray.time[k] == pytest.approx(
                arc_time(x[k], hi[k] - lo[k], ca, cb, gradient), rel=1e-10
            )
    assert (ray.time <= straight(profile, a, b).time * (1 + 1e-15)).all()


def test_direct_ray_matches_an_independent_search_and_quadrature():
    a, b = random_ends(25, 6, far=600.0)
    ray = eigenray(OCEAN, a, b, missing="straight")
    checked = 0
    for k in range(25):
        lo, hi = sorted((-a[k, 2], -b[k, 2]))
        x = float(np.hypot(*(b - a)[k, :2]))
        fastest = max(
            *OCEAN.speed_at([lo, hi]),
            *[c for z, c in zip(OCEAN.depth, OCEAN.speed, strict=True) if lo < z < hi],
            0.0,
        )
        steepest = math.sin(math.atan(50.0)) / fastest
        if textbook(OCEAN, steepest, lo, hi)[0] < x:
            continue

        def beyond(p, lo=lo, hi=hi, x=x):
            return textbook(OCEAN, p, lo, hi)[0] - x

        p = brentq(beyond, 0.0, steepest, xtol=1e-18)
        assert ray.found[k]
        assert ray.time[k] == pytest.approx(textbook(OCEAN, p, lo, hi)[1], rel=1e-10)
        assert np.hypot(*ray.gradient_b[k, :2]) == pytest.approx(p, rel=1e-8)
        checked += 1
    assert checked > 15


@pytest.mark.parametrize(
    ("profile", "a", "b"),
    [
        (OCEAN, [0, 0, -9], [900, 1200, -1340]),
        (OCEAN, [0, 0, -1340], [-900, 300, -100]),
        (OCEAN, [0, 0, -1100], [2400, 1800, -1105]),  # turns below, in one layer
        (OCEAN, [0, 0, -500], [2400, 0, -520]),  # turns above
        (OCEAN, [0, 0, -160], [900, 0, -161]),  # turns below
        (LINEAR, [0, 0, -500], [3000, 4000, -500]),
    ],
)
def test_ray_equation_integrated_from_one_end_arrives_at_the_other(profile, a, b):
    a, b = np.array(a, dtype=float), np.array(b, dtype=float)
    ray = eigenray(profile, a, b)
    assert ray.found[0]

    def rate(_t: float, y: np.ndarray) -> np.ndarray:  # dx/dt = c^2 s, ds/dt = -grad c / c
        depth = -y[2]
        c = float(profile.speed_at(depth))
        gradient = profile.nodes.gradient[profile.nodes.depth.searchsorted(depth, "right")]
        return np.array([*(c * c * y[3:]), 0.0, 0.0, gradient / c])

    start = np.concatenate((a, -ray.gradient_a[0]))
    end = solve_ivp(rate, (0.0, ray.time[0]), start, rtol=1e-10, atol=1e-12, max_step=1e-3).y[:, -1]
    np.testing.assert_allclose(end[:3], b, atol=1e-3)
    np.testing.assert_allclose(end[3:], ray.gradient_b[0], atol=1e-9)


def test_moving_a_layer_crossing_never_shortens_the_time():
    # Fermat: the time over the crossings of the ray with the nodes is least at the ray itself.
    a, b = np.array([0.0, 0.0, -9.0]), np.array([1200.0, 0.0, -1340.0])
    ray = eigenray(OCEAN, a, b)
    p = ray.gradient_b[0, 0]
    depth = np.array([9.0, *OCEAN.depth[1:-1], 1340.0])
    c = OCEAN.speed_at(depth)
    w = np.sqrt(1 - (p * c) ** 2)
    dz, g = np.diff(depth), np.diff(c) / np.diff(depth)
    x = np.concatenate(([0.0], np.cumsum(p * dz * (c[1:] + c[:-1]) / (w[1:] + w[:-1]))))
    assert x[-1] == pytest.approx(1200.0, abs=1e-6)

    def time(x: np.ndarray) -> float:
        d = np.hypot(np.diff(x), dz)
        u = g * d / np.sqrt(c[1:] * c[:-1]) / 2
        f = [math.asinh(v) / v if v else 1.0 for v in u]
        return float((d / np.sqrt(c[1:] * c[:-1]) * f).sum())

    least = time(x)
    assert least == pytest.approx(ray.time[0], rel=1e-14)
    for k in range(1, x.size - 1):
        for step in (-1.0, 1.0):
            moved, twice = x.copy(), x.copy()
            moved[k] += step
            twice[k] += 2 * step
            longer = time(moved) - least
            assert longer > 0.0
            assert (time(twice) - least) / longer == pytest.approx(4.0, rel=0.1)


def test_eigenray_is_reciprocal():
    a, b = random_ends(200, 7)
    there = eigenray(OCEAN, a, b, missing="straight")
    back = eigenray(OCEAN, b, a, missing="straight")
    np.testing.assert_array_equal(there.found, back.found)
    np.testing.assert_array_equal(there.time, back.time)
    np.testing.assert_allclose(there.gradient_a, back.gradient_b, rtol=1e-13, atol=1e-18)


@pytest.mark.parametrize("which", ["a", "b"])
def test_eigenray_gradients_match_finite_differences(which):
    a, b = random_ends(300, 8)
    ray = eigenray(OCEAN, a, b, missing="straight")
    numeric = difference(
        lambda p, q: eigenray(OCEAN, p, q, missing="straight").time, a, b, which, 0.02
    )
    analytic = getattr(ray, f"gradient_{which}")
    error = np.abs(analytic - numeric).max(axis=1)[ray.found]
    # Rays at the edge of a shadow are finite on one side only.
    assert ray.found.sum() > 200
    assert np.sort(error)[: int(0.98 * error.size)].max() < 2e-11


def test_turning_gradients_match_finite_differences():
    rng = np.random.default_rng(9)
    a = np.c_[np.zeros((60, 2)), -rng.uniform(950, 1400, 60)]
    b = a + np.c_[rng.uniform(1000, 2500, (60, 2)), rng.uniform(-2, 2, 60)]
    ray = eigenray(OCEAN, a, b)
    assert (ray.gradient_a[:, 2] > 0).all() and (ray.gradient_b[:, 2] > 0).all()  # downward arcs
    for which in "ab":
        numeric = difference(lambda p, q: eigenray(OCEAN, p, q).time, a, b, which, 0.02)
        np.testing.assert_allclose(getattr(ray, f"gradient_{which}"), numeric, atol=2e-11)


def test_gradients_are_slowness_vectors():
    a, b = random_ends(200, 10)
    ray = eigenray(OCEAN, a, b, missing="straight")
    for points, gradient in ((a, ray.gradient_a), (b, ray.gradient_b)):
        slowness = np.linalg.norm(gradient[ray.found], axis=1)
        np.testing.assert_allclose(slowness * OCEAN.speed_at(-points[ray.found, 2]), 1.0, rtol=1e-9)


def test_vertical_ray_has_no_horizontal_gradient_and_the_harmonic_mean_speed():
    a, b = np.array([5.0, 6.0, -9.0]), np.array([5.0, 6.0, -1340.0])
    ray, line = eigenray(OCEAN, a, b), straight(OCEAN, a, b)
    assert ray.time[0] == pytest.approx(line.time[0], rel=1e-15)
    np.testing.assert_array_equal(ray.gradient_a[0, :2], 0.0)
    assert ray.gradient_a[0, 2] == pytest.approx(1 / float(OCEAN.speed_at(9.0)), rel=1e-15)
    assert ray.gradient_b[0, 2] == pytest.approx(-1 / float(OCEAN.speed_at(1340.0)), rel=1e-15)


def test_rays_near_grazing_keep_their_accuracy():
    # One gradient: the reach of the ray without turning is sqrt((cb - ca)(cb + ca)) / g.
    lo, hi = 100.0, 400.0
    ca, cb = (float(LINEAR.speed_at(z)) for z in (lo, hi))
    g = 0.016
    reach = math.sqrt((cb - ca) * (cb + ca)) / g
    offset = np.array([0.0, 1e-12, 1e-9, 1e-6, 1e-3, 1.0, 100.0])
    x = np.concatenate((reach - offset, reach + offset))
    ray = eigenray(LINEAR, [0.0, 0.0, -lo], np.c_[x, 0 * x, 0 * x - hi])
    d = np.hypot(x, hi - lo)
    expected = 2 / g * np.arcsinh(g * d / 2 / math.sqrt(ca * cb))
    np.testing.assert_allclose(ray.time, expected, rtol=1e-14)
    # There d time/dx = x / (t-dependent) follows from the closed form, too.
    slope = x / (d * np.sqrt(ca * cb) * np.sqrt(1 + (g * d) ** 2 / (4 * ca * cb)))
    np.testing.assert_allclose(ray.gradient_b[:, 0], slope, rtol=1e-10)


def test_time_and_gradient_go_on_smoothly_from_direct_to_turning_rays():
    b = np.c_[np.linspace(200.0, 2500.0, 400), np.zeros(400), np.full(400, -1005.0)]
    ray = eigenray(OCEAN, [0.0, 0.0, -1000.0], b)
    turning = ray.gradient_b[:, 2] > 0
    assert 0 < turning.sum() < 400
    slope = np.gradient(ray.time, b[:, 0])
    np.testing.assert_allclose(ray.gradient_b[1:-1, 0], slope[1:-1], rtol=1e-6)


def test_level_ends_in_isovelocity_water_are_joined_by_the_horizontal_line():
    ray = eigenray(OCEAN, [0.0, 0.0, -10.0], [300.0, 400.0, -10.0])
    assert ray.time[0] == pytest.approx(500.0 / 1512.0, rel=1e-15)
    np.testing.assert_allclose(ray.gradient_b[0], np.array([0.6, 0.8, 0.0]) / 1512.0, atol=1e-18)


def test_first_of_several_turning_rays_is_taken():
    # A sound channel with its axis at the ends' depth: rays turn above and below it.
    channel = SoundSpeedProfile([0.0, 500.0, 1000.0], [1500.0, 1490.0, 1520.0])
    ray = eigenray(channel, [0.0, 0.0, -500.0], [4000.0, 0.0, -500.0])
    below, above = arc_time(4000, 0, 1490, 1490, 0.06), arc_time(4000, 0, 1490, 1490, 0.02)
    assert ray.time[0] == pytest.approx(min(below, above), rel=1e-10)
    assert ray.gradient_a[0, 2] > 0  # downward, where the gradient is larger


@pytest.mark.parametrize("x", [300.0, 900.0, 1500.0, 2000.0, 2985.0, 4000.0])
def test_the_first_arrival_is_found_among_rays_turning_in_several_layers(x):
    # Independent: X(p) and T(p) of arcs through layers of unlike gradients, scanned for all p.
    profile = SoundSpeedProfile([0, 100, 110, 130, 300], [1490, 1500, 1500.3, 1500.5, 1520])
    nodes = [1499.0, 1500.0, 1500.3, 1500.5, 1520.0]
    gradients = [0.1, 0.03, 0.01, 19.5 / 170]

    def cover(c_turn: float) -> tuple[float, float]:
        dx = dt = 0.0
        for c1, c2, g in zip(nodes[:-1], nodes[1:], gradients, strict=True):
            w1, w2 = (math.sqrt(max(0.0, 1 - (c / c_turn) ** 2)) for c in (c1, c2))
            if c1 < c_turn:
                dx += 2 * (w1 - w2) * c_turn / g
                dt += 2 * (math.atanh(w1) - math.atanh(w2)) / g
        return dx, dt

    scan = np.concatenate([np.linspace(c1, c2, 2000) for c1, c2 in pairwise(nodes)])
    short = np.array([cover(c)[0] < x for c in scan])
    turns = [
        brentq(lambda c: cover(c)[0] - x, scan[k], scan[k + 1], xtol=1e-12)
        for k in np.flatnonzero(short[:-1] != short[1:])
    ]
    turn = min(turns, key=lambda c: cover(c)[1])
    ray = eigenray(profile, [0, 0, -90.0], [x, 0, -90.0])
    assert ray.time[0] == pytest.approx(cover(turn)[1], rel=1e-9)
    assert ray.gradient_b[0, 0] == pytest.approx(1 / turn, rel=1e-9)
    assert ray.gradient_b[0, 2] == pytest.approx(math.sqrt(1 / 1499.0**2 - turn**-2), rel=1e-5)


SHADOWS = {
    "speed maximum at the ends' depth": ([0, 0, -180.0], [800.0, 0, -180.0]),
    "speed maximum between the ends": ([0, 0, -170.0], [3000.0, 0, -190.0]),
    "turning point above the surface": ([0, 0, -100.0], [20000.0, 0, -101.0]),
}


@pytest.mark.parametrize("ends", SHADOWS.values(), ids=SHADOWS.keys())
def test_shadow_raises_or_falls_back_on_the_straight_line(ends):
    a, b = np.array(ends)
    with pytest.raises(NoDirectRayError, match="1 of 1 rows"):
        eigenray(OCEAN, a, b)
    ray, line = eigenray(OCEAN, a, b, missing="straight"), straight(OCEAN, a, b)
    assert not ray.found[0]
    for got, expected in zip(ray[:3], line[:3], strict=True):
        np.testing.assert_array_equal(got, expected)


def test_missing_rays_are_reported_with_number_row_place_and_reach():
    a = np.array([[0, 0, -9.0], [0, 0, -170.0], [0, 0, -180.0]])
    b = np.array([[500.0, 0, -1340.0], [3000.0, 0, -190.0], [800.0, 0, -180.0]])
    pattern = r"2 of 3 rows.*first row 1: depths 170 and 190 m, 3000 m apart.*reach (\S+) m"
    with pytest.raises(NoDirectRayError, match=pattern) as caught:
        eigenray(OCEAN, a, b)
    reach = float(str(caught.value).split("reach ")[1].split()[0])
    inside, outside = 0.999 * reach, 1.001 * reach
    assert eigenray(OCEAN, a[1], [inside, 0, -190.0]).found[0]
    assert not eigenray(OCEAN, a[1], [outside, 0, -190.0], missing="straight").found[0]


def test_good_rows_are_untouched_by_shadowed_and_broken_rows():
    a, b = random_ends(40, 11, far=300.0)
    clean = eigenray(OCEAN, a, b, missing="straight")
    assume_rows = clean.found
    a2 = np.concatenate((a, [[0, 0, -180.0], [np.nan, 0, -10.0], [0, 0, np.nan], [0, 0, -10.0]]))
    b2 = np.concatenate((b, [[800, 0, -180.0], [0, 0, -10.0], [0, 0, -10.0], [np.inf, 0, -10.0]]))
    mixed = eigenray(OCEAN, a2, b2, missing="straight")
    np.testing.assert_allclose(mixed.time[:40][assume_rows], clean.time[assume_rows], rtol=1e-15)
    assert not mixed.found[40:].any()
    with pytest.raises(NoDirectRayError):
        eigenray(OCEAN, a2, b2)


def test_unknown_mode_for_missing_rays_is_refused():
    with pytest.raises(ConfigurationError, match="'raise' or 'straight'"):
        eigenray(OCEAN, [0, 0, -1.0], [1, 0, -1.0], missing="nan")


def test_no_ray_turns_above_the_sea_surface_of_a_profile_that_starts_above_it():
    profile = SoundSpeedProfile([-100.0, 1000.0], [1510.0, 1488.0])  # 0.02 1/s upward
    assert eigenray(profile, [0, 0, -50.0], [2000.0, 0, -50.0]).found[0]  # 6.7 m up
    with pytest.raises(NoDirectRayError):
        eigenray(profile, [0, 0, -50.0], [6000.0, 0, -50.0])  # would rise 60 m


def test_one_row_equals_the_same_row_in_a_batch():
    a, b = random_ends(2000, 12)
    a[:100, 2] = b[:100, 2] = -1200.0  # turning rays among them
    batch = eigenray(OCEAN, a, b, missing="straight")
    for k in [*range(0, 100, 10), *range(100, 2000, 40)]:
        single = eigenray(OCEAN, a[k], b[k], missing="straight")
        assert single.found[0] == batch.found[k]
        np.testing.assert_allclose(single.time[0], batch.time[k], rtol=1e-15)
        np.testing.assert_allclose(single.gradient_a[0], batch.gradient_a[k], rtol=0, atol=1e-12)


def test_no_rows_give_no_rows():
    for function in (straight, eigenray):
        empty = function(OCEAN, np.empty((0, 3)), np.empty((0, 3)))
        assert empty.time.shape == (0,) and empty.gradient_a.shape == (0, 3)


def test_inputs_are_left_as_they_were():
    a, b = random_ends(10, 13)
    before = a.copy(), b.copy()
    eigenray(OCEAN, a, b, missing="straight")
    straight(OCEAN, a, b)
    np.testing.assert_array_equal(a, before[0])
    np.testing.assert_array_equal(b, before[1])


@pytest.mark.parametrize("depth", [10.0, 20.0, 60.0, 100.0, 1000.0, 1600.0])
@pytest.mark.parametrize("height", [0.0, 5e-324, 1e-14, 1e-9, 1e-5, 1e-2, 1.0])
def test_nearly_equal_depths_differ_little_from_equal_ones(depth, height):
    a, b = [0.0, 0.0, -depth], [80.0, 60.0, -depth - height]
    ray = eigenray(OCEAN, a, b, missing="straight")
    line = straight(OCEAN, a, b)
    assert ray.found[0]
    assert 0.0 <= line.time[0] - ray.time[0] + 1e-16 < 1e-6
    np.testing.assert_allclose(ray.gradient_b, line.gradient_b, atol=1e-5)


def test_coincident_and_nearly_coincident_ends_are_joined():
    for gap in (0.0, 1e-300, 1e-12, 1e-6, 1e-3, 1e-2):
        for direction in np.eye(3):
            a = np.array([0.0, 0.0, -100.0])
            ray = eigenray(OCEAN, a, a + gap * direction)
            length = float(np.linalg.norm((a + gap * direction) - a))
            assert ray.found[0]
            assert ray.time[0] == pytest.approx(length / float(OCEAN.speed_at(100.0)), rel=1e-5)
            assert np.isfinite(ray.gradient_a).all()


@EXAMPLES
@given(profiles(), points, points)
def test_random_profiles_keep_the_bounds_of_fermat_and_reciprocity(profile, a, b):
    a, b = np.array(a), np.array(b)
    ray, line = eigenray(profile, a, b, missing="straight"), straight(profile, a, b)
    assert np.isfinite(ray.time).all() and np.isfinite(ray.gradient_a).all()
    d = float(np.linalg.norm(b - a))
    assume(d > 1e-2)
    assert d / 1700.0 <= ray.time[0] * (1 + 1e-15)
    assert ray.time[0] <= line.time[0] * (1 + 2e-15)
    back = eigenray(profile, b, a, missing="straight")
    assert back.time[0] == ray.time[0] and back.found[0] == ray.found[0]
    if ray.found[0]:
        slowness = np.linalg.norm(ray.gradient_a[0]), np.linalg.norm(ray.gradient_b[0])
        local = 1 / profile.speed_at([-a[2], -b[2]])
        np.testing.assert_allclose(slowness, local, rtol=1e-8)


@EXAMPLES
@given(profiles(), points, points)
def test_random_profiles_have_gradients_that_match_finite_differences(profile, a, b):
    a, b = np.array([a]), np.array([b])
    assume(np.linalg.norm(b - a) > 5.0)
    ends = -np.array([a[0, 2], b[0, 2]])
    assume(np.abs(ends[:, None] - profile.nodes.depth).min() > 0.3)
    around = eigenray(profile, a, b + np.array([[0, 0, 0]]), missing="straight")
    assume(around.found[0])

    def time(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return eigenray(profile, p, q, missing="straight").time

    for which in "ab":
        fine, coarse = (difference(time, a, b, which, step) for step in (0.01, 0.02))
        # Where the two differ the time itself is not smooth: an edge of a shadow, or the change
        # from one first arrival to another.
        assume(np.abs(fine - coarse).max() < 1e-10)
        np.testing.assert_allclose(getattr(around, f"gradient_{which}"), fine, atol=1e-9)


@EXAMPLES
@given(profiles(), points, points)
def test_random_profiles_have_exact_straight_derivatives(profile, a, b):
    a, b = np.array([a]), np.array([b])
    assume(np.linalg.norm(b - a) > 5.0)
    assume(np.abs(-np.array([a[0, 2], b[0, 2]])[:, None] - profile.nodes.depth).min() > 0.1)
    line = straight(profile, a, b)
    for which in "ab":
        numeric = difference(lambda p, q: straight(profile, p, q).time, a, b, which, 0.02)
        np.testing.assert_allclose(getattr(line, f"gradient_{which}"), numeric, atol=1e-11)


# ---------------------------------------------------------------- real pings


def rotated(angles: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return the lever arm in east, north, up for heading, pitch, roll in degrees."""
    h, p, r = np.radians(angles).T
    x, y, z = offset
    y, z = y * np.cos(r) - z * np.sin(r), y * np.sin(r) + z * np.cos(r)
    x, z = x * np.cos(p) + z * np.sin(p), -x * np.sin(p) + z * np.cos(p)
    return np.stack((x * np.sin(h) + y * np.cos(h), x * np.cos(h) - y * np.sin(h), -z), axis=1)


@pytest.fixture(scope="module")
def real_times(saga: Path) -> tuple[TravelTimes, TravelTimes, np.ndarray, np.ndarray]:
    svp = np.loadtxt(saga / "SAGA.1903.kaiyo_k4-svp.csv", delimiter=",", skiprows=1)
    profile = SoundSpeedProfile(svp[:, 0], svp[:, 1])
    solution = json.loads((saga / "SAGA.1903-garpos-solution.json").read_text())["beacons"]
    offset = np.array([1.5547, -1.2690, 23.7295])
    with (saga / "SAGA.1903.kaiyo_k4-obs.csv").open() as file:
        next(file)
        pings = [row for row in csv.DictReader(file) if row["flag"] == "False"]

    def columns(*names: str) -> np.ndarray:
        return np.array([[float(row[name]) for name in names] for row in pings])

    beacon = np.array([solution[row["MT"]]["enu"] for row in pings])
    send, receive = (
        columns(f"ant_e{k}", f"ant_n{k}", f"ant_u{k}")
        + rotated(columns(f"head{k}", f"pitch{k}", f"roll{k}"), offset)
        for k in "01"
    )
    measured, sent = columns("TT", "ST").T
    return eigenray(profile, send, beacon), eigenray(profile, beacon, receive), measured, sent


def test_real_two_way_times_are_matched_as_well_as_the_sound_speed_allows(real_times):
    out, back, measured, sent = real_times
    assert out.found.all() and back.found.all()
    # The data's README says 0.84 and 0.24 ms, which is without the 17 outliers.
    residual = 1e3 * (out.time + back.time - measured)
    assert math.sqrt(np.mean(residual**2)) == pytest.approx(0.847, abs=0.001)
    assert residual.std() == pytest.approx(0.2455, abs=0.001)
    # Against the median of its neighbours in time, a ping is an outlier beyond 0.35 ms.
    drift = residual / measured
    near = np.abs(sent[:, None] - sent) < 60.0
    median = np.array([np.median(drift[row]) for row in near])
    inlier = np.abs(residual - median * measured) < 0.35
    assert np.count_nonzero(~inlier) == 17
    assert math.sqrt(np.mean(residual[inlier] ** 2)) == pytest.approx(0.843, abs=0.001)
    assert residual[inlier].std() == pytest.approx(0.240, abs=0.001)
