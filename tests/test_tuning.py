"""Noise chosen by the data: "auto" in the options."""

import json
from dataclasses import replace

import numpy as np
import pytest

from ubl_graph import (
    Beacon,
    ConfigurationError,
    FixedLagEstimator,
    Mission,
    Options,
    Segment,
    SoundSpeedProfile,
    evaluate,
    load_mission,
    smooth,
)
from ubl_graph.cli import main
from ubl_graph.io.result_files import summary
from ubl_graph.options import AUTOMATIC
from ubl_graph.sim import Sea, demo_survey, pressure, sampled, straight_pass, two_way_pings, wander
from ubl_graph.sim.xue2024 import xue_pass

EVERYTHING = {"motion": "auto", "acceleration_psd": "auto", "jerk_psd": "auto"}
#: Pings of Xue's missions that count: the ends know only one side.
INNER = slice(4, -4)

BEACONS = tuple(
    Beacon(f"B{i}", [700.0 * np.sin(a), 700.0 * np.cos(a), -300.0 - 20.0 * i])
    for i, a in enumerate(0.5 * np.pi * np.arange(4))
)


def wandering(
    seed, psd, *, vertical=1e-4, order=2, sigma=1e-4, stated=None, walk=None, duration=600.0
):
    """A mission drawn from the model itself, and its truth."""
    rng = np.random.default_rng(seed)
    span = (0.0, duration + 60.0)
    truth = sampled(rng, order, (psd, vertical), [0.0, 0.0, -180.0], [0.7, 0.4, 0.0], span)
    sea = Sea(SoundSpeedProfile.constant(1500.0))
    if walk is not None:
        sea = replace(sea, log_scale=wander(rng, 1e-3, walk, span))
    sent = np.arange(0.0, duration, 4.0)
    pings = two_way_pings(truth, BEACONS, sent, sea, rng, sigma=sigma)
    if stated is not None:
        pings = replace(pings, sigma=np.full(len(pings), stated))
    depth = pressure(truth, np.arange(0.0, duration, 2.0), rng)
    segment = Segment(two_way_range=pings, depth=depth, reference=truth.reference(sent))
    options = Options(estimate_sound_speed=walk is not None, loss="none")
    return Mission((segment,), BEACONS, sea.profile, options=options), truth


def smoothed(mission, **options):
    return smooth(replace(mission, options=replace(mission.options, **options)))


def rmse(result, inner=slice(None)):
    (errors,) = evaluate(result).values()
    return float(np.sqrt(np.mean(errors.horizontal[inner] ** 2)))


# -- what is found --


@pytest.mark.parametrize(
    ("order", "psd", "vertical"), [(2, 1e-2, 1e-4), (2, 1e-4, 1e-4), (3, 1e-5, 1e-9)]
)
def test_motion_noise_is_found(order, psd, vertical):
    motion = ("constant_velocity", "constant_acceleration")[order - 2]
    name = ("acceleration_psd", "jerk_psd")[order - 2]
    found = []
    for seed in range(6):
        mission, _ = wandering(seed, psd, vertical=vertical, order=order)
        result = smoothed(mission, motion=motion, **{name: "auto"})
        chosen = result.tuning.chosen
        found += [chosen[name], chosen[f"vertical_{name}"] * psd / vertical]
        assert getattr(result.mission.options, name) == chosen[name]
    # Twelve numbers of a few dozen degrees of freedom each: a mean within a fifth of a decade.
    assert abs(np.mean(np.log10(found)) - np.log10(psd)) < 0.2
    assert np.std(np.log10(found)) < 0.4


@pytest.mark.parametrize("loss", ["none", "cauchy", "huber"])
def test_range_noise_is_found_whatever_was_stated(loss):
    factors = []
    for seed in range(4):
        mission, _ = wandering(seed, 1e-3, sigma=3e-4, stated=5e-5)
        result = smoothed(mission, travel_time_sigma="auto", acceleration_psd=1e-3, loss=loss)
        factors.append(result.tuning.travel_time_factor)
        assert result.residuals.sigma == pytest.approx(5e-5 * factors[-1], rel=0.01)
    assert np.mean(factors) == pytest.approx(6.0, rel=0.12)


def test_outliers_do_not_raise_the_range_noise_much():
    mission, _ = wandering(1, 1e-3, sigma=1e-4)
    pings = mission.segments[0].two_way_range
    late = np.where(np.arange(len(pings)) % 12 == 5, 0.02, 0.0)
    pings = replace(pings, t_receive=pings.t_receive + late, travel_time=pings.travel_time + late)
    segments = (replace(mission.segments[0], two_way_range=pings),)
    result = smoothed(replace(mission, segments=segments), travel_time_sigma="auto", loss="cauchy")
    assert 0.7 < result.tuning.travel_time_factor < 1.6
    assert int(result.residuals.down_weighted.sum()) == pytest.approx(int((late > 0).sum()), abs=3)


def test_the_sound_speeds_walk_is_found():
    found = []
    for seed in range(4):
        mission, _ = wandering(seed, 1e-3, walk=5e-5, sigma=5e-5)
        result = smoothed(mission, sound_speed_walk="auto", acceleration_psd=1e-3)
        found.append(result.tuning.chosen["sound_speed_walk"])
    assert abs(np.mean(np.log10(found)) - np.log10(5e-5)) < 0.3


@pytest.mark.parametrize(("order", "psd"), [(2, 1e-2), (3, 1e-4)])
def test_the_motion_prior_is_told_apart(order, psd):
    for seed in range(3):
        mission, _ = wandering(seed, psd, vertical=1e-9, order=order)
        result = smoothed(mission, **EVERYTHING)
        likelihood = result.tuning.log_evidence
        assert result.tuning.chosen["motion"] == max(likelihood, key=likelihood.get)
        assert result.trajectory[""].order == order
        assert not [w for w in result.warnings if "auto" in w]


def test_no_noise_is_a_legal_answer():
    mission, _ = straight_pass(seed=1)
    result = smoothed(mission, acceleration_psd="auto")
    assert result.status == "converged"
    assert result.mission.options.acceleration_psd < 1e-6
    assert len(result.trajectory.t) < 20
    assert rmse(result) < 0.5 * rmse(smooth(mission))


# -- what it is worth --


@pytest.mark.slow
@pytest.mark.parametrize(
    ("track", "sigma"),
    [(track, s) for track in ("straight", "accelerating", "spiral") for s in (1e-4, 1.15e-3)],
)
def test_close_to_the_best_in_hindsight(track, sigma):
    mission, _ = xue_pass(track, seed=5, sigma=sigma)
    chosen = rmse(smoothed(mission, **EVERYTHING), INNER)
    tried = [
        rmse(smoothed(mission, motion=motion, **{name: q, f"vertical_{name}": q}), INNER)
        for motion, name, psds in (
            ("constant_velocity", "acceleration_psd", (1e-8, 1e-5, 1e-3, 1e-2)),
            ("constant_acceleration", "jerk_psd", (1e-10, 1e-8, 1e-5, 1e-4)),
        )
        for q in psds
    ]
    assert chosen < 1.6 * min(tried)


def test_covariances_are_true_under_its_own_noise():
    squares, nees = [], []
    for seed in range(12):
        mission, truth = wandering(seed, 2e-3)
        result = smoothed(mission, acceleration_psd="auto")
        t = np.arange(60.0, 560.0, 20.0)
        states = result.trajectory.at(t)
        error = states.position - truth.position(t)
        sigma = np.sqrt(np.einsum("mii->mi", states.covariance))
        squares.append(np.mean((error / sigma) ** 2))
        nees += list(np.einsum("mi,mij,mj->m", error, np.linalg.inv(states.covariance), error))
    assert 0.9 < np.sqrt(np.mean(squares)) < 1.1
    assert np.mean(nees) == pytest.approx(3.0, rel=0.2)


@pytest.mark.parametrize("track", ["straight", "accelerating"])
def test_the_chosen_numbers_work_online(track):
    mission, truth = xue_pass(track, seed=5)
    chosen = smoothed(mission, **EVERYTHING).mission
    assert chosen.options.horizontal_psd < 1e-9
    estimator = FixedLagEstimator.of(chosen)
    (segment,) = chosen.segments
    errors = []
    for i in range(101):
        ping = segment.two_way_range[i : i + 1]
        estimator.add(segment.depth[i : i + 1])
        estimator.add(ping)
        estimate = estimator.estimate(float(ping.t_receive[0]))
        if estimate.t > 200.0:
            assert estimate.status == "ok", (estimate.t, estimate.reasons)
            errors.append(np.hypot(*(estimate.position - truth.position(estimate.t)[0])[:2]))
    assert np.sqrt(np.mean(np.square(errors))) < 0.4


# -- what goes with it --


def test_the_same_answer_as_with_the_numbers_written_down():
    mission, _ = wandering(2, 1e-3)
    result = smoothed(mission, acceleration_psd="auto")
    again = smooth(replace(result.mission, options=result.mission.options))
    assert again.tuning is None
    assert not result.mission.options.automatic
    assert again.trajectory.position == pytest.approx(result.trajectory.position, abs=1e-9)


def test_segments_share_the_noise():
    parts = [replace(wandering(seed, 1e-3)[0].segments[0], name=f"line {seed}") for seed in (1, 2)]
    mission = replace(wandering(1, 1e-3)[0], segments=tuple(parts))
    result = smoothed(mission, acceleration_psd="auto")
    assert {s.trajectory.psd for s in result.segments} == {
        (
            result.tuning.chosen["acceleration_psd"],
            result.tuning.chosen["vertical_acceleration_psd"],
        )
    }


def test_a_vertical_noise_that_is_given_stays():
    mission, _ = wandering(1, 1e-3)
    result = smoothed(mission, acceleration_psd="auto", vertical_acceleration_psd=0.5)
    assert list(result.tuning.chosen) == ["acceleration_psd"]
    assert result.mission.options.vertical_psd == 0.5


def test_where_odometry_joins_all_nodes_the_motion_noise_stays():
    mission, _ = demo_survey(seed=1)
    result = smoothed(mission, acceleration_psd="auto", travel_time_sigma="auto")
    assert list(result.tuning.chosen) == ["travel_time_sigma"]
    assert result.mission.options.acceleration_psd == Options().acceleration_psd
    assert 0.6 < result.tuning.travel_time_factor < 1.6


def test_what_does_not_apply_keeps_its_default():
    mission, _ = straight_pass(seed=1)
    result = smoothed(mission, jerk_psd="auto")
    assert result.tuning.chosen == {}
    assert result.mission.options.jerk_psd == Options().jerk_psd


def test_a_motion_prior_is_not_judged_where_odometry_joins_nodes():
    mission, _ = demo_survey(seed=1)
    result = smoothed(mission, **EVERYTHING)
    assert result.tuning.chosen == {}
    assert result.mission.options == Options()
    (said,) = [w for w in result.warnings if "auto" in w]
    assert said.startswith("motion, acceleration_psd, jerk_psd")


def test_a_gap_in_the_odometry_is_bridged():
    mission, _ = demo_survey(seed=1)
    (segment,) = mission.segments
    heard = (segment.velocity.t < 300.0) | (segment.velocity.t > 500.0)
    deaf = replace(mission, segments=(replace(segment, velocity=segment.velocity[heard]),))
    result = smoothed(deaf, acceleration_psd="auto")
    assert result.status == "converged"
    assert np.diff(result.trajectory.t).max() <= 10.0 + 1e-9
    assert rmse(result) < 1.5 * rmse(smooth(deaf))


def test_what_was_stated_and_what_is_in_force():
    mission, _ = wandering(1, 1e-3, sigma=1e-4, stated=1e-3)
    result = smoothed(mission, travel_time_sigma="auto", acceleration_psd=1e-3)
    factor = result.tuning.travel_time_factor
    assert 0.05 < factor < 0.25
    assert result.tuning.chosen["travel_time_sigma"] == pytest.approx(1e-3 * factor)


def test_too_few_data_keep_the_defaults():
    mission, _ = straight_pass(seed=1)
    (segment,) = mission.segments
    few = replace(mission, segments=(replace(segment, two_way_range=segment.two_way_range[:8]),))
    result = smoothed(few, acceleration_psd="auto")
    assert result.tuning.chosen == {}
    assert "8 ranges and fixes are too few for 2 numbers" in result.tuning.trouble


def test_a_third_of_outliers():
    mission, _ = wandering(4, 1e-3, sigma=1e-4)
    (segment,) = mission.segments
    pings = segment.two_way_range
    rng = np.random.default_rng(4)
    late = (rng.random(len(pings)) < 0.3) * rng.uniform(2e-3, 2e-2, len(pings))
    pings = replace(pings, t_receive=pings.t_receive + late, travel_time=pings.travel_time + late)
    spoiled = replace(mission, segments=(replace(segment, two_way_range=pings),))
    result = smoothed(spoiled, acceleration_psd="auto", travel_time_sigma="auto", loss="cauchy")
    assert result.tuning.travel_time_factor < 3.0
    assert result.tuning.chosen["acceleration_psd"] < 0.05


def test_data_that_leave_the_track_open_keep_the_defaults():
    mission, _ = straight_pass(seed=1)
    pings = mission.segments[0].two_way_range
    lone = replace(mission.segments[0], two_way_range=pings[:2], depth=None)
    result = smoothed(replace(mission, segments=(lone,)), **EVERYTHING)
    assert result.status == "unobservable"
    assert not result.mission.options.automatic


def test_progress_never_goes_back_within_a_stage():
    mission, _ = straight_pass(seed=1)
    told = []
    smooth(
        replace(mission, options=replace(mission.options, **EVERYTHING)),
        lambda text, share: told.append((text == "noise", share)),
    )
    for stage in (True, False):
        shares = [share for noise, share in told if noise is stage]
        assert shares == sorted(shares) and len(shares) > 2


# -- options and files --


def test_options_say_what_is_automatic():
    options = Options(acceleration_psd="auto", sound_speed_walk="auto")
    assert options.automatic == ("acceleration_psd", "sound_speed_walk")
    assert options.settled == Options()
    assert Options().automatic == ()
    assert set(AUTOMATIC) == set(Options(**dict.fromkeys(AUTOMATIC, "auto")).automatic)


@pytest.mark.parametrize("name", ["acceleration_psd", "motion", "travel_time_sigma"])
def test_only_auto_stands_for_a_number(name):
    with pytest.raises(ConfigurationError, match=f"options.{name}"):
        Options(**{name: "automatic"})


def test_not_every_option_is_left_to_the_data():
    with pytest.raises(ConfigurationError, match=r"options\.speed_sigma"):
        Options(speed_sigma="auto")


def test_online_wants_numbers():
    with pytest.raises(ConfigurationError, match=r"options\.acceleration_psd.*whole missions"):
        FixedLagEstimator(Options(acceleration_psd="auto"), beacons=BEACONS)


@pytest.fixture
def folder(tmp_path):
    mission, _ = straight_pass(seed=1)
    pings = mission.segments[0].two_way_range
    rows = np.column_stack([pings.t_transmit, pings.t_receive, pings.travel_time])
    lines = [
        f"{b},{','.join(map(repr, r))}" for b, r in zip(pings.beacon, rows.tolist(), strict=True)
    ]
    text = "\n".join(["beacon,t_transmit,t_receive,travel_time", *lines])
    (tmp_path / "ranges.csv").write_text(text)
    depth = mission.segments[0].depth
    rows = [f"{t},{d},0.05" for t, d in zip(depth.t.tolist(), depth.depth.tolist(), strict=True)]
    (tmp_path / "depth.csv").write_text("\n".join(["t,depth,sigma", *rows]))
    beacons = [
        f'[[beacon]]\nname = "{b.name}"\nturnaround = 0.2\nposition = '
        f"{{ east = {b.position[0]}, north = {b.position[1]}, up = {b.position[2]} }}"
        for b in mission.beacons
    ]
    (tmp_path / "dive.toml").write_text(
        "\n".join(
            [
                *beacons,
                "[sound_speed]\nconstant = 1490.0",
                '[options]\nmotion = "auto"\nacceleration_psd = "auto"\ntravel_time_sigma = "auto"',
                '[data]\ntwo_way_range = "ranges.csv"\ndepth = "depth.csv"',
            ]
        )
    )
    return tmp_path


def test_a_mission_file_may_leave_it_to_the_data(folder):
    mission = load_mission(folder / "dive.toml")
    assert mission.options.automatic == ("motion", "acceleration_psd", "travel_time_sigma")
    content = summary(smooth(mission))["tuning"]
    assert set(content["chosen"]) >= {"motion", "acceleration_psd", "travel_time_sigma"}
    assert content["evaluations"] > 10
    json.dumps(content, allow_nan=False)


def test_the_command_says_what_was_chosen(folder, monkeypatch, capsys):
    monkeypatch.setattr(
        "sys.argv",
        [
            "ubl-graph",
            "smooth",
            str(folder / "dive.toml"),
            "-o",
            str(folder / "out"),
            "--no-figures",
        ],
    )
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 0
    assert (
        "chosen by the data: motion constant_velocity, acceleration_psd" in capsys.readouterr().out
    )
    assert json.loads((folder / "out" / "result.json").read_text())["tuning"]["trouble"] == ""


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (
            'acceleration_psd = "Auto"',
            "'options.acceleration_psd': 'Auto' is not a number or 'auto'",
        ),
        ("acceleration_psd = true", "'options.acceleration_psd': True is not a number or 'auto'"),
        ('motion = "constant"', "'options.motion': 'constant' is not allowed"),
        ('speed_sigma = "auto"', "'options.speed_sigma': 'auto' is not a number"),
    ],
)
def test_a_mission_files_errors_name_the_option(folder, line, says):
    path = folder / "dive.toml"
    text = path.read_text()
    begin, end = text.index("[options]"), text.index("[data]")
    path.write_text(text[:begin] + f"[options]\n{line}\n" + text[end:])
    with pytest.raises(ConfigurationError) as caught:
        load_mission(path)
    assert says in str(caught.value)


@pytest.mark.parametrize("command", ["smooth", "live"])
def test_bad_words_are_one_line(folder, monkeypatch, capsys, command):
    path = folder / "dive.toml"
    text = path.read_text()
    if command == "smooth":
        path.write_text(text.replace('acceleration_psd = "auto"', 'acceleration_psd = "best"'))
    else:
        path.write_text(text[: text.index("[data]")])
    out = ["-o", str(folder / "out")] if command == "smooth" else []
    monkeypatch.setattr("sys.argv", ["ubl-graph", command, str(path), *out])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "options." in line and "dive.toml" in line
    assert not (folder / "out").exists()
