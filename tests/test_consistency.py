"""The covariances are true: NEES of simulated missions drawn from the smoother's own model.

Each run draws truth from the motion prior, the sound speed's error and walk and the DVL's errors
from theirs, and noise as the records state it. The NEES of n independent runs with d degrees of
freedom is chi-square with n d degrees; its mean must lie within the two-sided 99.9 % bounds. A
run gives a node in its middle, one at its end, and a time halfway between two nodes, judged apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from ubl_graph import Beacon, Mission, Options, Segment, SoundSpeedProfile, Start, smooth
from ubl_graph.measurements import ATTITUDE_SIGMA
from ubl_graph.mission import CONSTANT_SIGMA
from ubl_graph.result import Result
from ubl_graph.sim import DvlErrors, Sea, Truth, ahrs, dvl, pressure, sampled, two_way_pings, wander

BEACONS = (
    Beacon("B1", [-220.0, 180.0, -118.0], turnaround=0.1),
    Beacon("B2", [230.0, 210.0, -125.0], turnaround=0.1),
    Beacon("B3", [210.0, -190.0, -120.0], turnaround=0.1),
    Beacon("B4", [-200.0, -230.0, -130.0], turnaround=0.1),
)
PROFILE = SoundSpeedProfile.constant(1495.0)
CONFIDENCE = 0.999
DURATION = 160.0


@dataclass(frozen=True)
class Nees:
    """NEES of one run by place: horizontal (2) and full (3) position, velocity (3)."""

    horizontal: tuple[float, ...]
    position: tuple[float, ...]
    velocity: tuple[float, ...]


PLACES = ("middle", "end", "between nodes")


def squared(error: np.ndarray, covariance: np.ndarray) -> float:
    return float(error @ np.linalg.solve(covariance, error))


def bounds(runs: int, dof: int) -> tuple[float, float]:
    """Where the mean NEES of `runs` runs should lie."""
    tails = np.array([(1.0 - CONFIDENCE) / 2.0, (1.0 + CONFIDENCE) / 2.0])
    low, high = chi2.ppf(tails, runs * dof) / runs
    return float(low), float(high)


def assert_consistent(values: list[float], dof: int, what: str) -> None:
    low, high = bounds(len(values), dof)
    mean = float(np.mean(values))
    assert low < mean < high, f"{what}: mean NEES {mean:.3f} outside {low:.3f} to {high:.3f}"


def nees(result: Result, truth: Truth) -> Nees:
    """Judge a run at `PLACES`."""
    track = result.segments[0].trajectory
    middle = len(track.t) // 2
    longest = middle + int(np.argmax(np.diff(track.t[middle : middle + 6])))
    between = 0.5 * (track.t[longest] + track.t[longest + 1])
    states = track.at([track.t[middle], track.t[-1], between])
    errors = states.position - truth.position(states.t)
    speeds = states.velocity - truth.velocity(states.t)
    pairs = list(zip(errors, states.covariance, strict=True))
    return Nees(
        tuple(squared(e[:2], c[:2, :2]) for e, c in pairs),
        tuple(squared(e, c) for e, c in pairs),
        tuple(squared(e, c) for e, c in zip(speeds, states.velocity_covariance, strict=True)),
    )


def free_swimmer(seed: int, options: Options) -> tuple[Mission, Truth]:
    """Two-way pings every 5 s and depth; truth drawn from the prior that the options name."""
    rng = np.random.default_rng([seed, options.motion == "constant_velocity"])
    order = 2 if options.motion == "constant_velocity" else 3
    span = (0.0, DURATION + 5.0)
    course = rng.uniform(0.0, 2.0 * np.pi)
    velocity = [1.2 * np.sin(course), 1.2 * np.cos(course), 0.0]
    place = [*rng.uniform(-80.0, 80.0, 2), -60.0]
    psd = (options.horizontal_psd, options.vertical_psd)
    truth = sampled(rng, order, psd, place, velocity, span)
    scale = wander(rng, CONSTANT_SIGMA, options.sound_speed_walk, span)
    sent = np.arange(0.0, DURATION, 5.0)
    pings = two_way_pings(truth, BEACONS, sent, Sea(PROFILE, log_scale=scale), rng)
    depth = pressure(truth, np.arange(0.0, DURATION + 1.0, 2.0), rng)
    segment = Segment(two_way_range=pings, depth=depth, reference=truth.reference(sent))
    return Mission((segment,), BEACONS, PROFILE, options=options), truth


WNOA = Options(loss="none", vertical_acceleration_psd=1e-4)
WNOJ = Options(motion="constant_acceleration", loss="none", vertical_jerk_psd=1e-7)


@cache
def free_runs(options: Options, runs: int) -> list[Nees]:
    out = []
    for seed in range(runs):
        mission, truth = free_swimmer(seed, options)
        result = smooth(mission)
        assert result.status == "converged", f"seed {seed}: {result.reason}"
        out.append(nees(result, truth))
    return out


def check(runs: list[Nees], what: str) -> None:
    for place, name in enumerate(PLACES):
        assert_consistent([r.horizontal[place] for r in runs], 2, f"{what}, {name}, horizontal")
        assert_consistent([r.position[place] for r in runs], 3, f"{what}, {name}, position")
        assert_consistent([r.velocity[place] for r in runs], 3, f"{what}, {name}, velocity")


def dvl_vehicle(seed: int, options: Options) -> tuple[Mission, Truth, DvlErrors]:
    """DVL at 4 Hz, two beacons, a start; everything that errs does so as the options expect.

    The velocity wanders by the prior that bridges the gaps between DVL samples, and the heading
    swings regardless of the course, so that all seven DVL states matter.
    """
    rng = np.random.default_rng([seed, 77])
    span = (0.0, DURATION + 5.0)
    place = [*rng.uniform(-60.0, 60.0, 2), -60.0]
    psd = (options.acceleration_psd, options.acceleration_psd)
    truth = sampled(rng, 2, psd, place, [*rng.normal(0.0, 1.0, 2), 0.0], span, step=0.05)
    turn, phase = rng.uniform(0.01, 0.03), rng.uniform(0.0, 2.0 * np.pi)
    truth = truth.with_attitude(lambda t: np.pi + 2.0 * np.sin(turn * t + phase))
    angles = np.deg2rad(options.dvl_misalignment_sigma_deg) * rng.standard_normal(3)
    errors = DvlErrors(
        options.dvl_scale_sigma * rng.standard_normal(),
        tuple(angles),
        tuple(options.dvl_bias_sigma * rng.standard_normal(3)),
    )
    # An attitude's lasting error of roll and pitch turns the odometry as a misalignment does.
    lasting = ATTITUDE_SIGMA * rng.standard_normal(3)
    scale = wander(rng, CONSTANT_SIGMA, options.sound_speed_walk, span)
    sent = np.arange(0.0, DURATION, 5.0)
    start = truth.position(0.0)[0] + 10.0 * rng.standard_normal(3)
    segment = Segment(
        two_way_range=two_way_pings(truth, BEACONS[:2], sent, Sea(PROFILE, log_scale=scale), rng),
        velocity=dvl(truth, np.arange(0.0, DURATION + 1.0, 0.25), rng, errors=errors),
        attitude=ahrs(truth, np.arange(0.0, DURATION + 1.0, 0.25), error=tuple(lasting)),
        depth=pressure(truth, np.arange(0.0, DURATION + 1.0, 2.0), rng),
        start=Start(0.0, start[0], start[1], sigma=10.0),
    )
    # Pitch and roll turn about right and forward; what undoes them is opposite.
    truths = {
        "dvl_scale": errors.scale,
        "dvl_misalignment": np.add(angles, [-lasting[2], lasting[1], 0.0]),
        "dvl_bias": errors.bias,
        "heading_bias": lasting[0],
    }
    return Mission((segment,), BEACONS[:2], PROFILE, options=options), truth, truths


@cache
def dvl_runs(runs: int) -> tuple[list[Nees], dict[str, list[float]]]:
    out: list[Nees] = []
    states: dict[str, list[float]] = {}
    for seed in range(runs):
        mission, truth, truths = dvl_vehicle(seed, Options(loss="none"))
        result = smooth(mission)
        assert result.status == "converged", f"seed {seed}: {result.reason}"
        out.append(nees(result, truth))
        for name, value in truths.items():
            found = result.shared[name]
            off = found.value - np.atleast_1d(value)
            states.setdefault(name, []).append(squared(off, found.covariance))
    return out, states


def test_constant_velocity():
    check(free_runs(WNOA, 100), "WNOA")


def test_constant_acceleration():
    check(free_runs(WNOJ, 60), "WNOJ")


@pytest.mark.slow
@pytest.mark.parametrize("options", [WNOA, WNOJ], ids=["WNOA", "WNOJ"])
def test_many_runs(options: Options):
    check(free_runs(options, 400), options.motion)


@pytest.mark.parametrize("options", [WNOA, WNOJ], ids=["WNOA", "WNOJ"])
def test_default_loss_is_a_little_cautious(options: Options):
    """Cauchy's weights count good pings for less than one: its NEES is lower, not by much."""
    runs = 40
    plain, robust = free_runs(options, runs), free_runs(replace(options, loss="cauchy"), runs)
    ratio = np.mean([r.position for r in robust]) / np.mean([r.position for r in plain])
    assert 0.8 < ratio < 1.1


def test_dvl():
    runs, states = dvl_runs(60)
    check(runs, "DVL")
    for (name, values), dof in zip(states.items(), (1, 3, 3, 1), strict=True):
        assert_consistent(values, dof, f"DVL {name}")


def test_wrong_model_is_found_out():
    """The test has teeth: with the sound speed's error left out of the model NEES explodes."""
    high = []
    for seed in range(30):
        mission, truth = free_swimmer(seed, WNOA)
        options = replace(WNOA, estimate_sound_speed=False)
        high.append(nees(smooth(replace(mission, options=options)), truth).horizontal[0])
    assert np.mean(high) > 2.0 * bounds(30, 2)[1]
