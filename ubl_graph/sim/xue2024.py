"""The simulation of Xue et al. 2024, section 3.1, as missions with their truth.

Four beacons at the corners of a square on the sea floor, one vehicle at 1000 m that asks one of
them every 10 s in turn, sound refracted by a Munk profile. The paper leaves open how the square
lies, in which order beacons are asked, where tracks begin and how wide the spiral is. Here the
beacons stand north, west, south and east of the origin and are asked in that order, the
accelerating track is centred on the net, and the spiral's radius grows by 1.75 m/s: the choices
with which the paper's TRDOPs come out to three digits and its space intersections to 1 %.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.arrays import FloatArray
from ubl_graph.beacon import Beacon
from ubl_graph.errors import ConfigurationError
from ubl_graph.measurements import TRAVEL_TIME_SIGMA
from ubl_graph.mission import Mission, Segment
from ubl_graph.options import Options
from ubl_graph.sim import sensors
from ubl_graph.sim.tracks import Truth, constant_acceleration, constant_velocity, sampled

XueTrack = Literal["straight", "accelerating", "spiral"]

#: Depths of vehicle and beacons, and radius of the beacons' circle, m.
VEHICLE_DEPTH, BEACON_DEPTH, CIRCUMRADIUS = 1000.0, 2500.0, 750.0
#: Pings: one every 10 s for 1000 s, the first and the last second included.
PING_INTERVAL, DURATION = 10.0, 1000.0
#: The track goes on for so long after the last ping, s: a reply over 9 km takes 12.
LAST_REPLY = 30.0
#: The spiral turns once in 500 s; its radius grows by so much, m/s.
TURN, WIDENING = 2.0 * np.pi / 500.0, 1.75
#: What depth records state, m. They are exact: the paper takes the depth as known. A centimetre
#: changes a slant range by 5 to 9 mm, a tenth of what the least noise here does.
DEPTH_SIGMA = 0.01


def munk_profile(deepest: float = BEACON_DEPTH, step: float = 5.0) -> SoundSpeedProfile:
    """Munk's sound-speed profile with its axis at 1300 m, in layers of constant gradient.

    c(z) = 1500 (1 + 0.00737 (exp(-h) + h - 1)) m/s with h = 2 (z - 1300) / 1300.

    Parameters
    ----------
    deepest : float
        Depth of the last sample, m.
    step : float
        Thickness of a layer, m.

    Examples
    --------
    >>> profile = munk_profile()
    >>> profile.speed_at([0.0, 1300.0]).round(2).tolist()
    [1548.52, 1500.0]
    >>> round(float(profile.harmonic_mean(1000.0, 2500.0)), 3)
    1503.435
    """
    depth = np.linspace(0.0, deepest, max(round(deepest / step), 1) + 1)
    h = 2.0 * (depth - 1300.0) / 1300.0
    return SoundSpeedProfile(depth, 1500.0 * (1.0 + 0.00737 * (np.exp(-h) + h - 1.0)))


def xue_track(
    name: XueTrack = "straight", *, speed: float = 3.0, start_east: float | None = None
) -> Truth:
    """One of the paper's three tracks, at 1000 m depth.

    Parameters
    ----------
    name : {"straight", "accelerating", "spiral"}
        East at constant speed; east from 1 m/s at 0.004 m/s^2; counter-clockwise around the net,
        once in 500 s, 1.75 m wider each second.
    speed : float
        Of the straight track, m/s.
    start_east : float, optional
        Where the straight track begins, m; left out, it is centred on the net.

    Raises
    ------
    ConfigurationError
        Where there is no track of this name.

    Examples
    --------
    >>> xue_track("accelerating").position([0.0, 500.0, 1000.0])[:, 0].tolist()
    [-1500.0, -500.0, 1500.0]
    """
    span = (0.0, DURATION + LAST_REPLY)
    if name == "straight":
        begin = -0.5 * DURATION * speed if start_east is None else start_east
        return constant_velocity([begin, 0.0, -VEHICLE_DEPTH], [speed, 0.0, 0.0], span)
    if name == "accelerating":
        return constant_acceleration(
            [-1500.0, 0.0, -VEHICLE_DEPTH], [1.0, 0.0, 0.0], [0.004, 0.0, 0.0], span
        )
    if name == "spiral":
        return Truth(span, _spiral)
    raise ConfigurationError(
        f"there is no track '{name}'", "choose straight, accelerating or spiral", field="track"
    )


def xue_wandering(seed: int, acceleration_psd: float = 2e-4, vertical_psd: float = 1e-8) -> Truth:
    """A track drawn from the constant-velocity prior, for tests of consistency.

    It begins on the straight track, at 3 m/s.

    Parameters
    ----------
    seed : int
        Of the track.
    acceleration_psd, vertical_psd : float
        Noise densities of the acceleration, m^2/s^3.
    """
    return sampled(
        np.random.default_rng([seed, 1]),
        2,
        (acceleration_psd, vertical_psd),
        [-1500.0, 0.0, -VEHICLE_DEPTH],
        [3.0, 0.0, 0.0],
        (0.0, DURATION + LAST_REPLY),
        step=0.5,
    )


def xue_pass(
    track: XueTrack | Truth = "straight",
    seed: int = 1,
    *,
    sigma: float = TRAVEL_TIME_SIGMA,
    noise: float = 1.0,
    options: Options | None = None,
) -> tuple[Mission, Truth]:
    """Simulate the pings of one track: 101 two-way travel times along refracted rays.

    Parameters
    ----------
    track : str or Truth
        Name of one of `xue_track`, or any track from 0 to 1030 s.
    seed : int
        Of the noise.
    sigma : float
        Standard deviation of the two-way travel times, s. The paper states 1e-4; the errors that
        it prints are those of 1.15e-3.
    noise : float
        Multiplies it; 0 gives exact measurements with unchanged weights.
    options : Options, optional
        Of the mission.

    Returns
    -------
    Mission, Truth
        Depth is known: an exact record of it every 10 s, stated to 0.01 m, and one at the end. The
        mission carries the truth at the pings as reference, and no start.

    Examples
    --------
    >>> mission, truth = xue_pass("spiral", seed=3, sigma=1.15e-3)
    >>> mission.segments[0].two_way_range.beacon[:5].tolist()
    ['N', 'W', 'S', 'E', 'N']
    >>> len(mission.segments[0].two_way_range)
    101
    """
    truth = xue_track(track) if isinstance(track, str) else track
    rng = np.random.default_rng(seed)
    places = {"N": (0.0, 1.0), "W": (-1.0, 0.0), "S": (0.0, -1.0), "E": (1.0, 0.0)}
    beacons = tuple(
        Beacon(name, [CIRCUMRADIUS * east, CIRCUMRADIUS * north, -BEACON_DEPTH], turnaround=0.0)
        for name, (east, north) in places.items()
    )
    profile = munk_profile()
    sent = np.arange(0.0, DURATION + 0.5 * PING_INTERVAL, PING_INTERVAL)
    sea = sensors.Sea(profile, "eigenray")
    pings = sensors.two_way_pings(truth, beacons, sent, sea, rng, sigma=sigma, noise=noise)
    looked = np.append(sent, DURATION + LAST_REPLY)
    depth = sensors.pressure(truth, looked, rng, sigma=DEPTH_SIGMA, noise=0.0)
    name = track if isinstance(track, str) else "own track"
    segment = Segment(two_way_range=pings, depth=depth, reference=truth.reference(sent))
    options = Options() if options is None else options
    mission = Mission((segment,), beacons, profile, options=options, name=f"Xue 2024, {name}")
    return mission, truth


def _spiral(t: FloatArray) -> tuple[FloatArray, FloatArray]:
    radius, angle = WIDENING * t, TURN * t
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(t)], axis=1)
    along = np.stack([-np.sin(angle), np.cos(angle), np.zeros_like(t)], axis=1)
    position = radius[:, None] * outward - [0.0, 0.0, VEHICLE_DEPTH]
    return position, WIDENING * outward + (radius * TURN)[:, None] * along
