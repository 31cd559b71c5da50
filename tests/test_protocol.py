"""The line protocol without a process: every line is understood or refused, and answered."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.beacon import Beacon
from ubl_graph.errors import DataError, SolverError, TimeError
from ubl_graph.frames import GeodeticOrigin
from ubl_graph.io.mission_file import load_setup
from ubl_graph.measurements import (
    ANGULAR_RATE_SIGMA,
    ATTITUDE_SIGMA,
    DEPTH_SIGMA,
    HEADING_SIGMA,
    POSITION_SIGMA,
    SLANT_RANGE_SIGMA,
    VELOCITY_SIGMA,
    AngularRate,
    Heading,
    Odometry,
    PositionFix,
)
from ubl_graph.mission import Setup, Start
from ubl_graph.online.estimator import FixedLagEstimator
from ubl_graph.online.json_records import FORMS, record_content
from ubl_graph.online.protocol import MAX_LINE, Measurement, Query, Refused, parse
from ubl_graph.online.session import Session
from ubl_graph.options import Options

SETUP = Setup(
    beacons=(
        Beacon("B1", [0.0, 0.0, -100.0], turnaround=0.25),
        Beacon("B2", [100.0, 0.0, -100.0]),
    ),
    sound_speed=SoundSpeedProfile.constant(1500.0),
    options=Options(travel_time_sigma=3e-4),
    origin=GeodeticOrigin(34.96, 139.26, 10.0),
)

#: A sound line of each type; tests spoil one thing in it.
SOUND: dict[str, dict[str, Any]] = {
    "two_way_range": {
        "type": "two_way_range",
        "beacon": "B1",
        "t_transmit": 10.0,
        "t_receive": 11.0,
        "travel_time": 0.7,
        "sigma": 2e-4,
    },
    "one_way_range": {
        "type": "one_way_range",
        "beacon": "B2",
        "t_transmit": 10.0,
        "t_receive": 10.5,
        "sigma": 1e-4,
    },
    "slant_range": {
        "type": "slant_range",
        "t": 10.0,
        "beacon": "B2",
        "distance": 150.0,
        "sigma": 0.5,
    },
    "velocity": {
        "type": "velocity",
        "t": 10.0,
        "forward": 1.5,
        "right": 0.1,
        "down": -0.1,
        "sigma": 0.02,
        "reference": "water",
    },
    "attitude": {
        "type": "attitude",
        "t": 10.0,
        "heading": 90.0,
        "pitch": 2.0,
        "roll": -3.0,
        "sigma": 0.5,
    },
    "heading": {"type": "heading", "t": 10.0, "heading": 271.5, "sigma": 2.0},
    "angular_rate": {
        "type": "angular_rate",
        "t": 10.0,
        "about_forward": 0.5,
        "about_right": -0.25,
        "about_down": 3.0,
        "sigma": 0.1,
    },
    "odometry": {
        "type": "odometry",
        "t_from": 10.0,
        "t_to": 11.0,
        "forward": 1.5,
        "right": 0.25,
        "down": -0.5,
        "about_forward": 0.1,
        "about_right": -0.2,
        "about_down": 10.0,
        "sigma": 0.05,
        "sigma_turn": 0.3,
    },
    "depth": {"type": "depth", "t": 10.0, "depth": 50.0, "sigma": 0.2},
    "position": {"type": "position", "t": 10.0, "east": 1, "north": 2, "up": -3, "sigma": 4},
    "query": {"type": "query", "t": 12.0},
    "set_position": {
        "type": "set_position",
        "t": 10.0,
        "east": 1.0,
        "north": 2.0,
        "up": -3.0,
        "sigma": 4.0,
    },
}
MEASURED = [k for k in SOUND if k not in ("query", "set_position")]
GEODETIC = {"type": "position", "t": 1.0, "latitude": 34.97, "longitude": 139.26, "height": 5.0}


def line(content: Any) -> bytes:
    return json.dumps(content).encode()


def without(kind: str, *keys: str) -> dict[str, Any]:
    return {k: v for k, v in SOUND[kind].items() if k not in keys}


def strict(text: str) -> Any:
    """Parse as strict JSON: NaN and its kin are refused."""

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    return json.loads(text, parse_constant=refuse)


def refused(content: Any, setup: Setup = SETUP) -> str:
    message = parse(content if isinstance(content, bytes) else line(content), setup)
    assert isinstance(message, Refused), message
    strict(json.dumps({"reason": message.reason, "record": message.came}, allow_nan=False))
    assert "\n" not in message.reason
    return message.reason


# What a line means


@pytest.mark.parametrize("kind", MEASURED)
def test_a_measurement_comes_back_as_it_came(kind):
    message = parse(line(SOUND[kind]), SETUP)
    assert isinstance(message, Measurement)
    assert message.came == SOUND[kind]
    again = record_content(message.record)
    assert again.keys() == SOUND[kind].keys()
    for key, value in SOUND[kind].items():
        assert again[key] == (value if isinstance(value, str) else pytest.approx(value, rel=1e-14))


def test_what_may_be_left_out():
    def made(content):
        message = parse(line(content), SETUP)
        assert isinstance(message, Measurement), message
        return message.record

    ping = made(without("two_way_range", "travel_time", "sigma"))
    assert ping.travel_time[0] == 0.75  # one second less the turnaround
    assert ping.sigma[0] == 3e-4
    assert made(without("one_way_range", "sigma")).sigma[0] == 3e-4
    velocity = made(without("velocity", "reference", "sigma"))
    assert (velocity.reference[0], velocity.sigma[0]) == ("bottom", VELOCITY_SIGMA)
    attitude = made(without("attitude", "pitch", "roll", "sigma"))
    assert (attitude.pitch[0], attitude.roll[0], attitude.sigma[0]) == (0.0, 0.0, ATTITUDE_SIGMA)
    assert attitude.heading[0] == math.pi / 2
    assert made(without("slant_range", "sigma")).sigma[0] == SLANT_RANGE_SIGMA
    assert made(without("heading", "sigma")).sigma[0] == HEADING_SIGMA
    gyro = made(without("angular_rate", "about_forward", "about_right", "sigma"))
    assert gyro.rate[0].tolist() == [0.0, 0.0, -math.radians(3.0)]
    assert gyro.sigma[0] == ANGULAR_RATE_SIGMA
    step = made(without("odometry", "sigma", "sigma_turn", "down", "about_forward"))
    assert (step.dimension, step.covariance, step.down[0]) == (3, None, 0.0)
    step = made(without("odometry", "down", "about_forward", "about_right"))
    assert (step.dimension, step.down) == (2, None)
    np.testing.assert_allclose(
        step.covariance[0], np.diag([0.0025, 0.0025, math.radians(0.3) ** 2]), rtol=1e-14
    )
    assert made(without("depth", "sigma")).sigma[0] == DEPTH_SIGMA
    fix = made(without("position", "up", "sigma"))
    assert (fix.up, fix.sigma[0]) == (None, POSITION_SIGMA)
    assert parse(b'{"type": "query"}', SETUP) == Query(None, {"type": "query"})


def test_latitudes_become_local():
    message = parse(line(GEODETIC), SETUP)
    assert isinstance(message, Measurement)
    expected = SETUP.origin.to_enu(34.97, 139.26, 5.0)[0]
    np.testing.assert_allclose(message.record.position[0], expected)
    horizontal = {k: v for k, v in GEODETIC.items() if k != "height"}
    message = parse(line(horizontal), SETUP)
    assert message.record.up is None
    assert "origin" in refused(GEODETIC, replace(SETUP, origin=None))


def test_blank_lines_and_line_ends():
    for blank in (b"", b"\n", b"\r\n", b"  \t\r\n"):
        assert parse(blank, SETUP) is None
    for end in (b"\n", b"\r\n", b" \n"):
        assert isinstance(parse(line(SOUND["query"]) + end, SETUP), Query)
    assert isinstance(parse(b"\xef\xbb\xbf" + line(SOUND["query"]), SETUP), Query)


def test_a_record_with_a_covariance_is_shown_with_it():
    fix = PositionFix(1.0, 2.0, 3.0, covariance=[[4.0, 1.0], [1.0, 9.0]])
    assert record_content(fix) == {
        "type": "position",
        "t": 1.0,
        "east": 2.0,
        "north": 3.0,
        "covariance": [[4.0, 1.0], [1.0, 9.0]],
    }


@pytest.mark.parametrize("size", [3, 6])
def test_odometry_with_a_covariance_of_its_own_is_shown_with_it(size):
    covariance = np.eye(size)
    covariance[0, 1] = covariance[1, 0] = 0.5
    content = record_content(Odometry(1.0, 2.0, 3.0, 4.0, covariance=covariance))
    assert content == {
        "type": "odometry",
        "t_from": 1.0,
        "t_to": 2.0,
        "forward": 3.0,
        "right": 4.0,
        "about_down": 0.0,
        "covariance": covariance.tolist(),
    }


@pytest.mark.parametrize(
    "record",
    [Heading(1.0, 1.0), AngularRate(1.0, about_down=0.1), Odometry(0.0, 1.0, 1.0, 0.0)],
    ids=lambda r: type(r).__name__,
)
def test_points_refuse_what_only_poses_can_use(record):
    estimator = FixedLagEstimator.of(SETUP)
    with pytest.raises(DataError, match=r"node = 'point' cannot use .* set node = 'pose2'"):
        estimator.add(record)
    # Nothing of it is left behind.
    assert estimator.health()["sensors"] == {}
    assert estimator.health()["t"] is None


def test_a_start_with_a_heading_is_shown_in_degrees():
    content = record_content(Start(1.0, 2.0, 3.0, heading=math.pi / 2, heading_sigma=math.pi / 60))
    assert (content["heading"], content["heading_sigma"]) == (90.0, pytest.approx(3.0))


def test_a_position_set_by_hand_is_shown_as_it_came():
    assert record_content(Start(1.0, 2.0, 3.0, None, 5.0)) == {
        "type": "set_position",
        "t": 1.0,
        "east": 2.0,
        "north": 3.0,
        "sigma": 5.0,
    }


# What is refused

NUMBERS = [
    (kind, key) for kind, sound in SOUND.items() for key in sound if not isinstance(sound[key], str)
]
BROKEN = {
    "NaN": "NaN is not a finite number",
    "Infinity": "Infinity is not a finite number",
    "-Infinity": "-Infinity is not a finite number",
    "1e999": "Infinity is not a finite number",
    "1" + "0" * 400: "is not a finite number",
    "null": "null is not a number",
    '"10.0"': "'10.0' is not a number",
    "true": "true is not a number",
    "[1.0]": "a list is not a number",
    '{"value": 1.0}': "an object is not a number",
}


@pytest.mark.parametrize("value", BROKEN, ids=lambda v: v[:12])
@pytest.mark.parametrize(("kind", "key"), NUMBERS)
def test_a_broken_number_is_refused_by_its_name(kind, key, value):
    text = json.dumps({**SOUND[kind], key: "HERE"}).replace('"HERE"', value)
    message = parse(text.encode(), SETUP)
    assert isinstance(message, Refused)
    assert f"'{key}'" in message.reason
    assert BROKEN[value] in message.reason
    # What is no strict JSON is repeated as text.
    no_json = value in ("NaN", "Infinity", "-Infinity", "1e999")
    assert message.came == (text if no_json else json.loads(text))


@pytest.mark.parametrize(("kind", "key"), [(k, n) for k in SOUND for n in FORMS[k].required])
def test_a_missing_key_is_named(kind, key):
    reason = refused(without(kind, key))
    assert f"'{key}'" in reason
    assert "missing" in reason


@pytest.mark.parametrize("kind", [*SOUND, "health", "reset"])
def test_an_unknown_key_is_refused(kind):
    assert "unknown key 'comment'" in refused({"type": kind, **SOUND.get(kind, {}), "comment": 1})


ABSURD = {
    "a slip": ({**without("depth", "sigma"), "sgima": 0.1}, "did you mean 'sigma'"),
    "latitude misspelt": ({"type": "position", "t": 1, "lattitude": 1}, "did you mean 'latitude'"),
    "latitude and east": ({**GEODETIC, "east": 1.0}, "does not go with"),
    "unknown type": ({"type": "two_way_rnage"}, "did you mean 'two_way_range'"),
    "no type": ({"t": 1.0}, "field 'type': the key is missing"),
    "type of another kind": ({"type": ["query"]}, "a list is no type"),
    "unknown beacon": ({**SOUND["two_way_range"], "beacon": "b1"}, "did you mean 'B1'"),
    "beacon with a zero byte": ({**SOUND["one_way_range"], "beacon": "B1\0"}, "unknown beacon"),
    "beacon that is a number": ({**SOUND["one_way_range"], "beacon": 1}, "1 is no beacon's name"),
    "no turnaround": (
        {**without("two_way_range", "travel_time"), "beacon": "B2"},
        "states no turnaround",
    ),
    "early reply": (
        {**without("two_way_range", "travel_time"), "t_receive": 10.1},
        "before the reply was sent",
    ),
    "negative travel time": ({**SOUND["two_way_range"], "travel_time": -0.1}, "outside 0 to 60 s"),
    "absurd travel time": ({**SOUND["two_way_range"], "travel_time": 61}, "outside 0 to 60 s"),
    "swapped times": ({**SOUND["two_way_range"], "t_transmit": 12.0}, "before the transmit time"),
    "nanoseconds": ({**SOUND["depth"], "t": 1.7e18}, "no time in seconds"),
    "huge times": (
        {**without("two_way_range", "travel_time"), "t_transmit": -1e308, "t_receive": 1e308},
        "no time in seconds",
    ),
    "query in nanoseconds": ({"type": "query", "t": 1.7e18}, "no time in seconds"),
    "negative sigma": ({**SOUND["velocity"], "sigma": -0.1}, "'sigma': -0.1 m/s is outside"),
    "knots": ({**SOUND["velocity"], "forward": 70}, "'forward'"),
    "reference": ({**SOUND["velocity"], "reference": "seabed"}, "neither 'bottom' nor 'water'"),
    "no reference": ({**SOUND["velocity"], "reference": None}, "null is neither"),
    "reference with a zero byte": ({**SOUND["velocity"], "reference": "water\0"}, "neither"),
    "heading": ({**SOUND["attitude"], "heading": 721}, "721.0 degrees is outside -720 to 720"),
    "pitch": ({**SOUND["attitude"], "pitch": 181}, "outside -180 to 180 degrees"),
    "no distance": ({**SOUND["slant_range"], "distance": 0}, "0.0 m is no distance"),
    "slant range of a stranger": ({**SOUND["slant_range"], "beacon": "b2"}, "did you mean 'B2'"),
    "compass": ({**SOUND["heading"], "heading": -721}, "outside -720 to 720 degrees"),
    "gyro": (
        {**SOUND["angular_rate"], "about_right": 600},
        "600.0 degrees/s is outside -572.958 to 572.958 degrees/s",
    ),
    "odometry back in time": ({**SOUND["odometry"], "t_to": 10.0}, "not after t_from"),
    "odometry of two turns": ({**SOUND["odometry"], "about_down": 361}, "outside -360 to 360"),
    "half a noise": (without("odometry", "sigma"), "'sigma': the key is missing; sigma and"),
    "the other half": (without("odometry", "sigma_turn"), "'sigma_turn': the key is missing"),
    "no noise at all": ({**SOUND["odometry"], "sigma_turn": 0}, "'sigma_turn': 0.0 degrees is out"),
    "far away": ({**SOUND["position"], "east": 1e8}, "'east'"),
    "set far away": ({**SOUND["set_position"], "north": 1e300}, "'north'"),
    "set without doubt": ({**SOUND["set_position"], "sigma": 0}, "field 'sigma'"),
    "latitude": ({**GEODETIC, "latitude": 91}, "outside -90 to 90 degrees"),
    "height": ({**GEODETIC, "height": 1e308}, "'height'"),
    "no object": ([1, 2], "a list is no record"),
    "a word": ("query", "'query' is no record"),
    "null": (None, "null is no record"),
}


@pytest.mark.parametrize(("content", "said"), ABSURD.values(), ids=ABSURD)
def test_an_absurd_record_is_refused_with_its_reason(content, said):
    assert said in refused(content)


NO_JSON = {
    "half a line": (b'{"type": "que', "no JSON"),
    "two records": (b'{"type": "query"} {"type": "query"}', "no JSON"),
    "single quotes": (b"{'type': 'query'}", "no JSON"),
    "UTF-16": ('{"type": "query"}'.encode("utf-16"), "no UTF-8"),
    "bytes": (b"\xff\xfe\x00\x01", "no UTF-8"),
    "zero bytes": (b"\x00\x00\x00\x00", "no JSON"),
    "key twice": (b'{"type": "query", "t": 1, "t": 2}', "'t' is there twice"),
    "many digits": (b'{"type": "query", "t": ' + b"9" * 5000 + b"}", "too many digits"),
    "deep list": (b"[" * 100_000, "nested too deeply"),
    "deep object": (b'{"a":' * 100_000, "nested too deeply"),
}


@pytest.mark.parametrize(("content", "said"), NO_JSON.values(), ids=NO_JSON)
def test_what_is_no_json_is_refused_and_repeated(content, said):
    assert said in refused(content)
    message = parse(content, SETUP)
    assert isinstance(message, Refused)
    assert message.came == content.decode("utf-8", errors="replace")


def test_a_line_may_be_long_but_not_too_long():
    sound = line(SOUND["depth"])
    assert isinstance(parse(sound + b" " * (MAX_LINE - len(sound)), SETUP), Measurement)
    message = parse(sound + b" " * (MAX_LINE + 1 - len(sound)), SETUP)
    assert isinstance(message, Refused)
    assert "more than 1000000 bytes" in message.reason
    assert len(message.came) < 250


def test_long_words_are_cut_in_reasons():
    long = "B1" * 100_000
    assert len(refused({**SOUND["one_way_range"], "beacon": long})) < 200
    assert len(refused({"type": long})) < 300
    assert len(refused({**SOUND["depth"], long: 1.0})) < 200


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=5,
)
KEYS = st.sampled_from(sorted({key for form in FORMS.values() for key in form.keys}))
OBJECTS = st.builds(
    lambda kind, changes: {**SOUND.get(kind, {"type": kind}), **changes},
    st.sampled_from(sorted(FORMS)),
    st.dictionaries(KEYS, VALUES | st.sampled_from(["B1", "B2", "water"]), max_size=3),
)


def check_parsed(content: bytes) -> None:
    message = parse(content, SETUP)
    if isinstance(message, Refused):
        assert message.reason
        assert "\n" not in message.reason
    if message is not None:
        strict(json.dumps(message.came, allow_nan=False))


@given(st.binary(max_size=60))
@example(b"\xed\xa0\x80")
@example(b'"\\ud800"')
@example(b'{"type": "\\ud800"}')
def test_any_bytes_are_understood_or_refused(content):
    check_parsed(content)


@given(OBJECTS | VALUES)
def test_any_json_is_understood_or_refused(content):
    check_parsed(json.dumps(content).encode())


# The dialogue


@dataclass(frozen=True)
class Outcome:
    accepted: bool = True
    reason: str = ""
    final: bool = True
    others: tuple = ()


@dataclass(frozen=True)
class Event:
    kind: str
    reason: str
    record: Any
    final: bool = True


@dataclass(frozen=True)
class Estimate:
    t: float
    position: Any = None
    velocity: Any = None
    covariance: Any = None
    status: str = "initialising"
    reasons: tuple[str, ...] = ("no position yet",)
    rotation: Any = None
    hypotheses: tuple[Any, ...] = ()


@dataclass
class Fake:
    """An estimator that does what a test tells it to."""

    setup: Setup = SETUP
    outcomes: list[Any] = field(default_factory=list)
    estimates: list[Any] = field(default_factory=list)
    events: Any = ()
    kept: list[Any] = field(default_factory=list)
    calls: list[Any] = field(default_factory=list)
    saving: Any = None
    state: Any = field(default_factory=lambda: {"records": 3})

    def _next(self, answers, otherwise):
        answer = answers.pop(0) if answers else otherwise
        if isinstance(answer, Exception):
            raise answer
        return answer(self) if callable(answer) else answer

    def add(self, record):
        self.kept.append(record)
        return self._next(self.outcomes, Outcome())

    def set_position(self, **values):
        self.calls.append(values)
        return self._next(self.outcomes, Outcome())

    def estimate(self, t=None):
        self.calls.append(("estimate", t))
        return self._next(self.estimates, Estimate(7.0 if t is None else t))

    def flush(self):
        return self._next([self.events], ())

    def health(self):
        return self._next([self.state], {})

    def reset(self):
        self.calls.append("reset")

    def checkpoint(self, path):
        if self.saving:
            self.saving()
        self.calls.append("checkpoint")
        Path(path).write_text("state")


class Clock:
    """Wall time that passes only where a test lets it."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Dialogue:
    """A session whose answers are kept, checked for strictness."""

    def __init__(self, fake: Fake, **options: Any) -> None:
        self.lines: list[str] = []
        self.fake = fake
        self.warnings: list[str] = []
        options = {"clock": Clock(), "warn": self.warnings.append, **options}
        self.session = Session(fake, self.lines.append, **options)

    def __call__(self, content: Any) -> list[dict[str, Any]]:
        self.lines.clear()
        self.session.handle(content if isinstance(content, bytes) else line(content))
        return [strict(text) for text in self.lines]

    def finish(self) -> list[dict[str, Any]]:
        self.lines.clear()
        self.session.finish()
        return [strict(text) for text in self.lines]


def test_pings_positions_and_queries_are_answered_by_an_estimate():
    known = Estimate(
        7.0,
        np.array([1.0, 2.0, 3.0]),
        np.array([4.0, 5.0, 6.0]),
        np.arange(36.0).reshape(6, 6),
        "ok",
        (),
    )
    say = Dialogue(Fake(estimates=[known] * 5))
    for kind in ("two_way_range", "one_way_range", "position", "set_position"):
        assert say(SOUND[kind]) == [
            {
                "type": "estimate",
                "t": 7.0,
                "east": 1.0,
                "north": 2.0,
                "up": 3.0,
                "v_east": 4.0,
                "v_north": 5.0,
                "v_up": 6.0,
                "covariance": list(range(36)),
                "status": "ok",
                "reasons": [],
            }
        ]
    (answer,) = say(SOUND["query"])
    assert (answer["t"], answer["asked"]) == (7.0, 12.0)
    for kind in ("velocity", "attitude", "depth", "heading", "angular_rate", "odometry"):
        assert say(SOUND[kind]) == []
    assert say(SOUND["slant_range"])[0]["type"] == "estimate"


def test_an_estimate_without_a_position_holds_nulls():
    say = Dialogue(Fake())
    (answer,) = say(SOUND["query"])
    assert "asked" not in answer
    assert answer["status"] == "initialising"
    assert answer["reasons"] == ["no position yet"]
    for key in ("east", "north", "up", "v_east", "v_north", "v_up", "covariance"):
        assert answer[key] is None
    assert say({"type": "query"})[0]["t"] == 7.0
    assert say.fake.calls == [("estimate", 12.0), ("estimate", None)]


def test_lines_about_other_records_come_first_and_show_them_as_they_came():
    fake = Fake()
    say = Dialogue(fake)
    odd = {**SOUND["depth"], "depth": 51}
    say(odd)
    stranger = PositionFix(3.0, 1.0, 2.0)
    fake.outcomes.append(
        lambda f: Outcome(
            others=(
                Event("rejected", "gated: 9 sigma", f.kept[0], False),
                Event("readmitted", "fits again", stranger),
                Event("rejected", "too old", Start(1.0, 2.0, 3.0)),
            )
        )
    )
    answers = say(SOUND["two_way_range"])
    assert [a["type"] for a in answers] == ["rejected", "readmitted", "rejected", "estimate"]
    assert answers[0] == {
        "type": "rejected",
        "reason": "gated: 9 sigma",
        "record": odd,
        "final": False,
    }
    assert answers[1]["record"] == {
        "type": "position",
        "t": 3.0,
        "east": 1.0,
        "north": 2.0,
        "sigma": POSITION_SIGMA,
    }
    assert answers[2]["record"]["type"] == "set_position"


def test_a_record_that_turns_itself_has_one_line():
    gated = "gated: 9 sigma"
    turned = Start(**without("set_position", "type"))
    fake = Fake(
        outcomes=[
            lambda f: Outcome(False, gated, False, (Event("rejected", gated, f.kept[0], False),)),
            Outcome(False, gated, False, (Event("rejected", gated, turned, False),)),
        ]
    )
    say = Dialogue(fake)
    for kind in ("two_way_range", "set_position"):
        assert [a["type"] for a in say(SOUND[kind])] == ["rejected"]


def test_lines_are_remembered_no_longer_than_the_estimator_keeps_the_records():
    fake = Fake()
    say = Dialogue(fake)
    for _ in range(5):
        say(SOUND["depth"])
    assert len(say.session._came) == 5
    fake.kept.clear()
    assert len(say.session._came) <= 1


@pytest.mark.parametrize("kind", [*MEASURED, "set_position"])
def test_what_is_not_accepted_is_rejected_with_its_reason(kind):
    say = Dialogue(Fake(outcomes=[Outcome(False, "gated: 12.3 sigma", False)]))
    assert say(SOUND[kind]) == [
        {"type": "rejected", "reason": "gated: 12.3 sigma", "record": SOUND[kind], "final": False}
    ]


def test_errors_on_purpose_are_rejections_without_the_records_number():
    error = DataError("no such thing", "mend it", record="Velocity[0]", field="reference")
    say = Dialogue(Fake(outcomes=[error], estimates=[TimeError("an hour ahead")]))
    (answer,) = say(SOUND["velocity"])
    assert answer["reason"] == "field 'reference': no such thing; mend it"
    assert answer["final"] is True
    (answer,) = say(SOUND["query"])
    assert (answer["type"], answer["reason"]) == ("rejected", "an hour ahead")
    assert say.finish()[-1]["internal_errors"] == 0


def test_a_fault_of_the_library_is_said_and_counted_and_the_next_line_is_answered():
    fake = Fake(
        outcomes=[ZeroDivisionError("oh\nno"), Outcome(), Outcome()],
        estimates=[RuntimeError("singular"), Estimate(7.0, position=np.array([np.nan, 0.0, 0.0]))],
        events=MemoryError("flush"),
    )
    say = Dialogue(fake)
    (answer,) = say(SOUND["two_way_range"])
    assert answer["reason"] == "internal error: ZeroDivisionError: oh no"
    (answer,) = say(SOUND["two_way_range"])
    assert answer["reason"].startswith("the record is in, but there is no estimate: internal error")
    (answer,) = say(SOUND["one_way_range"])  # an estimate that is no JSON is a fault, too
    assert "internal error: ValueError" in answer["reason"]
    assert say(SOUND["two_way_range"])[0]["type"] == "estimate"
    health = say.finish()[-1]
    assert health["internal_errors"] == 4
    assert "flush" in health["last_internal_error"]


def test_a_solver_error_is_no_fault_of_the_library():
    say = Dialogue(Fake(estimates=[SolverError("no step lowers the cost")]))
    (answer,) = say(SOUND["query"])
    assert answer["reason"] == "no step lowers the cost"


def test_health_tells_what_the_estimator_and_the_session_count():
    say = Dialogue(Fake(), resumed=True)
    say(b"nonsense")
    say(b"\r\n")
    (health,) = say({"type": "health"})
    assert health == {
        "type": "health",
        "records": 3,
        "lines": 2,
        "refused_lines": 1,
        "internal_errors": 0,
        "last_internal_error": None,
        "checkpoints": 0,
        "checkpoint_error": None,
        "resumed": True,
    }


@pytest.mark.parametrize("state", [RuntimeError("oops"), {"nees": math.inf}, {"seen": {1, 2}}])
def test_health_is_told_even_where_the_estimator_fails_to(state):
    say = Dialogue(Fake(state=state))
    (health,) = say({"type": "health"})
    assert health["type"] == "health"
    assert (health["internal_errors"], health["lines"]) == (1, 1)


def test_set_position_and_reset_reach_the_estimator():
    say = Dialogue(Fake())
    say({"type": "set_position", "t": 1.0, "east": 2.0, "north": 3.0})
    assert say({"type": "reset"}) == []
    assert say.fake.calls == [
        {"t": 1.0, "east": 2.0, "north": 3.0},
        ("estimate", None),
        "reset",
    ]


def test_the_end_tells_what_was_still_open_then_health():
    fake = Fake()
    say = Dialogue(fake)
    say(SOUND["depth"])
    fake.events = (Event("rejected", "held back to the end", fake.kept[0]),)
    answers = say.finish()
    assert [a["type"] for a in answers] == ["rejected", "health"]
    assert answers[0]["record"] == SOUND["depth"]


def test_a_refused_line_never_reaches_the_estimator():
    say = Dialogue(Fake())
    for kind, key in NUMBERS:
        (answer,) = say({**SOUND[kind], key: None})
        assert answer["type"] == "rejected"
        assert answer["final"] is True
    assert say.fake.kept == []
    assert say.fake.calls == []


# Checkpoints


def ping(t: float) -> dict[str, Any]:
    return {**SOUND["two_way_range"], "t_transmit": t - 1.0, "t_receive": t}


def test_checkpoints_follow_data_time_and_leave_four_fifths_of_the_wall_time(tmp_path):
    clock = Clock()

    def slowly() -> None:
        clock.now += 0.5

    say = Dialogue(Fake(saving=slowly), checkpoint=tmp_path / "state", clock=clock)

    def written() -> int:
        return say.session.counts.checkpoints

    say(ping(10.0))
    assert written() == 1
    clock.now += 1.9
    say(ping(12.0))
    assert written() == 1  # it rests two seconds after one that took half a second
    clock.now += 0.2
    say({**SOUND["depth"], "t": 12.1})
    assert written() == 2  # what a ping has made due is written as soon as it may be
    clock.now += 60.0
    say(ping(12.9))
    say(ping(5.0))
    assert written() == 2  # less than a second of data
    say(ping(13.1))
    assert written() == 3
    say.finish()
    assert written() == 4


def test_a_vehicle_that_hears_no_beacon_is_remembered_too(tmp_path):
    say = Dialogue(Fake(), checkpoint=tmp_path / "state")
    for t in range(100, 125):
        say({**SOUND["depth"], "t": t})
    assert say.session.counts.checkpoints == 2


@pytest.mark.parametrize("kind", ["reset", "set_position"])
def test_what_is_done_by_hand_is_kept_without_waiting_for_data(kind, tmp_path):
    say = Dialogue(Fake(), checkpoint=tmp_path / "state")
    say(ping(10.0))
    say(SOUND.get(kind, {"type": kind}))
    assert say.session.counts.checkpoints == 2
    say(ping(3.0))  # time may begin anew
    assert say.session.counts.checkpoints == 3


def test_a_clock_that_is_set_back_does_not_end_the_checkpoints(tmp_path):
    say = Dialogue(Fake(), checkpoint=tmp_path / "state")
    for t in (1000.0, 5.0, 5.5, 7.0):
        say(ping(t))
    assert say.session.counts.checkpoints == 3


def test_without_a_file_there_are_no_checkpoints():
    say = Dialogue(Fake())
    say(ping(10.0))
    say.finish()
    assert "checkpoint" not in say.fake.calls


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), DataError("no room")])
def test_a_failed_checkpoint_is_reported_once_and_in_every_health_line(error, tmp_path):
    def fail() -> None:
        raise error

    fake = Fake(saving=fail)
    say = Dialogue(fake, checkpoint=tmp_path / "state")
    for t in (10.0, 20.0, 30.0):
        assert [a["type"] for a in say(ping(t))] == ["estimate"]
    assert len(say.warnings) == 1
    (health,) = say({"type": "health"})
    assert str(error.args[-1]) in health["checkpoint_error"]
    assert (health["checkpoints"], health["internal_errors"]) == (0, 0)
    fake.saving = None
    say(ping(40.0))
    (health,) = say({"type": "health"})
    assert (health["checkpoints"], health["checkpoint_error"]) == (1, None)


def test_a_client_that_no_longer_reads_does_not_cost_the_checkpoint(tmp_path):
    def gone(_: str) -> None:
        raise BrokenPipeError

    fake = Fake(events=(Event("rejected", "held back", PositionFix(1.0, 2.0, 3.0)),))
    session = Session(fake, gone, tmp_path / "state")
    with pytest.raises(BrokenPipeError):
        session.finish()
    assert fake.calls == ["checkpoint"]


# The documentation


def test_every_key_is_documented():
    text = (Path(__file__).parents[1] / "docs" / "live-protocol.md").read_text()
    for kind, form in FORMS.items():
        row = next(r for r in text.splitlines() if r.startswith(f"| `{kind}` |"))
        cells = row.split("|")[2:4]
        assert [c.replace("`", "").replace(",", "").split() for c in cells] == [
            list(form.required),
            list(form.optional),
        ]
    say = Dialogue(Fake())
    for content in (SOUND["query"], b"nonsense", {"type": "health"}):
        (answer,) = say(content)
        for key in answer.keys() - {"type", "records"}:
            assert f"`{key}`" in text
    assert f"at most {MAX_LINE:,} bytes".replace(",", " ") in text


# The configuration

CONFIG = {
    "mission": '[mission]\nname = "auv"\norigin = { latitude = 34.96, longitude = 139.26 }\n',
    "beacon": '[[beacon]]\nname = "B1"\nposition = { east = 0, north = 1, up = -100 }\n',
    "sound_speed": "[sound_speed]\nconstant = 1490\n",
    "vehicle": "[vehicle]\ntransducer = { down = 0.5 }\n",
    "start": "[start]\nt = 5\neast = 1\nnorth = 2\n",
    "options": "[options]\ntravel_time_sigma = 2e-4\n",
}


def config(folder: Path, **parts: str) -> Path:
    file = folder / "auv.toml"
    file.write_text("".join({**CONFIG, **parts}.values()))
    return file


def test_a_configuration_is_a_mission_file_without_data(tmp_path):
    setup = load_setup(config(tmp_path))
    assert setup.name == "auv"
    assert setup.beacon_names == ("B1",)
    assert setup.sound_speed.speed[0] == 1490.0
    assert setup.vehicle.transducer.down == 0.5
    assert setup.options.travel_time_sigma == 2e-4
    assert setup.start.t == 5.0
    assert setup.origin == GeodeticOrigin(34.96, 139.26)
    assert load_setup(config(tmp_path)).fingerprint() == setup.fingerprint()


def test_a_configuration_may_be_empty(tmp_path):
    setup = load_setup(config(tmp_path, **dict.fromkeys(CONFIG, "")))
    assert (setup.name, setup.beacons, setup.start, setup.origin) == ("auv", (), None, None)


@pytest.mark.parametrize(
    ("parts", "said"),
    [
        ({"options": '[data]\ntwo_way_range = "r.csv"\n'}, ["'data'", "has no data", "replay.py"]),
        ({"options": "[data]\n"}, ["has no data"]),
        ({"options": '[data]\nformat = "garpos"\n'}, ["has no data"]),
        ({"sound_speed": ""}, ["'sound_speed'", "there are beacons"]),
        ({"beacon": 2 * CONFIG["beacon"]}, ["beacon 'B1' is there twice"]),
        ({"options": "[options]\ntravel_sigma = 1.0\n"}, ["travel_sigma", "did you mean"]),
        ({"sound_speed": "[sound_speed]\nconstant = 1e3\n"}, ["sound_speed.constant"]),
        ({"start": "[start]\nt = 5\neast = nan\nnorth = 2\n"}, ["start.east"]),
        ({"mission": "[mission\n"}, ["line 1"]),
    ],
)
def test_a_bad_configuration_is_refused_in_one_line(parts, said, tmp_path):
    with pytest.raises(DataError) as caught:
        load_setup(config(tmp_path, **parts))
    for text in ("auv.toml", *said):
        assert text in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_configuration_is_refused(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        load_setup(tmp_path / "auv.toml")
