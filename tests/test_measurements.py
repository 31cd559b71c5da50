from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ubl_graph.beacon import Beacon
from ubl_graph.errors import DataError
from ubl_graph.measurements import (
    MAX_TRAVEL_TIME,
    Attitude,
    Depth,
    OneWayRange,
    PositionFix,
    TwoWayRange,
    Velocity,
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
