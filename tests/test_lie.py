"""The groups of rotations and rigid motions against GTSAM, scipy and finite differences.

GTSAM counts what is about the axes first; `ABOUT_FIRST` turns one order into the other.
"""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from ubl_graph import lie

ABOUT_FIRST = np.array([3, 4, 5, 0, 1, 2])
#: Angles at which something changes: none, tiny, on either side of the series' end, near half a
#: turn and beyond it, near a full turn.
SEAM = float(np.sqrt(lie.SERIES_LIMIT))
ANGLES = (
    0.0,
    1e-12,
    1e-8,
    1e-4,
    0.1,
    SEAM * (1.0 - 1e-9),
    SEAM * (1.0 + 1e-9),
    2.0,
    np.pi - 1e-3,
    np.pi - 1e-9,
    np.pi + 1e-3,
    5.0,
)
BY_ANGLE = pytest.mark.parametrize("angle", ANGLES)

angles = st.floats(0.0, np.pi - 1e-3)
seeds = st.integers(0, 2**32 - 1)
hundred = settings(max_examples=100, derandomize=True, deadline=None)


def twists(angle: float, count: int = 8, seed: int = 0) -> np.ndarray:
    """Twists (M, 6) of some angle about axes of any direction, along vectors of some metres."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    return np.concatenate([3.0 * rng.normal(size=(count, 3)), angle * axis], axis=1)


def as_matrix(twist: np.ndarray) -> np.ndarray:
    """A twist as the 4 x 4 matrix whose exponential is its pose."""
    out = np.zeros((4, 4))
    out[:3, :3] = np.cross(np.eye(3), twist[3:])
    out[:3, 3] = twist[:3]
    return out


def gtsam_pose(rotation: np.ndarray, position: np.ndarray) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3(rotation), position)


def product(one: tuple, two: tuple) -> tuple[np.ndarray, np.ndarray]:
    """Poses one after another."""
    return one[0] @ two[0], one[1] + np.einsum("mij,mj->mi", one[0], two[1])


def reordered(matrix: np.ndarray) -> np.ndarray:
    return matrix[np.ix_(ABOUT_FIRST, ABOUT_FIRST)]


def differences(function, at: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """Derivative of a function of (6,) by central differences of the fourth order."""
    columns = []
    for unit in np.eye(len(at)):
        near = function(at + step * unit) - function(at - step * unit)
        far = function(at + 2.0 * step * unit) - function(at - 2.0 * step * unit)
        columns.append((8.0 * near - far) / (12.0 * step))
    return np.stack(columns, axis=-1)


def test_a_cross_matrix_multiplies():
    rng = np.random.default_rng(1)
    v, w = rng.normal(size=(2, 20, 3))
    np.testing.assert_allclose(
        np.einsum("mij,mj->mi", lie.cross_matrix(v), w), np.cross(v, w), atol=1e-14
    )


@BY_ANGLE
def test_exponentials_are_those_of_matrices(angle):
    x = twists(angle)
    rotation, position = lie.exponential(x)
    np.testing.assert_allclose(rotation, lie.rotation(x[:, 3:]), atol=1e-15)
    for i, twist in enumerate(x):
        whole = expm(as_matrix(twist))
        np.testing.assert_allclose(rotation[i], whole[:3, :3], atol=2e-14)
        np.testing.assert_allclose(position[i], whole[:3, 3], atol=5e-14)


@BY_ANGLE
def test_rotations_are_scipys(angle):
    vector = twists(angle)[:, 3:]
    expected = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(lie.rotation(vector), expected, atol=5e-15)


@pytest.mark.parametrize("angle", [a for a in ANGLES if a < np.pi - 1e-6])
def test_logarithms_are_gtsams(angle):
    """GTSAM's own is off by 1e-7 a thousandth of a radian from half a turn."""
    exact = 1e-9 if angle < 3.0 else 1e-6
    x = twists(angle)
    rotation, position = lie.exponential(x)
    found = lie.logarithm(rotation, position)
    np.testing.assert_allclose(found, x, atol=1e-11)
    for i in range(len(x)):
        expected = gtsam.Pose3.Logmap(gtsam_pose(rotation[i], position[i]))
        np.testing.assert_allclose(found[i], expected[ABOUT_FIRST], atol=exact)


@given(angles, seeds)
@hundred
def test_the_logarithm_undoes_the_exponential(angle, seed):
    x = twists(angle, 4, seed)
    np.testing.assert_allclose(lie.logarithm(*lie.exponential(x)), x, atol=1e-10)


def test_the_logarithm_at_half_a_turn_leads_there():
    for angle in (np.pi - 1e-9, np.pi, np.pi + 1e-9):
        pose = lie.exponential(twists(angle))
        found = lie.logarithm(*pose)
        assert (np.linalg.norm(found[:, 3:], axis=1) <= np.pi + 1e-12).all()
        for one, other in zip(lie.exponential(found), pose, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-7)


@given(seeds, st.floats(0.0, 6.0), st.floats(0.0, 6.0))
@hundred
def test_adjoints_carry_twists_through_poses(seed, one, two):
    """T Exp(x) = Exp(Ad x) T."""
    pose, x = lie.exponential(twists(one, 3, seed)), twists(two, 3, seed ^ 1)
    ad = lie.adjoint(*pose)
    right = product(pose, lie.exponential(x))
    left = product(lie.exponential(np.einsum("mij,mj->mi", ad, x)), pose)
    for a, b in zip(left, right, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-10)
    for i in range(3):
        expected = reordered(gtsam_pose(pose[0][i], pose[1][i]).AdjointMap())
        np.testing.assert_allclose(ad[i], expected, atol=1e-12)


@given(seeds)
@hundred
def test_small_adjoints_are_gtsams_and_anticommute(seed):
    x, y = twists(1.3, 3, seed), twists(0.4, 3, seed ^ 1)
    ad = lie.small_adjoint(x)
    forth = np.einsum("mij,mj->mi", ad, y)
    back = np.einsum("mij,mj->mi", lie.small_adjoint(y), x)
    np.testing.assert_allclose(forth, -back, atol=1e-12)
    for i in range(3):
        np.testing.assert_allclose(ad[i], reordered(gtsam.Pose3.adjointMap(x[i][ABOUT_FIRST])))


@given(seeds, angles, angles)
@hundred
def test_between_is_the_second_pose_seen_from_the_first(seed, one, two):
    first, second = (lie.exponential(twists(a, 3, seed + i)) for i, a in enumerate((one, two)))
    rotation, position = lie.between(*first, *second)
    for i in range(3):
        expected = gtsam_pose(first[0][i], first[1][i]).between(
            gtsam_pose(second[0][i], second[1][i])
        )
        np.testing.assert_allclose(rotation[i], expected.rotation().matrix(), atol=1e-12)
        np.testing.assert_allclose(position[i], expected.translation(), atol=1e-11)


@BY_ANGLE
def test_right_jacobians_are_gtsams(angle):
    x = twists(angle)
    for i, found in enumerate(lie.slope(x)):
        expected = gtsam.Pose3.ExpmapDerivative(x[i][ABOUT_FIRST])
        np.testing.assert_allclose(found, reordered(expected), atol=1e-9)
    for i, found in enumerate(lie.rotation_slope(x[:, 3:])):
        np.testing.assert_allclose(found, gtsam.Rot3.ExpmapDerivative(x[i, 3:]), atol=1e-10)


@BY_ANGLE
def test_right_jacobians_are_slopes_of_the_exponential(angle):
    """Exp(x)^-1 Exp(x + d) = Exp(J d), whatever series or closed form J is made by."""
    for twist in twists(angle, 3):
        pose = lie.exponential(twist[None])

        def moved(x, pose=pose):
            return lie.logarithm(*lie.between(*pose, *lie.exponential(x[None])))[0]

        expected = differences(moved, twist, 1e-3)
        np.testing.assert_allclose(lie.slope(twist[None])[0], expected, atol=1e-9)
        np.testing.assert_allclose(
            lie.rotation_slope(twist[None, 3:])[0], expected[3:, 3:], atol=1e-9
        )


@BY_ANGLE
def test_inverse_jacobians_are_inverses(angle):
    x = twists(angle)
    eye = np.broadcast_to(np.eye(6), (len(x), 6, 6))
    np.testing.assert_allclose(lie.slope_inverse(x) @ lie.slope(x), eye, atol=2e-12)
    turned = lie.rotation_slope_inverse(x[:, 3:]) @ lie.rotation_slope(x[:, 3:])
    np.testing.assert_allclose(turned, eye[:, :3, :3], atol=2e-13)


@BY_ANGLE
def test_the_inverse_jacobians_derivative(angle):
    rng = np.random.default_rng(3)
    for twist in twists(angle, 4):
        vector = 2.0 * rng.normal(size=6)

        def applied(x, vector=vector):
            return lie.slope_inverse(x[None])[0] @ vector

        value, slope = lie.inverse_slope_of(twist[None], vector[None])
        np.testing.assert_allclose(value[0], applied(twist), atol=1e-12)
        expected = differences(applied, twist, 1e-3)
        np.testing.assert_allclose(slope[0], expected, atol=1e-8 * (1.0 + np.abs(expected).max()))


@given(seeds, st.floats(0.0, 6.0))
@hundred
def test_the_inverse_jacobians_derivative_at_any_angle(seed, angle):
    """Up to a tenth of a radian from a full turn, where the inverse has a pole."""
    twist, vector = twists(angle, 1, seed), twists(1.0, 1, seed ^ 1)
    _, slope = lie.inverse_slope_of(twist, vector)

    def applied(x):
        return lie.slope_inverse(x[None])[0] @ vector[0]

    expected = differences(applied, twist[0], 1e-4)
    np.testing.assert_allclose(slope[0], expected, atol=1e-7 * (1.0 + np.abs(expected).max()))


COEFFICIENTS = {
    "rotation": (lie._rotation_coefficients, lie._ROTATION_SERIES, lie._rotation_closed),
    "slope": (lie._slope_coefficients, lie._SLOPE_SERIES, lie._slope_closed),
    "inverse": (lie._inverse_coefficients, lie._INVERSE_SERIES, lie._inverse_closed),
    "half cotangent": (lie._half_cot, -lie._COT[:, None], lie._half_cot_closed),
}


@pytest.mark.parametrize(
    ("function", "series", "closed"), COEFFICIENTS.values(), ids=list(COEFFICIENTS)
)
def test_series_and_closed_form_meet(function, series, closed):
    """Each is right to rounding where it is used, the closed form to that of its cancellation."""
    u = lie.SERIES_LIMIT * np.linspace(0.5, 1.0, 7)
    by_series = (u[:, None] ** np.arange(len(series)) @ series).T
    np.testing.assert_allclose(by_series, np.array(closed(u)), rtol=1e-10)
    at_seam = lie.SERIES_LIMIT * np.array([1.0 - 1e-15, 1.0 + 1e-15])
    below, above = function(at_seam).T
    np.testing.assert_allclose(below, above, rtol=1e-11)
    assert np.isfinite(function(np.zeros(1))).all()


def test_many_are_as_one():
    x = np.concatenate([twists(a, 2, i) for i, a in enumerate(ANGLES)])
    vector = np.random.default_rng(5).normal(size=x.shape)
    functions = {
        "slope": lie.slope,
        "slope_inverse": lie.slope_inverse,
        "rotation": lambda x: lie.rotation(x[:, 3:]),
        "rotation_slope_inverse": lambda x: lie.rotation_slope_inverse(x[:, 3:]),
    }
    for name, function in functions.items():
        for i in range(len(x)):
            np.testing.assert_allclose(
                function(x)[i], function(x[i : i + 1])[0], atol=1e-14, err_msg=name
            )
    whole = lie.inverse_slope_of(x, vector)
    for i in range(len(x)):
        one = lie.inverse_slope_of(x[i : i + 1], vector[i : i + 1])
        np.testing.assert_allclose(whole[1][i], one[1][0], atol=1e-12)
