"""Zhao's simulation: a master AUV with exact navigation, three followers, a target to locate.

Four AUVs run for an hour at a depth of 20 m; followers measure speed and yaw rate each second, and
AUVs range each other once a period. The paper leaves open the step, the period, the noise of the
ranges and when the target is ranged. Here these are 1 s, 60 s, 30 m and 3000 s, with which its
numbers come out, but for what few runs leave to chance; a period of 120 s with 15 m fits as well.
Its timing error of 20 ms is taken as that of a two-way travel time, 15 m.

Positions are east and north, m; yaw is counter-clockwise from east, rad, the paper's heading.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ubl_graph.arrays import ArrayLike, FloatArray, IntArray
from ubl_graph.baselines.formation import (
    FormationData,
    FormationEstimate,
    check_number,
    checked,
    whole_steps,
)
from ubl_graph.baselines.multilateration import target_rmse
from ubl_graph.errors import ConfigurationError, DataError, TimeError

VEHICLE_DEPTH, TARGET_DEPTH = 20.0, 30.0  #: m
#: East, north (m) and yaw (degrees) at the start, speed (m/s) and yaw rate (rad/s) of each AUV.
TRACKS = (
    (-1270.0, 1270.0, 45.0, 2.0, 0.0),
    (1000.0, -1000.0, 60.0, 1.5, -2e-4),
    (0.0, -2000.0, 60.0, 1.5, 2e-4),
    (0.0, 4000.0, -60.0, 1.5, 1e-4),
)
#: When the target is ranged, s.
TARGET_TIME = 3000.0


@dataclass(frozen=True)
class ZhaoSettings:
    """What may differ between simulations.

    Attributes
    ----------
    dt : float
        Length of a step, s.
    duration : float
        s; a whole number of steps.
    period : float
        Between ranging times, s; a whole number of steps.
    range_sigma : float
        Of a range between AUVs, m.
    speed_sigma : float
        Of a measured speed, m/s.
    yaw_rate_sigma_deg : float
        Of a measured yaw rate, degrees per second.
    toa_sigma : float
        Of a slant range to the target, m.
    masters : tuple of int
        AUVs that are exact: the paper's (0,), or (0, 1).
    noise : float
        Multiplies all noise; 0 gives exact measurements with unchanged weights.

    Raises
    ------
    ConfigurationError
        Where a number is not more than zero (`noise`: less than zero), a time is no whole number of
        steps, or the masters are none of the AUVs or all.
    """

    dt: float = 1.0
    duration: float = 3600.0
    period: float = 60.0
    range_sigma: float = 30.0
    speed_sigma: float = 0.1
    yaw_rate_sigma_deg: float = 0.01
    toa_sigma: float = 15.0
    masters: tuple[int, ...] = (0,)
    noise: float = 1.0

    def __post_init__(self) -> None:
        for name in (
            "dt",
            "duration",
            "period",
            "range_sigma",
            "speed_sigma",
            "yaw_rate_sigma_deg",
            "toa_sigma",
        ):
            check_number(name, getattr(self, name))
        check_number("noise", self.noise, may_vanish=True)
        steps = whole_steps(self.duration, self.dt, "duration")
        if whole_steps(self.period, self.dt, "period") > steps:
            raise ConfigurationError(
                f"a period of {self.period} s in {self.duration} s", "give less", field="period"
            )
        masters = set(self.masters)
        if not masters or len(masters) < len(self.masters) or not masters < set(range(len(TRACKS))):
            raise ConfigurationError(
                f"{self.masters} are no masters",
                "name one to three of the AUVs 0 to 3",
                field="masters",
            )

    @property
    def yaw_rate_sigma(self) -> float:
        """Of a measured yaw rate, rad/s."""
        return float(np.deg2rad(self.yaw_rate_sigma_deg))

    @property
    def steps(self) -> int:
        """Number of steps K."""
        return whole_steps(self.duration, self.dt, "duration")


@dataclass(frozen=True, eq=False)
class ZhaoRuns:
    """R simulated runs: the same tracks, noise drawn anew.

    Attributes
    ----------
    settings : ZhaoSettings
        What they were drawn with.
    truth : array, shape (K + 1, A, 3)
        East, north, yaw of the AUVs after each step; m, rad.
    data : FormationData
        What was measured, all pairs of AUVs at each ranging time.
    toa_noise : array, shape (R, E, A)
        Of the slant range from each AUV to a target at each ranging time, m.
    """

    settings: ZhaoSettings
    truth: FloatArray
    data: FormationData
    toa_noise: FloatArray

    def __len__(self) -> int:
        return len(self.toa_noise)

    def epochs(self, times: ArrayLike) -> IntArray:
        """Numbers (N,) of the ranging times that these times (N,), s, are.

        Raises
        ------
        TimeError
            Where one is none of them.
        """
        wanted = np.atleast_1d(np.asarray(times, dtype=np.float64))
        there = self.data.t[self.data.ranging_steps]
        numbers = np.abs(there - wanted[:, None]).argmin(axis=1)
        missed = ~(np.abs(there[numbers] - wanted) <= 1e-3 * self.settings.dt)
        if missed.any():
            raise TimeError(
                f"{wanted[missed][0]} s is no ranging time: they are every "
                f"{self.settings.period} s to {there[-1]} s"
            )
        return numbers

    def slant_ranges(self, target: ArrayLike, times: ArrayLike = TARGET_TIME) -> FloatArray:
        """Measured slant ranges (R, N, A), m, to a target at the ranging times (N,), s.

        Parameters
        ----------
        target : array, shape (2,)
            East, north, m; it is 10 m deeper than the AUVs.
        times : float or array, shape (N,)
            s.

        Raises
        ------
        TimeError
            Where a time is no ranging time.
        DataError
            Where the target is not two finite numbers.
        """
        place, epochs = checked("target", target, (2,)), self.epochs(times)
        there = self.truth[self.data.ranging_steps[epochs], :, :2] - place
        slant = np.sqrt((there**2).sum(axis=-1) + (TARGET_DEPTH - VEHICLE_DEPTH) ** 2)
        return slant + self.toa_noise[:, epochs]


def zhao_track(vehicle: int, steps: int, dt: float = 1.0) -> FloatArray:
    """True states of one AUV after each step, in closed form.

    Each step goes straight on, then turns: with phi = w dt the n-th position is off the first by
    v dt sin(n phi / 2) / sin(phi / 2) in the direction yaw + (n - 1) phi / 2.

    Parameters
    ----------
    vehicle : int
        0 to 3.
    steps : int
        How many, K.
    dt : float
        Length of a step, s.

    Returns
    -------
    array, shape (K + 1, 3)
        East, north, yaw; m, rad.

    Raises
    ------
    ConfigurationError
        Where there is no such AUV.

    Examples
    --------
    >>> zhao_track(3, 3600)[[0, -1], :2].round().tolist()
    [[0.0, 4000.0], [3475.0, -96.0]]
    """
    if vehicle not in range(len(TRACKS)):
        raise ConfigurationError(f"there is no AUV {vehicle}", "choose 0 to 3", field="vehicle")
    east, north, yaw, speed, rate = TRACKS[vehicle]
    n, phi, first = np.arange(steps + 1.0), rate * dt, np.deg2rad(yaw)
    # numpy's sinc is sin(pi x) / (pi x), and one where x is zero.
    straight = n * np.sinc(n * phi / (2.0 * np.pi)) / np.sinc(phi / (2.0 * np.pi))
    way, course = speed * dt * straight, first + (n - 1.0) * phi / 2.0
    return np.stack([east + way * np.cos(course), north + way * np.sin(course), first + n * phi], 1)


def zhao_runs(
    runs: int = 1, seed: int = 1, settings: ZhaoSettings | None = None, *, first: int = 0
) -> ZhaoRuns:
    """Simulate runs of the formation.

    Parameters
    ----------
    runs : int
        How many, R.
    seed : int
        Of the noise. Run i of a seed is the same however many are drawn, and its noise in speed and
        yaw rate the same whatever the sigmas (but for their size), masters and period.
    settings : ZhaoSettings, optional
        What to simulate; left out, the paper's, with the choices above.
    first : int
        Number of the first run, where not all are drawn at once.

    Returns
    -------
    ZhaoRuns

    Raises
    ------
    ConfigurationError
        Where there is no run to draw.

    Examples
    --------
    >>> runs = zhao_runs(3)
    >>> runs.data.speed.shape, runs.data.ranges.shape
    ((3, 3600, 4), (3, 60, 4, 4))
    """
    settings = ZhaoSettings() if settings is None else settings
    if type(runs) is not int or runs < 1 or type(first) is not int or first < 0:
        raise ConfigurationError(f"{runs!r} runs from {first!r} on", "give 1 or more", field="runs")
    steps, vehicles = settings.steps, len(TRACKS)
    truth = np.stack([zhao_track(a, steps, settings.dt) for a in range(vehicles)], axis=1)
    stride = whole_steps(settings.period, settings.dt, "period")
    there = truth[stride::stride, :, :2]
    shapes = (
        (2, steps, vehicles),
        (len(there), vehicles, vehicles),
        (len(there), vehicles),
    )
    drawn = [
        tuple(rng.standard_normal(shape) for shape in shapes)
        for rng in (np.random.default_rng([seed, i]) for i in range(first, first + runs))
    ]
    rates, pairs, toa = (settings.noise * np.stack(part) for part in zip(*drawn, strict=True))
    # A pair has one range: what is drawn for it above the diagonal counts.
    pairs = np.triu(pairs, 1)
    apart = np.linalg.norm(there[:, :, None] - there[:, None], axis=-1)
    speed, yaw_rate = np.array(TRACKS).T[3:]
    data = FormationData(
        dt=settings.dt,
        period=settings.period,
        masters=settings.masters,
        start=truth[0],
        tracks=truth[:, list(settings.masters)],
        speed=speed + settings.speed_sigma * rates[:, 0],
        yaw_rate=yaw_rate + settings.yaw_rate_sigma * rates[:, 1],
        ranges=apart + settings.range_sigma * (pairs + np.swapaxes(pairs, 2, 3)),
        speed_sigma=settings.speed_sigma,
        yaw_rate_sigma=settings.yaw_rate_sigma,
        range_sigma=settings.range_sigma,
    )
    return ZhaoRuns(settings, truth, data, settings.toa_sigma * toa)


def map_grid(half_width: float = 10_000.0, nodes: int = 21) -> FloatArray:
    """Places of the paper's maps, a square about the frame's zero: (nodes^2, 2), m, row by row.

    East runs fastest, so that `values.reshape(nodes, nodes)` has north along its first axis.
    """
    places = np.linspace(-half_width, half_width, nodes)
    north, east = np.meshgrid(places, places, indexing="ij")
    return np.stack([east.ravel(), north.ravel()], axis=1)


def zhao_map(
    runs: ZhaoRuns,
    estimate: FormationEstimate,
    targets: ArrayLike,
    times: ArrayLike = TARGET_TIME,
    *,
    seed: int | None = None,
) -> FloatArray:
    """Root mean square error over runs of targets that all AUVs range: the paper's maps, (T,), m.

    Parameters
    ----------
    runs : ZhaoRuns
        What was simulated.
    estimate : FormationEstimate
        Where the AUVs of these runs are thought to be.
    targets : array, shape (T, 2)
        East, north, m; one at a time is there.
    times : float or array, shape (N,)
        Ranging times at which the target is ranged, s; several count jointly.
    seed : int, optional
        Of noise that each target's ranges have for themselves. Left out, it is that of the runs,
        the same wherever the target is: what `zhao_fleet` hands on.

    Raises
    ------
    TimeError
        Where a time is no ranging time.
    DataError
        Where targets are not finite, or runs and estimate do not go together.
    """
    epochs = runs.epochs(times)
    steps = runs.data.ranging_steps[epochs]
    if estimate.state.shape[:3] != (len(runs), *runs.truth.shape[:2]):
        raise DataError(
            f"estimates of shape {estimate.state.shape} for {len(runs)} runs of "
            f"{runs.truth.shape[:2]} states",
            "give the estimate of these runs",
        )
    noise = runs.toa_noise[:, epochs].reshape(len(runs), -1)
    if seed is not None:
        rng = np.random.default_rng(seed)
        settings = runs.settings
        noise = rng.standard_normal((len(np.atleast_1d(np.asarray(targets))), *noise.shape))
        noise *= settings.noise * settings.toa_sigma
    return target_rmse(
        estimate.state[:, steps, :, :2].reshape(len(runs), -1, 2),
        runs.truth[steps, :, :2].reshape(-1, 2),
        noise,
        targets,
        height=TARGET_DEPTH - VEHICLE_DEPTH,
    )
