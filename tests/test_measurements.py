from __future__ import annotations

import pickle
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ubl_graph.beacon import Beacon
from ubl_graph.errors import DataError
from ubl_graph.measurements import (
    MAX_TRAVEL_TIME,
    AngularRate,
    Attitude,
    Depth,
    Heading,
    Odometry,
    OneWayRange,
    PositionFix,
    SlantRange,
    TwoWayRange,
    Velocity,
    odometry_covariance,
)
from ubl_graph.records import Source

SOURCE = Source("pings.csv", np.array([1, 2, 3]), np.array([2, 4, 5]))


def pings(**columns):
    t = np.array([0.0, 10.0, 20.0])
    base = {
        "beacon": ["B1", "B2", "B1"],
        "t_transmit": t,
        "t_receive": t + 1.5,
        "travel_time": [1.0, 1.1, 1.2],
    }
    return TwoWayRange(**{**base, **columns})


def failure(build, *args, **kwargs):
    with pytest.raises(DataError) as caught:
        build(*args, **kwargs)
    assert "\n" not in str(caught.value)
    return caught.value


def test_single_values_are_broadcast_to_all_records():
    records = pings(beacon="B1", sigma=2e-4)
    assert len(records) == 3
    assert records.beacon.tolist() == ["B1"] * 3
    assert records.sigma.tolist() == [2e-4] * 3


def test_records_hold_read_only_copies():
    t = np.array([0.0, 1.0])
    depth = Depth(t, [5.0, 6.0])
    t[0] = 99.0
    assert depth.t[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        depth.depth[0] = 1.0


def test_selection_keeps_sources():
    records = pings(source=SOURCE)
    assert records[1].beacon.tolist() == ["B2"]
    assert records[-1].source.row.tolist() == [3]
    assert records[records.beacon == "B1"].source.line.tolist() == [2, 5]
    assert records[1:].t_transmit.tolist() == [10.0, 20.0]


def test_an_empty_selection_is_a_record_object_of_length_zero():
    records = pings(source=SOURCE)
    none = records[records.beacon == "B9"]
    assert len(none) == 0
    assert none.duplicates("beacon", "t_transmit", "t_receive") is None
    fixes = PositionFix([0.0], 1.0, 2.0, covariance=np.eye(2))
    assert len(fixes[np.array([False])]) == 0


@pytest.mark.parametrize(
    ("column", "values", "words"),
    [
        ("travel_time", [1.0, np.nan, 1.0], "nan is not a finite number"),
        ("travel_time", [1.0, -0.25, 1.0], "-0.25 s is outside 0 to 60 s"),
        ("travel_time", [1.0, 61.0, 1.0], "61.0 s is outside 0 to 60 s"),
        ("travel_time", [1.0, 1.7, 1.0], "longer than the time between"),
        ("t_receive", [1.5, 9.0, 21.5], "9.0 s is before the transmit time"),
        ("t_transmit", [0.0, np.inf, 20.0], "inf is not a finite number"),
        ("t_transmit", [0.0, 1e18, 20.0], "s is no time in seconds"),
        ("sigma", [1e-4, 0.0, 1e-4], "0.0 s is outside"),
        ("sigma", [1e-4, 5.0, 1e-4], "5.0 s is outside"),
    ],
)
def test_wrong_pings_name_row_line_and_field(column, values, words):
    error = failure(pings, **{column: values}, source=SOURCE)
    assert (error.file, error.row, error.line, error.field) == ("pings.csv", 2, 4, column)
    assert words in str(error)


def test_records_made_in_python_are_named_by_kind_and_index():
    error = failure(pings, travel_time=[1.0, 1.0, np.nan])
    assert error.record == "TwoWayRange[2]"
    assert error.file is None and error.row is None


def test_columns_of_different_length_are_named():
    error = failure(pings, travel_time=[1.0, 1.0])
    assert "t_transmit: 3" in str(error) and "travel_time: 2" in str(error)


def test_text_and_tables_where_numbers_belong():
    assert failure(pings, t_receive=["1", "2", "3"]).field == "t_receive"
    assert failure(pings, travel_time=np.array(["a", "b", "c"], dtype=object)).field == (
        "travel_time"
    )
    assert failure(Depth, 0.0, np.ones((1, 2))).field == "depth"


def test_beacon_names_of_any_array_kind():
    names = np.array(["B1", "B2", "B3"], dtype=object)
    assert pings(beacon=names).beacon.tolist() == ["B1", "B2", "B3"]


def test_turnaround_is_taken_out():
    records = TwoWayRange.from_turnaround("B1", [0.0, 5.0], [2.0, 8.0], [0.5, 1.0])
    assert records.travel_time.tolist() == [1.5, 2.0]


def test_a_reply_before_the_turnaround_is_over():
    error = failure(
        TwoWayRange.from_turnaround, "B1", [0.0, 10.0, 20.0], [2.0, 10.2, 22.0], 0.5, source=SOURCE
    )
    assert (error.row, error.line, error.field) == (2, 4, "t_receive")
    assert "10.2 s is before the reply was sent (0.5 s turnaround" in str(error)


def test_slant_ranges_become_travel_times():
    records = TwoWayRange.from_slant_range("B1", 0.0, [2.0, 2.0], [1500.0, 750.0], 1500.0)
    assert records.travel_time.tolist() == [2.0, 1.0]


@pytest.mark.parametrize(
    ("slant", "speed", "field"),
    [([1.0, -5.0, 1.0], 1500.0, "slant_range"), ([1.0, np.nan, 1.0], 1500.0, "slant_range")]
    + [(9.0, [1500.0, bad, 1500.0], "sound_speed") for bad in (1.5, np.nan, 3000.0)],
)
def test_wrong_slant_ranges(slant, speed, field):
    t = np.array([0.0, 10.0, 20.0])
    error = failure(TwoWayRange.from_slant_range, "B", t, t + 1, slant, speed, source=SOURCE)
    assert (error.file, error.row, error.field) == ("pings.csv", 2, field)


def test_one_way_times_may_be_negative_but_not_absurd():
    assert OneWayRange("B", 10.0, 9.0).travel_time.tolist() == [-1.0]
    error = failure(OneWayRange, "B", [0.0, 0.0], [1.0, MAX_TRAVEL_TIME + 1.0])
    assert (error.record, error.field) == ("OneWayRange[1]", "t_receive")


def test_wrong_velocities():
    assert failure(Velocity, 0.0, 60.0, 0.0, 0.0).field == "forward"
    error = failure(Velocity, [0.0, 1.0], 1.0, 0.0, 0.0, reference=["bottom", "air"])
    assert (error.record, error.field) == ("Velocity[1]", "reference")


def test_wrong_attitudes_and_depths():
    assert failure(Attitude, 0.0, 200.0).field == "heading"
    assert failure(Attitude, 0.0, 1.0, 90.0).field == "pitch"
    assert failure(Depth, 0.0, 20_000.0).field == "depth"


def test_duplicates_name_the_first_repetition():
    assert pings().duplicates("beacon", "t_transmit") is None
    again = pings(
        beacon=["B1", "B1", "B1"], t_transmit=[20.0, 10.0, 20.0], t_receive=[21.5, 11.5, 21.5]
    )
    assert again.duplicates("beacon", "t_transmit", "t_receive") == 2


@given(st.lists(st.tuples(st.sampled_from("ab"), st.integers(0, 5)), min_size=1, max_size=12))
def test_duplicates_agree_with_counting(keys):
    records = OneWayRange([k for k, _ in keys], [float(t) for _, t in keys], 7.0)
    seen = [i for i, key in enumerate(keys) if key in keys[:i]]
    found = records.duplicates("beacon", "t_transmit")
    assert found == (seen[0] if seen else None)


def test_covariances_of_fixes():
    flat = PositionFix([0.0, 1.0], 1.0, 2.0, sigma=3.0)
    assert flat.dimension == 2
    assert np.array_equal(flat.covariances, np.stack([9.0 * np.eye(2)] * 2))
    full = PositionFix([0.0, 1.0], 1.0, 2.0, -3.0, covariance=np.diag([1.0, 2.0, 3.0]))
    assert full.position.tolist() == [[1.0, 2.0, -3.0]] * 2
    assert full.covariances.shape == (2, 3, 3)
    assert full[1].covariances.shape == (1, 3, 3)


def test_covariances_of_small_and_large_variances_are_none_the_worse():
    tiny = odometry_covariance(100.0, 1e-6, 3)
    steps = Odometry([0.0, 1.0], [1.0, 2.0], 1.0, 0.0, covariance=tiny[0])
    assert np.array_equal(steps.covariance, np.repeat(tiny, 2, axis=0))
    assert failure(PositionFix, 0.0, 1.0, 2.0, covariance=np.ones((2, 2))).field == "covariance"


@pytest.mark.parametrize(
    "covariance",
    [
        np.eye(3),
        [[1.0, 2.0], [2.0, 1.0]],
        [[1.0, 0.5], [0.0, 1.0]],
        [[1.0, np.nan], [np.nan, 1.0]],
        [1.0, 1.0],
        1.0,
    ],
)
def test_wrong_covariances(covariance):
    assert failure(PositionFix, 0.0, 1.0, 2.0, covariance=covariance).field == "covariance"


# Records of vehicles whose nodes are poses, and distances


def test_slant_ranges_of_devices_that_report_metres():
    records = SlantRange([0.0, 1.0], ["B1", "B2"], [5.0, 6.0])
    assert records.sigma.tolist() == [1.0, 1.0]
    assert records[1].beacon.tolist() == ["B2"]
    assert SlantRange([0.0, 0.0], ["B1", "B2"], 5.0).duplicates("beacon", "t") is None


@pytest.mark.parametrize(
    ("distance", "words"),
    [
        (-1.0, "-1.0 m is outside 0 to 100000 m; check the unit"),
        (0.0, "0.0 m is no distance to a beacon; drop ranges without a reply"),
        (1.5e5, "150000.0 m is outside"),
        (np.nan, "nan is not a finite number"),
    ],
)
def test_wrong_distances(distance, words):
    error = failure(SlantRange, [0.0, 1.0, 2.0], "B1", [5.0, distance, 5.0], source=SOURCE)
    assert (error.file, error.row, error.line, error.field) == ("pings.csv", 2, 4, "distance")
    assert words in str(error)


def test_wrong_headings_and_angular_rates():
    assert failure(Heading, 0.0, 90.0).field == "heading"
    assert failure(Heading, 0.0, 1.0, 0.0).field == "sigma"
    error = failure(AngularRate, 0.0, 0.0, 0.0, [0.1, 20.0])
    assert (error.record, error.field) == ("AngularRate[1]", "about_down")
    assert "20.0 rad/s is outside -10 to 10 rad/s; check the unit" in str(error)
    error = failure(AngularRate, 0.0)
    assert error.field == "about_down" and "give it in rad/s" in str(error)


def test_angular_rates_of_a_yaw_gyro_are_zero_about_the_other_axes():
    records = AngularRate([0.0, 1.0], about_down=[0.1, -0.2])
    assert records.rate.tolist() == [[0.0, 0.0, -0.1], [0.0, 0.0, 0.2]]


STEP = {"t_from": [0.0, 1.0], "t_to": [1.0, 2.0], "forward": 1.5, "right": 0.5}


def test_planar_odometry_is_what_names_no_third_dimension():
    planar = Odometry(**STEP, about_down=0.25)
    assert planar.dimension == 2
    assert planar.covariances_flu is None
    assert planar.translation.tolist() == [[1.5, -0.5, 0.0]] * 2
    assert planar.rotation_vector.tolist() == [[0.0, 0.0, -0.25]] * 2
    assert Odometry(**STEP, down=0.0).dimension == 3
    assert Odometry(**STEP, covariance=np.eye(6)).dimension == 3
    # Zeros that are stated do not make it one in space where the covariance is planar.
    assert Odometry(**STEP, down=0.0, about_right=0.0, covariance=np.eye(3)).dimension == 2


@pytest.mark.parametrize(
    ("changes", "field", "words"),
    [
        ({"t_to": [1.0, 1.0]}, "t_to", "1.0 s is not after t_from; check the unit"),
        ({"t_to": [1.0, np.inf]}, "t_to", "inf is not a finite number"),
        ({"t_from": [0.0, -1e12]}, "t_from", "is no time in seconds"),
        ({"forward": [1.0, 2e4]}, "forward", "20000.0 m is outside -10000 to 10000 m"),
        ({"about_down": [0.0, 90.0]}, "about_down", "90.0 rad is outside"),
        (
            {"down": [0.0, 1.0], "covariance": np.eye(3)},
            "down",
            "1.0: the covariance is that of a planar motion; give 6 x 6",
        ),
        (
            {"covariance": np.stack([np.eye(6), np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 0.0])])},
            "covariance",
            "not symmetric and positive definite; give variances in m^2 and rad^2",
        ),
        (
            {"covariance": np.stack([np.eye(3), [[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0, 0, 1]]])},
            "covariance",
            "not symmetric and positive definite",
        ),
    ],
)
def test_wrong_odometry_is_named(changes, field, words):
    error = failure(Odometry, **{**STEP, **changes}, source=SOURCE[:2])
    assert (error.file, error.row, error.line, error.field) == ("pings.csv", 2, 4, field)
    assert words in str(error)


@pytest.mark.parametrize("covariance", [np.eye(2), np.ones((2, 6)), np.ones((2, 3, 6)), [1.0], 1.0])
def test_covariances_of_the_wrong_size_are_refused(covariance):
    assert failure(Odometry, **STEP, covariance=covariance).field == "covariance"


def test_selection_takes_covariances_along():
    covariance = np.stack([np.eye(6), 2.0 * np.eye(6)])
    steps = Odometry(**STEP, down=1.0, covariance=covariance)
    assert np.array_equal(steps[1].covariance, covariance[1:])
    assert np.array_equal(steps[np.array([True, False])].covariance, covariance[:1])
    assert len(steps[:0]) == 0 and steps[:0].covariances_flu.shape == (0, 6, 6)
    # One matrix stands for all records.
    assert Odometry(**STEP, covariance=np.eye(3))[1:].covariance.shape == (1, 3, 3)


def test_duplicate_steps_have_both_times_in_common():
    steps = Odometry([0.0, 0.0, 1.0, 0.0], [1.0, 2.0, 2.0, 2.0], 1.0, 0.0)
    assert steps.duplicates("t_from", "t_to") == 3


#: One record set of each kind that a mission may hold.
ONE_OF_EACH = (
    pings(),
    OneWayRange(["B1", "B2"], [0.0, 1.0], 2.0),
    SlantRange([0.0, 1.0], ["B1", "B2"], 5.0),
    Velocity([0.0, 1.0], 1.0, 0.0, 0.0),
    Attitude([0.0, 1.0], 1.0),
    Heading([0.0, 1.0], 1.0),
    AngularRate([0.0, 1.0], about_down=0.1),
    Odometry(**STEP, covariance=np.eye(3)),
    Depth([0.0, 1.0], 5.0),
    PositionFix([0.0, 1.0], 1.0, 2.0, covariance=np.eye(2)),
)


@pytest.mark.parametrize("records", ONE_OF_EACH, ids=lambda r: type(r).__name__)
def test_records_survive_pickling_and_being_put_together_again(records):
    again = pickle.loads(pickle.dumps(records))
    given = {f.name: getattr(records, f.name) for f in fields(records)}
    unchecked = type(records).unchecked(**{k: v for k, v in given.items() if v is not None})
    for other in (again, unchecked, records[:]):
        assert len(other) == len(records)
        for name, column in given.items():
            found = getattr(other, name)
            assert found is column is None or np.array_equal(found, column)


def body_frames(heading: float, pitch: float, roll: float):
    """A rotation of the axes forward, right, down, and the same of forward, left, up."""
    right_down = Rotation.from_euler("ZYX", [heading, pitch, roll])
    turn = np.diag([1.0, -1.0, -1.0])
    return right_down, Rotation.from_matrix(turn @ right_down.as_matrix() @ turn)


ANGLE = st.floats(-1.5, 1.5)


@given(st.lists(st.floats(-100, 100), min_size=3, max_size=3), ANGLE, ANGLE, ANGLE)
def test_odometry_is_the_same_motion_in_either_axes(displacement, heading, pitch, roll):
    right_down, left_up = body_frames(heading, pitch, roll)
    vector = right_down.as_rotvec()
    step = Odometry(0.0, 1.0, *displacement, *vector)
    np.testing.assert_allclose(
        Rotation.from_rotvec(step.rotation_vector[0]).as_matrix(), left_up.as_matrix(), atol=1e-12
    )
    np.testing.assert_allclose(np.diag([1.0, -1.0, -1.0]) @ displacement, step.translation[0])
    rates = AngularRate(0.0, *vector)
    np.testing.assert_allclose(rates.rate, step.rotation_vector)


@given(st.integers(0, 2**32 - 1), st.sampled_from([2, 3]))
def test_covariances_turn_with_the_axes(seed, dimension):
    rng = np.random.default_rng(seed)
    size = 3 if dimension == 2 else 6
    root = rng.normal(size=(size, size)) + 2.0 * np.eye(size)
    step = Odometry(0.0, 1.0, 1.0, 2.0, covariance=root @ root.T)
    assert step.dimension == dimension
    # The variance of any sum of components is the same whichever way the axes point.
    weights = rng.normal(size=6)
    names = [0, 1, 5] if dimension == 2 else list(range(6))
    flu = weights * np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])
    w, v = weights[names], flu[names]
    np.testing.assert_allclose(v @ step.covariances_flu[0] @ v, w @ step.covariance[0] @ w)


def test_covariances_of_independent_components():
    planar = odometry_covariance(0.1, [0.01, 0.02], 2)
    assert planar.shape == (2, 3, 3)
    np.testing.assert_allclose(planar[1], np.diag([0.01, 0.01, 0.0004]))
    assert odometry_covariance(0.1, 0.01, 3).shape == (1, 6, 6)


def test_beacons():
    beacon = Beacon("B1", [1, 2, -3], 0.5, 0.25)
    assert beacon.position.tolist() == [1.0, 2.0, -3.0]
    assert beacon.sigma.tolist() == [0.5] * 3
    assert replace(beacon, sigma=[1, 2, 3]).sigma.tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        (([1.0, 2.0],), "position"),
        (([1.0, 2.0, np.nan],), "position"),
        (("here",), "position"),
        ((np.ones((30, 3)),), "position"),
        (([1.0, 2.0, 3.0], -1.0), "sigma"),
        (([1.0, 2.0, 3.0], [1.0, 2.0]), "sigma"),
        (([1.0, 2.0, 3.0], np.inf), "sigma"),
        (([1.0, 2.0, 3.0], 0.0, -0.5), "turnaround"),
        (([1.0, 2.0, 3.0], 0.0, "long"), "turnaround"),
        (([1.0, 2.0, 3.0], 0.0, np.nan), "turnaround"),
    ],
)
def test_wrong_beacons(arguments, field):
    error = failure(Beacon, "B1", *arguments)
    assert (error.record, error.field) == ("beacon 'B1'", field)
