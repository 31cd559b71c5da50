from __future__ import annotations

import numpy as np
import pymap3d
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ubl_graph.errors import ConfigurationError
from ubl_graph.frames import GeodeticOrigin, LeverArm, body_vector, ned_to_enu, world_R_body

ANGLE = st.floats(-np.pi, np.pi)
FORWARD, PORT, MAST = np.eye(3)


@pytest.mark.parametrize(
    ("angles_deg", "body", "world"),
    [
        ((0, 0, 0), FORWARD, [0, 1, 0]),
        ((0, 0, 0), PORT, [-1, 0, 0]),
        ((90, 0, 0), FORWARD, [1, 0, 0]),
        ((180, 0, 0), FORWARD, [0, -1, 0]),
        ((270, 0, 0), PORT, [0, -1, 0]),
        # Bow up by 30 degrees on a northerly course.
        ((0, 30, 0), FORWARD, [0, np.sqrt(3) / 2, 0.5]),
        # Starboard down: the port side rises, the mast leans to starboard (east).
        ((0, 0, 30), PORT, [-np.sqrt(3) / 2, 0, 0.5]),
        ((0, 0, 30), MAST, [0.5, 0, np.sqrt(3) / 2]),
        ((90, 0, 30), MAST, [0, -0.5, np.sqrt(3) / 2]),
    ],
)
def test_rotations_worked_by_hand(angles_deg, body, world):
    rotation = world_R_body(*np.deg2rad(angles_deg))[0]
    np.testing.assert_allclose(rotation @ body, world, atol=1e-15)


@given(ANGLE, ANGLE, ANGLE)
def test_rotation_is_the_one_scipy_composes(heading, pitch, roll):
    ned_R_frd = Rotation.from_euler("ZYX", [heading, pitch, roll])
    swap = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    turn_over = Rotation.from_euler("x", np.pi)
    oracle = (swap * ned_R_frd * turn_over).as_matrix()
    np.testing.assert_allclose(world_R_body(heading, pitch, roll)[0], oracle, atol=1e-12)


def test_many_rotations_at_once():
    rotations = world_R_body(np.linspace(0, 1, 5), 0.1, 0.2)
    assert rotations.shape == (5, 3, 3)
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), [np.eye(3)] * 5, atol=1e-15
    )


def test_a_lever_arm_by_hand():
    # 2 m forward, 1 m to starboard, 3 m down, heading east: east 2, south 1, down 3.
    world = world_R_body(np.pi / 2, 0.0, 0.0)[0] @ body_vector(2.0, 1.0, 3.0)[0]
    np.testing.assert_allclose(world, [2.0, -1.0, -3.0], atol=1e-15)
    assert np.array_equal(LeverArm(2.0, 1.0, 3.0).body, [2.0, -1.0, -3.0])
    assert LeverArm().is_zero and not LeverArm(down=0.1).is_zero


def test_ned_and_enu_swap():
    vectors = np.arange(6.0).reshape(2, 3)
    assert ned_to_enu(vectors).tolist() == [[1.0, 0.0, -2.0], [4.0, 3.0, -5.0]]
    assert np.array_equal(ned_to_enu(ned_to_enu(vectors)), vectors)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1001.0])
def test_absurd_lever_arms(value):
    with pytest.raises(ConfigurationError) as caught:
        LeverArm(right=value)
    assert caught.value.field == "right"


@pytest.mark.parametrize(
    ("field", "value"), [("latitude", 91.0), ("longitude", 361.0), ("height", np.nan)]
)
def test_absurd_origins(field, value):
    with pytest.raises(ConfigurationError) as caught:
        GeodeticOrigin(**{"latitude": 0.0, "longitude": 0.0, field: value})
    assert caught.value.field == field


@given(
    st.floats(-89.0, 89.0),
    st.floats(-180.0, 180.0),
    st.tuples(st.floats(-5e4, 5e4), st.floats(-5e4, 5e4), st.floats(-6e3, 100.0)),
)
def test_geodetic_round_trip(latitude, longitude, enu):
    origin = GeodeticOrigin(latitude, longitude, 43.0)
    there = origin.to_geodetic(enu)
    assert there.shape == (1, 3)
    np.testing.assert_allclose(origin.to_enu(*there.T)[0], enu, atol=1e-6)


def test_geodetic_conversion_is_pymap3ds():
    origin = GeodeticOrigin(34.96, 139.26, 43.0)
    enu = origin.to_enu([34.97, 34.95], [139.26, 139.27], 0.0)
    oracle = pymap3d.geodetic2enu(34.95, 139.27, 0.0, 34.96, 139.26, 43.0)
    np.testing.assert_allclose(enu[1], oracle, atol=1e-9)
    # One hundredth of a degree of latitude is 1109.4 m there.
    np.testing.assert_allclose(enu[0], [0.0, 1109.4, -43.1], atol=0.1)
