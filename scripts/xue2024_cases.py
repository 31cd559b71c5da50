"""One seed of one track of Xue et al. 2024: the paper's windows and the graph on the same pings.

Every function gives sums that add up over seeds; `xue2024.py` makes rows of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import replay_runs as runs

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.arrays import FloatArray
from ubl_graph.baselines.xue2024 import Windows, xue2024
from ubl_graph.errors import TimeError
from ubl_graph.measurements import TwoWayRange
from ubl_graph.mission import Mission, Reference
from ubl_graph.online.estimator import FixedLagEstimator
from ubl_graph.options import Options
from ubl_graph.sim.tracks import Truth, constant_acceleration
from ubl_graph.sim.xue2024 import (
    PING_INTERVAL,
    xue_pass,
    xue_track,
    xue_wandering,
)
from ubl_graph.smoother import smooth

#: The paper's window: each of four beacons twice.
WINDOW = 8
MODELS = {"space intersection": 0, "constant velocity": 1, "constant acceleration": 2}
#: The profile is known exactly and noise is normal, for the windows and for the graph: no state for
#: the sound speed, no robust loss. Straight rays at the harmonic mean are off by 3 cm at the most.
KNOWN_SEA = Options(estimate_sound_speed=False, loss="none", rays="straight")
#: Motion prior and its noise by marginal likelihood.
BY_LIKELIHOOD = replace(KNOWN_SEA, motion="auto", acceleration_psd="auto", jerk_psd="auto")
#: Intervals between nodes in a lag of the fixed-lag estimator. The motion prior interpolates with
#: its own variance, 2 cm for the spiral's at 10 s; closer nodes would lose the least noise, that of
#: straight tracks, in rounding.
INTERVALS = 8
#: In a lag, motion noise that moves a vehicle by less than this share of what the lag's pings can
#: see of its position is none.
NO_MOTION = 0.1
#: Vertical over horizontal motion noise, where that is given: the vehicle keeps its depth.
VERTICAL_SHARE = 1e-6
#: The truth is sampled so often to start Gauss-Newton at, s.
STEP = 0.5
#: Speed that makes metres of seconds, m/s.
NOMINAL_SPEED = 1500.0


@dataclass
class Tally:
    """Sums over windows, by quantity.

    Attributes
    ----------
    total : dict of str to float
        Of squared errors, m^2, or of whatever else is to be averaged.
    count : dict of str to int
        Of summands.
    """

    total: dict[str, float] = field(default_factory=dict[str, float])
    count: dict[str, int] = field(default_factory=dict[str, int])

    def add(self, name: str, values: FloatArray) -> None:
        """Count values in; nan, an answer that is missing, is not hidden: the sum becomes nan."""
        self.total[name] = self.total.get(name, 0.0) + float(np.sum(values))
        self.count[name] = self.count.get(name, 0) + int(np.size(values))

    def take(self, other: Tally) -> None:
        """Count in what another one counted."""
        for name, total in other.total.items():
            self.total[name] = self.total.get(name, 0.0) + total
            self.count[name] = self.count.get(name, 0) + other.count[name]

    def mean(self, name: str) -> float | None:
        """Mean, or None where nothing was counted, or something that is no number."""
        if not self.count.get(name):
            return None
        mean = self.total[name] / self.count[name]
        return mean if np.isfinite(mean) else None

    def rms(self, name: str) -> float | None:
        """Root of the mean."""
        mean = self.mean(name)
        return None if mean is None else float(np.sqrt(mean))


@dataclass(frozen=True)
class Case:
    """What is simulated, and what is done with it.

    Attributes
    ----------
    kind : str
        Name of the function in `KINDS`.
    track : str
        "straight", "accelerating", "spiral", "wandering"; "straight, V m/s" at another speed;
        "passing, E m", eastward from there.
    sigma : float
        Of the two-way travel times, s.
    seed : int
        Of the noise.
    motion, psd : str, float
        Motion prior and its noise, where they are given.
    lags : tuple of int
        Windows and lags in pings.
    stride : int
        One window in so many is solved alone.
    """

    kind: str
    track: str
    sigma: float
    seed: int
    motion: str = ""
    psd: float = 0.0
    lags: tuple[int, ...] = (WINDOW,)
    stride: int = 1

    @property
    def key(self) -> tuple[str, str, float, str, float]:
        """What seeds are averaged over."""
        return self.kind, self.track, self.sigma, self.motion, self.psd


def run(case: Case, _seed: int = 0) -> Tally:
    """Simulate a case and count errors; what its kind says is done."""
    return KINDS[case.kind](case)


def simulated(case: Case, options: Options) -> tuple[Mission, Truth]:
    """Mission and truth of a case."""
    track: Any = case.track
    if case.track == "wandering":
        track = xue_wandering(case.seed, case.psd)
    elif case.track.startswith("straight, "):
        track = xue_track("straight", speed=float(case.track.split()[1]))
    return xue_pass(track, case.seed, sigma=case.sigma, options=options)


def dense(truth: Truth) -> Reference:
    """The truth as a track to start Gauss-Newton at: the kindest start there is."""
    begin, end = truth.span
    return truth.reference(np.arange(begin, end, STEP))


def squared(truth: Truth, t: FloatArray, position: FloatArray) -> FloatArray:
    """Squared horizontal errors, m^2."""
    return ((position - truth.position(t))[:, :2] ** 2).sum(axis=1)


def windows(mission: Mission, truth: Truth, model: int, pings: int = WINDOW) -> Windows:
    """The paper's windows of the one segment."""
    return xue2024(mission, model, window=pings, starts={"": dense(truth)})[""]


def count_windows(
    tally: Tally, mission: Mission, truth: Truth, pings: int = WINDOW, stride: int = 1
) -> None:
    """Count the errors and dilutions of all models that so many pings can solve."""
    for name, model in MODELS.items():
        if pings <= 2 * (model + 1):
            continue
        found = windows(mission, truth, model, pings)
        for epoch, fixes in (("centre", found.centre), ("current", found.current)):
            errors = squared(truth, fixes.t, fixes.position)[::stride]
            tally.add(f"{name} {epoch} {pings}", errors)
        tally.add(f"{name} TRDOP {pings}", found.trdop)


def count_whole(tally: Tally, mission: Mission, truth: Truth, name: str = "whole") -> Mission:
    """Smooth the whole track and count its errors but for four pings at both ends.

    Returns
    -------
    Mission
        With the options that the data chose.
    """
    result = smooth(mission)
    t = pings_of(mission).t_transmit[4:-4]
    states = result.trajectory.at(t)
    tally.add(name, squared(truth, t, states.position))
    tally.add(f"{name} predicted", states.covariance[:, 0, 0] + states.covariance[:, 1, 1])
    return result.mission


def pings_of(mission: Mission) -> TwoWayRange:
    """The two-way ranges of the one segment."""
    pings = mission.segments[0].two_way_range
    assert pings is not None
    return pings


def online_options(options: Options, sigma: float, lag: float) -> Options:
    """Options for the fixed-lag estimator: nodes, and motion noise that it can tell from none."""
    count = lag / PING_INTERVAL
    unseen = NO_MOTION * sigma * NOMINAL_SPEED / 2.0 / np.sqrt(count + 1.0)
    if options.is_constant_velocity:
        least, name = 3.0 * unseen**2 / lag**3, "acceleration_psd"
    else:
        least, name = 20.0 * unseen**2 / lag**5, "jerk_psd"
    noise: dict[str, Any] = {
        name: max(options.horizontal_psd, float(least)),
        f"vertical_{name}": max(options.vertical_psd, float(least)),
    }
    return replace(options, lag=lag, node_spacing=lag / INTERVALS, **noise)


def count_online(
    tally: Tally, mission: Mission, truth: Truth, sigma: float, pings: int = WINDOW
) -> None:
    """Run the fixed-lag estimator; count errors at the windows' own epochs.

    After the last ping of each window the estimator says where the vehicle was at the window's
    middle, and at its last emission. Its lag is that of the window; what is older it remembers as a
    prior. An epoch without an answer makes the row empty.
    """
    options = online_options(mission.options, sigma, pings * PING_INTERVAL)
    estimator = FixedLagEstimator.of(replace(mission.setup, options=options))
    rows = pings_of(mission)
    number = -1
    for _, is_ping, record in runs.arrivals(mission.segments[0]):
        estimator.add(record)
        if not is_ping:
            continue
        number += 1
        if number < pings - 1:
            continue
        first, last = number - pings + 1, number
        centre = 0.5 * (rows.t_transmit[first] + rows.t_receive[last])
        t = np.array([centre, rows.t_transmit[last]])
        try:
            states = estimator.smoothed(t)
            errors = squared(truth, t, states.position)
            predicted = states.covariance[:, 0, 0] + states.covariance[:, 1, 1]
        except TimeError:
            errors = predicted = np.full(2, np.nan)
        for k, epoch in enumerate(("centre", "current")):
            tally.add(f"lag {epoch} {pings}", errors[k])
            tally.add(f"lag {epoch} {pings} predicted", predicted[k])


def count_alone(tally: Tally, mission: Mission, truth: Truth, stride: int) -> None:
    """Smooth windows of pings each for itself, without memory."""
    (segment,) = mission.segments
    pings, depth = pings_of(mission), segment.depth
    assert depth is not None
    for first in range(0, len(pings) - WINDOW + 1, stride):
        rows = np.arange(first, first + WINDOW)
        only = replace(
            segment,
            two_way_range=pings[rows],
            depth=depth[np.arange(first, first + WINDOW + 1)],
            reference=None,
        )
        track = smooth(replace(mission, segments=(only,))).trajectory
        last = pings.t_transmit[rows[-1]]
        t = np.array([0.5 * (pings.t_transmit[first] + pings.t_receive[rows[-1]]), last])
        errors = squared(truth, t, track.at(t).position)
        for k, epoch in enumerate(("centre", "current")):
            tally.add(f"alone {epoch}", errors[k])


def likelihood(case: Case) -> Tally:
    """Windows, and the graph with motion prior and noise by marginal likelihood."""
    tally = Tally()
    mission, truth = simulated(case, BY_LIKELIHOOD)
    tuned = count_whole(tally, mission, truth)
    for pings in case.lags:
        count_windows(tally, mission, truth, pings)
        count_online(tally, tuned, truth, case.sigma, pings)
    return tally


def given_noise(case: Case) -> Tally:
    """Windows, and the graph with a motion prior and noise that are given."""
    tally = Tally()
    mission, truth = simulated(case, given_options(case))
    count_windows(tally, mission, truth)
    count_whole(tally, mission, truth)
    count_online(tally, mission, truth, case.sigma)
    return tally


def too_little(case: Case) -> Tally:
    """The whole track with far too little motion noise for it; windows beside it."""
    tally = Tally()
    mission, truth = simulated(case, given_options(case))
    count_windows(tally, mission, truth)
    count_whole(tally, mission, truth)
    return tally


def alone(case: Case) -> Tally:
    """Windows, and the graph on the same eight pings without any others."""
    tally = Tally()
    mission, truth = simulated(case, given_options(case))
    count_windows(tally, mission, truth, stride=case.stride)
    count_alone(tally, mission, truth, case.stride)
    return tally


def wrong_speed(case: Case) -> Tally:
    """All are told 1500 m/s: windows, the graph without and with a state for the sound speed."""
    tally = Tally()
    mission, truth = simulated(case, BY_LIKELIHOOD)
    mission = replace(mission, sound_speed=SoundSpeedProfile.constant(1500.0))
    count_windows(tally, mission, truth)
    count_whole(tally, mission, truth, "whole, given")
    free = replace(BY_LIKELIHOOD, estimate_sound_speed=True, sound_speed_walk=0.0)
    count_whole(tally, replace(mission, options=free), truth, "whole, estimated")
    return tally


def consistency(case: Case) -> Tally:
    """A track drawn from the graph's own motion prior, with its own noise."""
    tally = Tally()
    mission, truth = simulated(case, given_options(case))
    count_whole(tally, mission, truth)
    count_online(tally, mission, truth, case.sigma)
    return tally


def given_options(case: Case) -> Options:
    """Options with the case's motion prior and noise."""
    name = "acceleration_psd" if case.motion == "constant_velocity" else "jerk_psd"
    noise: dict[str, Any] = {name: case.psd, f"vertical_{name}": VERTICAL_SHARE * case.psd}
    if case.track == "wandering":
        # That track was drawn with this one.
        noise[f"vertical_{name}"] = 1e-8
    motion: Any = case.motion
    return replace(KNOWN_SEA, motion=motion, **noise)


def correlations(case: Case) -> Tally:
    """Pearson's correlation of errors with their dilutions, over a track that passes by (Table 1).

    The track goes east at 4 m/s, gaining 1e-5 m/s^2 eastward and northward.
    """
    tally = Tally()
    mission, truth = passing(case)
    for name, model in list(MODELS.items())[1:]:
        found = windows(mission, truth, model)
        position = np.sqrt(squared(truth, found.centre.t, found.centre.position))
        velocity = np.hypot(*(found.velocity - truth.velocity(found.centre.t)[:, :2]).T)
        for what, error, dop in (
            ("position", position, found.dop[:, 0]),
            ("velocity", velocity, found.dop[:, 1]),
        ):
            tally.add(f"{name} {what}", np.corrcoef(error, dop)[0, 1])
    return tally


def passing(case: Case) -> tuple[Mission, Truth]:
    """Mission and truth of Table 1's track."""
    span = xue_track("straight").span
    start, velocity = [float(case.track.split()[1]), 0.0, -1000.0], [4.0, 0.0, 0.0]
    truth = constant_acceleration(start, velocity, [1e-5, 1e-5, 0.0], span)
    return xue_pass(truth, case.seed, sigma=case.sigma, options=KNOWN_SEA)


KINDS: dict[str, Callable[[Case], Tally]] = {
    "likelihood": likelihood,
    "given": given_noise,
    "too little": too_little,
    "alone": alone,
    "wrong speed": wrong_speed,
    "consistency": consistency,
    "correlation": correlations,
}


def gathered(cases: Sequence[Case], tallies: Sequence[Tally]) -> dict[Any, Tally]:
    """Sums over seeds, by `Case.key`."""
    found: dict[Any, Tally] = {}
    for case, tally in zip(cases, tallies, strict=True):
        found.setdefault(case.key, Tally()).take(tally)
    return found
