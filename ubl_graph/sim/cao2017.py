"""The scenarios of Cao 2017: straight eastward tracks past a single beacon.

The beacon lies 4000 m deep in the frame's zero, the vehicle runs 100 m below it. Sound travels at a
constant speed, ranges are one-way by synchronised clocks, the heading is known. What the DVL gets
wrong is what the paper is about.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.arrays import FloatArray
from ubl_graph.beacon import Beacon
from ubl_graph.errors import ConfigurationError
from ubl_graph.measurements import OneWayRange
from ubl_graph.mission import Mission, Segment, Start
from ubl_graph.options import Options
from ubl_graph.sim import sensors
from ubl_graph.sim.tracks import Truth, constant_velocity

SOUND_SPEED = 1500.0  #: m/s
BEACON_DEPTH, VEHICLE_DEPTH = 4000.0, 4100.0  #: m
HEADING_SIGMA = 1e-6  #: rad; the paper takes the heading as known
#: Standard deviation of a start that is known exactly, m: a prior cannot have none.
EXACT_START = 1e-3

#: What an estimator knows of the simulation (A1): the vehicle runs steadily, so that odometry
#: between sparse velocities adds 1 mm a ping; clocks agree; sound speed and heading are known; the
#: DVL is as its data sheet says, 0.3 % and 2 mm/s, which the options hold; no ping is an outlier.
PASS_OPTIONS = Options(
    acceleration_psd=1e-8,
    estimate_sound_speed=False,
    clock_offset_sigma=0.0,
    clock_drift_sigma=0.0,
    clock_walk=0.0,
    clock_drift_walk=0.0,
    dvl_misalignment_sigma_deg=0.0,
    loss="none",
)


@dataclass(frozen=True)
class SeaTrial:
    """What goes wrong at sea; all but the noise are drawn once a run.

    Attributes
    ----------
    calibration_sigma : float
        Of the beacon's position, each axis, m.
    sound_speed_sigma : float
        Relative.
    range_sigma : float
        m.
    forward_sigma, right_sigma : float
        Of the DVL's bias, m/s; up and down as to the right.
    white_noise : float
        Of the DVL, m per sqrt(s).
    start_sigma : float
        Of the start, each axis, m.
    """

    calibration_sigma: float = 3.0
    sound_speed_sigma: float = 5e-4
    range_sigma: float = 0.3
    forward_sigma: float = 5e-3
    right_sigma: float = 2e-3
    white_noise: float = 0.02
    start_sigma: float = 10.0


def cao_pass(
    seed: int = 1,
    *,
    north: float = 500.0,
    east: tuple[float, float] = (-3000.0, 3000.0),
    ping_interval: float = 10.0,
    speed: float = 1.0,
    dvl_error: tuple[float, float, float] = (0.005, 0.0, 0.0),
    range_sigma: float = 0.1,
    start_sigma: float | None = 1.0,
    noise: float = 1.0,
    options: Options = PASS_OPTIONS,
) -> tuple[Mission, Truth]:
    """Simulate the paper's passes: a steady eastward track, pings at a steady interval.

    Parameters
    ----------
    seed : int
        Of noise and start error.
    north : float
        Of the track from the beacon, m.
    east : tuple of float
        Where it begins and ends, m.
    ping_interval : float
        Between receptions, s; velocities and depths come at the same times.
    speed : float
        m/s.
    dvl_error : tuple of float
        Added to the measured velocity forward, to the right and up, m/s: constants, the only errors
        of the DVL.
    range_sigma : float
        Standard deviation of a range, m, as the records state it.
    start_sigma : float, optional
        Standard deviation of the start's east and north, m; 0 is an exact one. None leaves the
        start out.
    noise : float
        Multiplies noise of ranges and error of the start; 0 gives exact ones.
    options : Options
        Of the mission.

    Returns
    -------
    Mission, Truth
        The mission carries the truth as reference.

    Raises
    ------
    ConfigurationError
        Where the track leads west, or has no pings.

    Examples
    --------
    >>> mission, truth = cao_pass(north=300.0, east=(-1000.0, 1000.0))
    >>> len(mission.segments[0].one_way_range), truth.position(0.0).tolist()
    (201, [[-1000.0, 300.0, -4100.0]])
    """
    times = _times(east, speed, ping_interval)
    rng = np.random.default_rng(seed)
    truth = _track(north, east[0], speed, times, ping_interval)
    beacon = Beacon("B1", [0.0, 0.0, -BEACON_DEPTH])
    forward, right, up = dvl_error
    around = [times[0] - ping_interval], [times[-1] + ping_interval]
    sampled = np.concatenate([around[0], times, around[1]])
    ranges = _Ranging(sensors.Sea(SoundSpeedProfile.constant(SOUND_SPEED)), range_sigma, noise)
    segment = Segment(
        one_way_range=ranges.pings(truth, beacon, times, rng),
        velocity=sensors.dvl(
            truth,
            sampled,
            rng,
            errors=sensors.DvlErrors(bias=(-forward, right, -up)),
            sigma=1e-4,
            noise=0.0,
        ),
        attitude=sensors.ahrs(truth, 0.0, sigma=HEADING_SIGMA),
        depth=sensors.pressure(truth, sampled, rng, sigma=0.01, noise=0.0),
        start=None if start_sigma is None else _start(truth, start_sigma, noise, rng),
        reference=truth.reference(sampled),
    )
    profile = SoundSpeedProfile.constant(SOUND_SPEED)
    return Mission((segment,), (beacon,), profile, options=options, name="Cao 2017"), truth


def cao_sea_trial(
    seed: int = 1,
    *,
    north: float = 0.0,
    pings: int = 60,
    ping_interval: float = 30.0,
    trial: SeaTrial | None = None,
) -> tuple[Mission, Truth]:
    """Simulate what the paper's sea trial may have been like: its Figures 8 and 9.

    The track begins 900 m west of the beacon at 1 m/s. The beacon is not where the mission has it,
    sound is not as fast, the DVL has a bias and noise, the start is vague; the mission's options
    and sigmas say of all this what it was drawn from, and let the beacon be estimated within its
    calibration.

    Parameters
    ----------
    seed : int
        Of all errors and noise.
    north : float
        Of the track from the beacon, m: 0 leads through it, 800 past it.
    pings : int
        How many.
    ping_interval : float
        Between receptions, s. Velocities and depths come every second.
    trial : SeaTrial, optional
        The errors' standard deviations.

    Returns
    -------
    Mission, Truth
        The mission carries the truth as reference.

    Examples
    --------
    >>> mission, truth = cao_sea_trial(north=800.0)
    >>> len(mission.segments[0].one_way_range), mission.beacons[0].sigma.tolist()
    (60, [3.0, 3.0, 3.0])
    """
    trial = SeaTrial() if trial is None else trial
    speed, east = 1.0, -900.0
    times = _times((east, east + speed * ping_interval * (pings - 1)), speed, ping_interval)
    rng = np.random.default_rng(seed)
    truth = _track(north, east, speed, times, ping_interval)
    nominal = np.array([0.0, 0.0, -BEACON_DEPTH])
    missed = trial.calibration_sigma * rng.standard_normal(3)
    slowness = float(trial.sound_speed_sigma * rng.standard_normal())
    spread = np.array([trial.forward_sigma, trial.right_sigma, trial.right_sigma])
    forward, right, up = spread * rng.standard_normal(3)
    sampled = np.arange(times[0] - 1.0, times[-1] + 2.0)
    profile = SoundSpeedProfile.constant(SOUND_SPEED)
    ranges = _Ranging(sensors.Sea(profile, log_scale=slowness), trial.range_sigma)
    segment = Segment(
        one_way_range=ranges.pings(truth, Beacon("B1", nominal + missed), times, rng),
        velocity=sensors.dvl(
            truth,
            sampled,
            rng,
            errors=sensors.DvlErrors(bias=(-float(forward), float(right), -float(up))),
            sigma=trial.white_noise,
        ),
        attitude=sensors.ahrs(truth, 0.0, sigma=HEADING_SIGMA),
        depth=sensors.pressure(truth, sampled, rng),
        start=_start(truth, trial.start_sigma, 1.0, rng),
        reference=truth.reference(sampled),
    )
    # What the data sheet calls a scale is at constant speed a bias forward.
    scale = np.sqrt(max(trial.forward_sigma**2 - trial.right_sigma**2, 0.0)) / speed
    options = Options(
        acceleration_psd=1e-6,
        sound_speed_sigma=trial.sound_speed_sigma,
        sound_speed_walk=0.0,
        estimate_beacons=trial.calibration_sigma > 0.0,
        clock_offset_sigma=0.0,
        clock_drift_sigma=0.0,
        clock_walk=0.0,
        clock_drift_walk=0.0,
        dvl_scale_sigma=float(scale),
        dvl_bias_sigma=trial.right_sigma,
        dvl_misalignment_sigma_deg=0.0,
        loss="none",
    )
    beacon = Beacon("B1", nominal, sigma=trial.calibration_sigma)
    name = "Cao 2017, sea trial"
    return Mission((segment,), (beacon,), profile, options=options, name=name), truth


@dataclass(frozen=True)
class _Ranging:
    sea: sensors.Sea
    sigma: float
    noise: float = 1.0

    def pings(
        self, truth: Truth, beacon: Beacon, times: FloatArray, rng: np.random.Generator
    ) -> OneWayRange:
        """Broadcasts that arrive at `times` (M,), s, but for their noise."""
        there = np.broadcast_to(beacon.position, (len(times), 3))
        flight = self.sea.travel_time(truth.position(times), there, times)
        return sensors.one_way_pings(
            truth,
            (beacon,),
            times - flight,
            self.sea,
            rng,
            sigma=self.sigma / SOUND_SPEED,
            noise=self.noise,
        )


def _times(east: tuple[float, float], speed: float, interval: float) -> FloatArray:
    """When pings arrive, s: from zero on, until the track ends."""
    if not (speed > 0.0 and interval > 0.0 and east[1] > east[0]):
        raise ConfigurationError(
            f"a track from {east[0]} to {east[1]} m at {speed} m/s, a ping every {interval} s",
            "give an eastward track, a speed and an interval above 0",
        )
    return interval * np.arange(np.floor((east[1] - east[0]) / (speed * interval) + 1e-9) + 1.0)


def _track(north: float, east: float, speed: float, times: FloatArray, interval: float) -> Truth:
    """Eastward at `speed`; it begins before the first ping is sent, and ends after the last."""
    lead = max(2.0 * interval, 20.0)
    position = [east - speed * lead, north, -VEHICLE_DEPTH]
    return constant_velocity(position, [speed, 0.0, 0.0], (-lead, float(times[-1]) + lead))


def _start(truth: Truth, sigma: float, noise: float, rng: np.random.Generator) -> Start:
    east, north, _ = truth.position(0.0)[0]
    missed = noise * sigma * rng.standard_normal(2)
    return Start(
        0.0, float(east + missed[0]), float(north + missed[1]), sigma=max(sigma, EXACT_START)
    )
