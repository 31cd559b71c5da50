"""Fleets with bad input, and with vehicles and targets that the data leave open."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from fleets import (
    CHAIN,
    POINT,
    SPACE,
    Place,
    Sound,
    arc,
    at,
    changed,
    dvl_vehicle,
    farthest_off,
    fleet_of,
    reckoning,
    start_of,
    still,
    with_options,
    without,
)

from ubl_graph import Beacon, Depth, Options, Segment, SlantRange
from ubl_graph.cooperative import Fleet, FleetResult, Member, Target, smooth_fleet
from ubl_graph.errors import ConfigurationError, DataError, UblGraphError
from ubl_graph.sim import pressure

SPAN = (0.0, 400.0)
TRUTHS = {
    "a": arc([0.0, 0.0, -20.0], 0.4, SPAN, turn=0.004),
    "b": arc([400.0, -100.0, -20.0], -0.8, SPAN, turn=-0.005),
    "c": arc([-300.0, 300.0, -20.0], 2.0, SPAN, turn=0.006),
    "d": arc([200.0, 500.0, -20.0], 3.0, SPAN, turn=-0.003),
}
ROCK = still(250.0, 250.0, -60.0)
TIMES = np.arange(10.0, 390.0, 20.0)
KNOWN_DEPTH = Target("rock", [0.0, 0.0, -60.0], sigma=[1e5, 1e5, 0.0])


def sound(noise: float = 0.0, seed: int = 0, **places: Place) -> Sound:
    rng = np.random.default_rng(seed)
    return Sound({**{n: at(t) for n, t in TRUTHS.items()}, "rock": ROCK, **places}, rng, noise)


def masters(heard: Sound) -> list[Member]:
    """Vehicles "a" and "b", with a start and fixes."""
    return [
        reckoning(name, TRUTHS[name], heard, start=start_of(TRUTHS[name]), fix_every=30.0)
        for name in "ab"
    ]


def follower(heard: Sound, name: str = "c", **records: object) -> Member:
    """A vehicle with odometry and depth, and neither start nor fix."""
    depth = pressure(TRUTHS[name], TIMES, heard.rng, noise=heard.noise)
    return reckoning(name, TRUTHS[name], heard, depth=depth, **records)


def assert_same_tracks(one: FleetResult, other: FleetResult, *names: str) -> None:
    """Tracks, covariances and what is said of them are equal to the last bit."""
    for name in names:
        a, b = (r.vehicles[name] for r in (one, other))
        assert (a.status, a.reason) == (b.status, b.reason)
        for column in ("t", "position", "velocity", "covariance"):
            np.testing.assert_array_equal(
                getattr(a.trajectory, column), getattr(b.trajectory, column)
            )


# -------------------------------------------------------------------------------- bad input

HEARD = sound()
PAIR = fleet_of(masters(HEARD), targets=[Target("rock")], beacons=[Beacon("B1", [0, 0, -90.0])])


def ranging(*columns: object) -> Fleet:
    return changed(PAIR, "a", slant_range=SlantRange(*columns))


BAD: dict[str, tuple[Callable[[], object], type[UblGraphError], str]] = {
    "itself": (lambda: ranging(9.0, "a", 5.0), DataError, "'a' to itself"),
    "unknown end": (lambda: ranging(9.0, "rok", 5.0), DataError, "'rok'.*did you mean 'rock'"),
    "clocks of vehicles": (lambda: ranging(4e3, "b", 5.0), DataError, "'a' and 'b' seem to differ"),
    "clocks, before": (lambda: ranging(-4e3, "b", 5.0), DataError, "'a' and 'b' seem to differ"),
    "clocks, target": (
        lambda: ranging(1e6, "rock", 5.0),
        DataError,
        "'rock' seem to differ|'rock'.*differ",
    ),
    "twice": (lambda: ranging([9.0, 9.0], "b", 5.0), DataError, "duplicate"),
    "not finite": (lambda: ranging([9.0, np.nan], "b", 5.0), DataError, "nan"),
    "no vehicle": (lambda: fleet_of([]), ConfigurationError, "no vehicle"),
    "name twice": (
        lambda: fleet_of([PAIR.vehicles[0]] * 2),
        ConfigurationError,
        "'a' is there twice",
    ),
    "target as vehicle": (
        lambda: replace(PAIR, targets=(Target("b"),)),
        ConfigurationError,
        "'b' is there twice",
    ),
    "beacon as target": (
        lambda: replace(PAIR, targets=(Target("B1"),)),
        ConfigurationError,
        "'B1' is there twice",
    ),
    "no name": (
        lambda: fleet_of([replace(PAIR.vehicles[0], name="")]),
        ConfigurationError,
        "is no name",
    ),
    "left to the data": (
        lambda: with_options(PAIR, travel_time_sigma="auto"),
        ConfigurationError,
        "auto",
    ),
    "vehicle's left to the data": (
        lambda: fleet_of([replace(PAIR.vehicles[0], options=replace(CHAIN, jerk_psd="auto"))]),
        ConfigurationError,
        "auto",
    ),
    "points with odometry": (
        lambda: fleet_of([replace(PAIR.vehicles[0], options=POINT)]),
        ConfigurationError,
        "point",
    ),
    "target, nan": (lambda: Target("x", [np.nan, 0.0, 0.0]), DataError, "target 'x'"),
    "target, two numbers": (lambda: Target("x", [0.0, 0.0]), DataError, "target 'x'"),
    "target, words": (lambda: Target("x", "here"), DataError, "target 'x'"),
    "target, negative sigma": (lambda: Target("x", [0, 0, 0], sigma=-1.0), DataError, "sigma"),
    "target, sigma of nothing": (lambda: Target("x", sigma=3.0), DataError, "position"),
    "target, depth of nothing": (
        lambda: Target("x", sigma=[1e5, 1e5, 1.0]),
        DataError,
        "position",
    ),
    "target, too fast": (lambda: Target("x", velocity_sigma=1e3), DataError, "velocity_sigma"),
    "target, no time": (lambda: Target("x", [0, 0, 0], t=np.inf), DataError, "not finite"),
    "unknown vehicle": (lambda: PAIR.member("z"), ConfigurationError, "known: a, b"),
}


@pytest.mark.parametrize(("make", "error", "says"), BAD.values(), ids=list(BAD))
def test_bad_input_gets_one_line(make: Callable[[], object], error: type, says: str):
    with pytest.raises(error, match=says) as caught:
        make()
    assert "\n" not in str(caught.value)


# -------------------------------------------------------------------------- vehicles adrift


@pytest.mark.parametrize("kind", ["pose2", "pose3", "point"])
def test_a_vehicle_that_nothing_ties_is_named_and_harms_nobody(kind: str):
    heard = sound(noise=1.0)
    for t in TIMES:
        heard.slant(("a", "b"), float(t))
    makers = {
        "pose2": lambda: follower(heard),
        "pose3": lambda: follower(heard, options=SPACE),
        "point": lambda: dvl_vehicle("c", TRUTHS["c"], heard),
    }
    both = masters(heard)
    result = smooth_fleet(fleet_of([*both, makers[kind]()]))
    assert result.status == "unobservable"
    assert result.vehicles["c"].status == "unobservable"
    assert result.reason.startswith("c: nothing ties it to the map")
    assert_same_tracks(result, smooth_fleet(fleet_of(both)), "a", "b")


def test_two_adrift_that_range_each_other_harm_nobody():
    heard = sound(noise=1.0)
    for t in TIMES:
        heard.slant(("a", "b"), float(t))
    both = masters(heard)
    for t in TIMES[::3]:
        heard.slant(("c", "d"), float(t) + 3.0)
    lost = [follower(heard), follower(heard, "d")]
    result = smooth_fleet(fleet_of([*both, *lost], max_iterations=20))
    for name in "cd":
        assert result.vehicles[name].status == "unobservable"
        assert "nothing ties it" in result.vehicles[name].reason
    assert_same_tracks(result, smooth_fleet(fleet_of(both)), "a", "b")


@pytest.mark.parametrize("vehicle", ["pose2", "pose3", "point"])
@pytest.mark.parametrize("records", [{}, {"depth": Depth([0.0, 50.0], [20.0, 20.0])}])
def test_a_vehicle_that_recorded_next_to_nothing(vehicle: str, records: dict[str, Depth]):
    options = {"pose2": CHAIN, "pose3": SPACE, "point": POINT}[vehicle]
    both = masters(sound())
    result = smooth_fleet(fleet_of([*both, Member("c", Segment(**records), options=options)]))
    assert result.vehicles["c"].status == "unobservable"
    assert result.vehicles["c"].reason.startswith("c: nothing ties it to the map")
    assert_same_tracks(result, smooth_fleet(fleet_of(both)), "a", "b")


@pytest.mark.parametrize("vehicle", ["pose2", "pose3", "point"])
def test_a_start_alone_is_an_anchor(vehicle: str):
    heard = sound()
    start = start_of(TRUTHS["c"], heading_sigma=None if vehicle == "point" else 0.02)
    makers = {
        "pose2": lambda: follower(heard, start=start),
        "pose3": lambda: follower(heard, options=SPACE, start=start),
        "point": lambda: dvl_vehicle("c", TRUTHS["c"], heard, start=start),
    }
    result = smooth_fleet(fleet_of([makers[vehicle]()]))
    assert result.status == "converged", result.reason
    assert farthest_off(result, {"c": TRUTHS["c"]})["c"] < 1e-2


def test_one_range_leaves_a_vehicle_open_and_moves_the_other_by_nothing():
    """It says only how far apart they are: all of it goes into the one that is open."""
    heard = sound(noise=1.0)
    both = masters(heard)
    alone = smooth_fleet(fleet_of(both))
    heard.slant(("c", "a"), 200.0)
    # The solver would creep along the valley of one range for long.
    result = smooth_fleet(fleet_of([*both, follower(heard)], max_iterations=20))
    assert result.vehicles["c"].status == "unobservable"
    assert "c: the data do not determine the track" in result.vehicles["c"].reason
    for name in "ab":
        # They are where they will stay, whatever the third still does.
        assert result.vehicles[name].status == "converged"
        one, other = (r.vehicles[name].trajectory for r in (result, alone))
        at_times = np.intersect1d(one.t, other.t)
        gap = one.at(at_times).position - other.at(at_times).position
        sigma = np.sqrt(np.einsum("nii->ni", other.at(at_times).covariance))
        assert (np.abs(gap) < 1e-2 * sigma + 1e-9).all()


def test_two_mirror_images_are_said_to_be_two():
    """The way of one vehicle as the other sees it is a straight line: it fits on either side."""
    straight = {
        "a": arc([0.0, 0.0, -20.0], 0.4, SPAN),
        "c": arc([-300.0, 500.0, -30.0], 1.2, SPAN),
    }
    heard = sound(noise=1.0, **{name: at(truth) for name, truth in straight.items()})
    for t in TIMES:
        heard.slant(("c", "a"), float(t))
    fixed = reckoning("a", straight["a"], heard, start=start_of(straight["a"]), fix_every=30.0)
    result = smooth_fleet(fleet_of([fixed, dvl_vehicle("c", straight["c"], heard)]))
    assert result.vehicles["a"].status == "converged"
    segment = result.vehicles["c"].segments[0]
    assert segment.status == "unobservable"
    assert segment.reason.startswith("ambiguous: another track")
    assert segment.rival is not None
    truth = straight["c"].position(segment.trajectory.t)
    off = [
        np.linalg.norm(p - truth, axis=1).max()
        for p in (segment.trajectory.position, segment.rival)
    ]
    assert min(off) < 5.0 < 100.0 < max(off)


# ----------------------------------------------------------------------------------- targets


def test_a_target_that_nobody_ranged_is_what_was_said_of_it():
    said = Target("rock", [1.0, 2.0, -3.0], sigma=[4.0, 5.0, 6.0])
    both = masters(sound())
    result = smooth_fleet(fleet_of(both, targets=[said]))
    target = result.targets["rock"]
    assert (target.status, target.reason) == ("unobservable", "no vehicle ranged it")
    np.testing.assert_array_equal(target.position, said.position)
    np.testing.assert_array_equal(target.covariance, np.diag([16.0, 25.0, 36.0]))
    assert "target rock" in result.reason
    assert_same_tracks(result, smooth_fleet(fleet_of(both)), "a", "b")


def test_a_target_that_was_ranged_once_is_open_and_moves_nobody():
    heard = sound()
    heard.slant(("a", "rock"), 100.0, extra=5.0)
    result = smooth_fleet(fleet_of(masters(heard), targets=[KNOWN_DEPTH]))
    target = result.targets["rock"]
    assert target.status == "unobservable"
    assert "do not determine it" in target.reason
    assert max(farthest_off(result, {n: TRUTHS[n] for n in "ab"}).values()) < 1e-4


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_target_ranged_from_a_straight_line_has_a_mirror_image(noise: float):
    straight = arc([0.0, 0.0, -20.0], 0.4, SPAN)
    heard = sound(noise, a=at(straight))
    for t in TIMES:
        heard.slant(("a", "rock"), float(t))
    fixed = reckoning("a", straight, heard, start=start_of(straight), fix_every=30.0)
    result = smooth_fleet(fleet_of([fixed], targets=[KNOWN_DEPTH]))
    target = result.targets["rock"]
    assert result.vehicles["a"].status == "converged"
    assert target.status == "unobservable"
    assert target.reason.startswith("ambiguous: another place")
    assert target.rival is not None
    places = np.stack([target.position, target.rival])
    off = np.linalg.norm(places - ROCK(0.0), axis=1)
    assert off.min() < 3.0 < 100.0 < off.max()
    open_ = smooth_fleet(fleet_of([fixed], targets=[Target("rock")])).targets["rock"]
    assert open_.status == "unobservable"


def test_targets_whose_places_are_known_tie_a_vehicle_to_the_map():
    other = still(-150.0, 350.0, -60.0)
    heard = sound(noise=1.0, reef=other)
    for i, t in enumerate(TIMES):
        heard.slant(("c", ("rock", "reef")[i % 2]), float(t))
    targets = [Target("rock", ROCK(0.0), sigma=0.1), Target("reef", other(0.0), sigma=0.1)]
    result = smooth_fleet(fleet_of([follower(heard)], targets=targets))
    assert result.status == "converged", result.reason
    assert farthest_off(result, {"c": TRUTHS["c"]})["c"] < 10.0


# ----------------------------------------------------------------------------------- oddities


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_outliers_lose_their_say(seed: int):
    """One range in ten, between vehicles and to the target, is 200 m too long."""
    heard = sound(noise=1.0, seed=seed)
    wrong = []
    for i, t in enumerate(np.arange(10.0, 390.0, 8.0)):
        for j, pair in enumerate(
            (((("c", "a"), ("c", "b"), ("a", "b"))[i % 3]), ("abc"[i % 3], "rock"))
        ):
            wrong.append(heard.rng.random() < 0.1)
            heard.slant(pair, float(t) + j, extra=200.0 * wrong[-1])
    start = start_of(TRUTHS["c"], sigma=5.0)
    fleet = fleet_of(
        [*masters(heard), follower(heard, start=start)], targets=[KNOWN_DEPTH], loss="cauchy"
    )
    result = smooth_fleet(fleet)
    assert result.status == "converged", result.reason
    off = farthest_off(result, {n: TRUTHS[n] for n in "abc"})
    assert off["a"] < 1.0 and off["b"] < 1.5 and off["c"] < 8.0
    assert np.linalg.norm(result.targets["rock"].position - ROCK(0.0)) < 2.0
    assert result.residuals is not None
    far = np.abs(result.residuals.residual) * 1500.0 > 100.0
    assert far.sum() == np.sum(wrong)
    assert (result.residuals.weight[far] < 0.01).all()
    assert result.residuals.down_weighted[~far].mean() < 0.1


def test_ranges_before_the_first_odometry_and_after_the_last():
    heard = sound()
    for i, t in enumerate(TIMES):
        heard.slant(("c", "ab"[i % 2]), float(t))
    whole = follower(heard, start=start_of(TRUTHS["c"], 200.0))
    odometry = whole.segment.odometry
    assert odometry is not None
    part = odometry[(odometry.t_from >= 50.0) & (odometry.t_to <= 350.0)]
    member = replace(whole, segment=replace(whole.segment, odometry=part))
    result = smooth_fleet(fleet_of([*masters(heard), member]))
    assert result.status == "converged", result.reason
    track = result.vehicles["c"].trajectory
    assert track.t[0] <= TIMES[0] and track.t[-1] >= TIMES[-1]
    inside = (track.t >= 50.0) & (track.t <= 350.0)
    gap = track.position[inside] - TRUTHS["c"].position(track.t[inside])
    sigma = np.sqrt(np.einsum("nii->ni", track.covariance[inside]))
    assert (np.abs(gap) <= 0.5 * sigma + 1e-6).all()


def test_ranges_at_one_instant_between_the_same_and_other_pairs():
    heard = sound()
    pairs = [
        ("c", "a"),
        ("a", "c"),
        ("c", "b"),
        ("b", "c"),
        ("a", "b"),
        ("a", "rock"),
        ("c", "rock"),
    ]
    for t in TIMES:
        for pair in pairs:
            heard.slant(pair, float(t))
    start = start_of(TRUTHS["c"], sigma=30.0, off=(10.0, 5.0, 0.0, 0.1), heading_sigma=0.2)
    fleet = fleet_of([*masters(heard), follower(heard, start=start)], targets=[KNOWN_DEPTH])
    result = smooth_fleet(fleet)
    assert result.status == "converged", result.reason
    assert result.residuals is not None and len(result.residuals) == len(pairs) * len(TIMES)
    assert np.abs(result.residuals.residual).max() * 1500.0 < 0.3
    assert np.linalg.norm(result.targets["rock"].position - ROCK(0.0)) < 0.1


def test_a_vehicle_of_one_range_and_nothing_else():
    heard = sound()
    heard.slant(("c", "a"), 200.0)
    for options in (CHAIN, POINT):
        member = Member("c", Segment(**heard.of("c")), options=options)
        result = smooth_fleet(fleet_of([*masters(heard), member]))
        assert result.vehicles["c"].status == "unobservable"
        assert result.vehicles["a"].status == result.vehicles["b"].status == "converged"


def test_what_two_groups_find_of_unknown_beacons_is_all_kept():
    places = {"B1": [300.0, 100.0, -80.0], "B2": [-200.0, 250.0, -60.0]}
    beacons = [Beacon(n, np.add(p, [2.0, -3.0, 1.0]), sigma=5.0) for n, p in places.items()]
    heard = sound(**{name: still(*place) for name, place in places.items()})
    for t in TIMES:
        heard.slant(("a", "B1"), float(t))
        heard.slant(("b", "B2"), float(t))
    result = smooth_fleet(fleet_of(masters(heard), beacons=beacons, estimate_beacons=True))
    assert {r.segments[0].problem for r in result.vehicles.values()} == {0, 1}
    for name, place in places.items():
        gap = np.abs(result.beacons[name].value - place)
        assert (gap < 3.0 * result.beacons[name].sigma).all()
        assert gap[:2].max() < 1.0 and (result.beacons[name].sigma[:2] < 3.0).all()


def test_a_fleet_without_a_vehicle_is_that_fleet():
    """`without` is what the other tests compare with: it leaves no range behind."""
    heard = sound()
    for t in TIMES:
        heard.slant(("a", "c"), float(t))
        heard.slant(("c", "rock"), float(t))
    fleet = without(
        fleet_of([*masters(heard), follower(heard)], targets=[KNOWN_DEPTH]), "c", "rock"
    )
    assert fleet.names == ("a", "b")
    assert all(m.segment.slant_range is None for m in fleet.vehicles)


def test_options_of_the_whole_count_for_all():
    heard = sound(noise=1.0)
    fleet = fleet_of(masters(heard), loss="huber", max_iterations=7)
    assert {fleet.options_of(m).loss for m in fleet.vehicles} == {"huber"}
    assert {fleet.options_of(m).max_iterations for m in fleet.vehicles} == {7}
    assert {fleet.options_of(m).node for m in fleet.vehicles} == {"pose2"}
    assert isinstance(fleet.options, Options)
