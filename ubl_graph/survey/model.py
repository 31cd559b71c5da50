"""The least-squares problem of a survey whose track is known: ranges, sound speed, beacons.

The residual is the range block's own (`ubl_graph.factors.ranges`). What is new is what its log
scale is made of: beside the column's mean g(t) two horizontal gradients, one that acts by where the
vehicle is and one by where the beacon is,

    tau exp(g + G . (vehicle - centre) + H . (beacon - centre))

both of them walks in time. A gradient near the surface acts by the vehicle's place, one at the
bottom by the beacon's, and one at depth in between by both (Kinugasa et al. 2020, Prog. Earth
Planet. Sci. 7:21; Watanabe et al. 2020, Front. Earth Sci. 8:597532).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.builder import FREE_POSITION, RANGE_BIAS
from ubl_graph.errors import ConfigurationError
from ubl_graph.factors import linear
from ubl_graph.factors.block import Block, LinearBlock
from ubl_graph.factors.loss import RobustLoss
from ubl_graph.factors.ranges import FreeAntenna, PointAntenna, RangeBlock
from ubl_graph.layout import Chain, Interpolation
from ubl_graph.measurements import OneWayRange, SlantRange
from ubl_graph.mission import PROFILE_SIGMA, Mission
from ubl_graph.nodes import NOMINAL_SPEED
from ubl_graph.pings import (
    Pings,
    along_distances,
    kind_of,
    leg_times,
    measured_times,
    travel_time_model,
)
from ubl_graph.problem import Problem
from ubl_graph.survey.layout import GRADIENTS, SurveyLayout, knots, log_scale

#: Standard deviation of a log scale that is not to be estimated.
HELD = 1e-9
#: Name of the slow state that says what the track errs by for a while, m. GNSS errs for minutes in
#: the same direction; were all its errors new from ping to ping, a thousand pings would seem to
#: average them out.
TRACK_ERROR = "track_error"
#: Knots farther apart than so many spacings have a gap between them.
WIDE_GAP = 1.5
#: The share of a fix's variance that lasts, and for how long, s.
LASTING_SHARE, LASTING_TIME = 0.5, 600.0
#: Lasting error of a track without any, m.
LEAST_ERROR = 1e-6


@dataclass(frozen=True, kw_only=True)
class SurveyOptions:
    """What a survey can be told beside the mission's own options.

    Raises
    ------
    ConfigurationError
        Where a number is not finite or outside its range.
    """

    knot_spacing: float = 60.0
    """Time between two knots of the sound speed, s; in between it is linear."""

    gradients: bool = True
    """Whether horizontal gradients of the sound speed are unknowns."""

    gradient_length: float = 1e4
    """Columns of water so far apart differ as much as one differs from its profile, m. It makes the
    gradients' prior (1e-3 over this length) and walk (that of the sound speed over it)."""

    fit_noise: bool = True
    """Whether the noise of the ranges and the walk of the sound speed are those under which the
    data are likeliest; else the data and the mission's options say them."""

    def __post_init__(self) -> None:
        for name, low, high in (("knot_spacing", 1.0, 1e5), ("gradient_length", 1.0, 1e9)):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigurationError(
                    f"{value} is outside {low:g} to {high:g}", field=f"survey.{name}"
                )


@dataclass(frozen=True)
class Noise:
    """What the likelihood may choose.

    Attributes
    ----------
    range_factor : float
        On the stated standard deviations of the ranges.
    walk : float
        Random walk of the log scale, 1/sqrt(s).
    """

    range_factor: float
    walk: float


@dataclass(frozen=True, eq=False)
class SurveyPings:
    """Ranges of one kind and segment, with the transducer at each leg's time.

    Attributes
    ----------
    segment : str
        Its name.
    pings : TwoWayRange, OneWayRange or SlantRange
        M records.
    position, variance : array, shape (M, L, 3)
        Of the transducer; m, m^2. Half of the variance is taken as lasting (`TRACK_ERROR`).
    """

    segment: str
    pings: Pings
    position: FloatArray
    variance: FloatArray


class TrackAntenna(PointAntenna):
    """A transducer whose place at each leg is known, but for what the track errs by.

    Parameters
    ----------
    error : Interpolation
        Of the track's lasting error at each leg's time (M * L rows, three components, m).
    position, variance : array, shape (M, L, 3)
        Known place, and the variance of what errs anew each time; m, m^2.
    water : array, shape (M,)
        What the sound speed's walk between two knots adds to the travel time's variance, s^2.
    """

    def __init__(
        self,
        error: Interpolation,
        position: FloatArray,
        variance: FloatArray,
        water: FloatArray,
    ) -> None:
        super().__init__(error, position, np.zeros(3), np.zeros(position.shape[:2]).ravel())
        self._variance, self._water = variance, water

    def variance(self, gradient: FloatArray, terms: None) -> FloatArray:
        """Variance of the track along the gradients, and of the water, (M,)."""
        return super().variance(gradient, terms) + self._water


class SurveyModel:
    """Builds the problem of a survey.

    Parameters
    ----------
    mission : Mission
        Beacons, sound speed, options.
    pings : sequence of SurveyPings
        All ranges of all segments.
    options : SurveyOptions
        What is estimated.

    Attributes
    ----------
    layout : SurveyLayout
        The unknowns.
    chain : Chain
        The knots.
    names : tuple of str
        Beacons that were heard, in the mission's order.
    centre : array, shape (2,)
        East and north from which gradients count, m.
    """

    def __init__(
        self, mission: Mission, pings: Sequence[SurveyPings], options: SurveyOptions
    ) -> None:
        self.mission, self.pings, self.options = mission, tuple(pings), options
        heard = {str(name) for p in pings for name in p.pings.beacon}
        self.names = tuple(name for name in mission.beacon_names if name in heard)
        self.given = {b.name: b.position for b in mission.beacons}
        self.centre = np.mean([self.given[name][:2] for name in self.names], axis=0)
        variance = np.concatenate([p.variance.reshape(-1, 3) for p in pings])
        self._lasting = np.sqrt(LASTING_SHARE * np.median(variance, axis=0))
        spans = [(float(t.min()), float(t.max())) for t in (leg_times(p.pings) for p in pings)]
        self.chain = Chain("", 0, knots(spans, options.knot_spacing))
        slow: list[tuple[str, int]] = [("sound_speed", 1), (TRACK_ERROR, 3)]
        if options.gradients and mission.options.estimate_sound_speed:
            slow += [(name, 2) for name in GRADIENTS]
        if any(isinstance(p.pings, OneWayRange) for p in pings):
            slow += [("clock_offset", 1), ("clock_drift", 1)]
        shared = [(f"beacon {name}", 3) for name in self.names]
        if mission.options.range_bias_sigma > 0.0:
            shared += [(f"{RANGE_BIAS}{name}", 1) for name in self.names]
        self.layout = SurveyLayout((self.chain,), 2, tuple(slow), tuple(shared))

    @property
    def noise(self) -> Noise:
        """As the mission's options say it."""
        walk = max(self.mission.options.settled.number("sound_speed_walk"), HELD)
        return Noise(1.0, walk)

    def start(self, places: Mapping[str, FloatArray] | None = None) -> FloatArray:
        """The flat vector with beacons at `places`, left out as given, and all else zero."""
        x = np.zeros(self.layout.size)
        for name in self.names:
            self.layout.put(x, f"beacon {name}", (self.given if places is None else places)[name])
        return x

    def beacons_at(self, x: FloatArray) -> dict[str, FloatArray]:
        """Positions of the beacons in the flat vector `x`, m."""
        return {name: self.layout.get(x, f"beacon {name}") for name in self.names}

    def beacon_columns(self) -> IntArray:
        """Columns of all beacons, in the order of `names`."""
        return np.concatenate([self.layout.shared_columns(f"beacon {n}") for n in self.names])

    def problem(
        self,
        noise: Noise,
        sigmas: Mapping[str, FloatArray],
        places: Mapping[str, FloatArray] | None = None,
    ) -> Problem:
        """The problem under some noise.

        Parameters
        ----------
        noise : Noise
            Of ranges and sound speed.
        sigmas : mapping of str to array, shape (3,)
            Standard deviations of the given positions by beacon, m; 0 and what is not there have
            no prior.
        places : mapping of str to array, shape (3,), optional
            Where beacons are for the gradients' purpose; left out, as given.
        """
        ranges = [self._range_block(p, noise, places or self.given) for p in self.pings]
        blocks = (*ranges, *self.slow_blocks(noise), *self._shared_priors(sigmas))
        return Problem(self.layout, blocks, RobustLoss(self.mission.options.loss), (1.0, 1.0))

    def slow_blocks(self, noise: Noise) -> list[LinearBlock]:
        """Priors at the first knot, and walks from knot to knot."""
        options, layout = self.mission.options, self.layout
        scale = self.mission.sound_speed_sigma if options.estimate_sound_speed else HELD
        sigmas = {
            "sound_speed": max(scale, HELD),
            **dict.fromkeys(GRADIENTS, PROFILE_SIGMA / self.options.gradient_length),
            "clock_offset": max(options.clock_offset_sigma, 1e-15),
            "clock_drift": max(options.clock_drift_sigma, 1e-15),
        }
        walks = self._walks(noise)
        blocks: list[LinearBlock] = []
        for name, _ in layout.slow:
            columns = layout.node_columns(name, np.array([0]))
            if name == TRACK_ERROR:
                blocks += self._track_error()
                continue
            if name.startswith("clock"):
                # Clocks are set between dives: each stretch without a gap has its own.
                columns = layout.node_columns(name, np.array([s.first for s in self._stretches()]))
            sigma = np.array(sigmas[name] / layout.unit(name))
            blocks.append(linear.prior(name, columns, np.zeros(columns.shape), sigma))
            if name in walks and len(self.chain.t) > 1:
                blocks.append(self._walk(name, walks[name], sigmas[name]))
        if layout.has("clock_offset"):
            clock = max(options.clock_walk, 1e-10), max(options.clock_drift_walk, 1e-13)
            stretches = [s for s in self._stretches() if len(s.t) > 1]
            blocks += [linear.clock_walk(layout, s, *clock) for s in stretches]
        return blocks

    def _stretches(self) -> list[Chain]:
        """Knots between which there is no gap."""
        t = self.chain.t
        gaps = np.flatnonzero(np.diff(t) > WIDE_GAP * self.options.knot_spacing) + 1
        firsts = [0, *(int(k) for k in gaps)]
        return [Chain("", k, part) for k, part in zip(firsts, np.split(t, gaps), strict=True)]

    def _walks(self, noise: Noise) -> dict[str, float]:
        """Random walks of the states that wander."""
        estimated = self.mission.options.estimate_sound_speed
        return {
            "sound_speed": noise.walk if estimated else HELD,
            **dict.fromkeys(GRADIENTS, self.noise.walk / self.options.gradient_length),
        }

    def _track_error(self) -> list[LinearBlock]:
        """The track's lasting error: a stationary process in each axis."""
        layout = self.layout
        columns = layout.node_columns(TRACK_ERROR, np.arange(layout.node_count))
        sigma = np.maximum(self._lasting, LEAST_ERROR)
        first = linear.prior(TRACK_ERROR, columns[:1], np.zeros((1, 3)), sigma)
        if len(columns) == 1:
            return [first]
        kept = np.exp(-np.diff(self.chain.t) / LASTING_TIME)
        inverse = 1.0 / (sigma * np.sqrt(1.0 - kept[:, None] ** 2))
        step = np.concatenate(
            [-kept[:, None, None] * np.eye(3), np.tile(np.eye(3), (len(kept), 1, 1))], 2
        )
        walk = LinearBlock(
            "track error",
            np.concatenate([columns[:-1], columns[1:]], axis=1),
            inverse[:, :, None] * step,
            np.zeros((len(kept), 3)),
        )
        return [first, walk]

    def _walk(self, name: str, walk: float, sigma: float) -> LinearBlock:
        """A slow state wanders, but between two days by no more than it is known beforehand."""
        most = 2.0 * (sigma / walk) ** 2
        steps = np.minimum(np.diff(self.chain.t), most)
        t = np.concatenate([[0.0], np.cumsum(steps)])
        return linear.random_walk(self.layout, Chain("", 0, t), name, walk)

    def _shared_priors(self, sigmas: Mapping[str, FloatArray]) -> list[Block]:
        blocks: list[Block] = []
        free = np.zeros(3)
        for name in self.names:
            given = np.asarray(sigmas.get(name, free))
            sigma = np.where(given > 0.0, given, FREE_POSITION)
            columns = self.layout.shared_columns(f"beacon {name}")[None]
            blocks.append(linear.prior("beacon", columns, self.given[name][None], sigma[None]))
            if self.layout.has(f"{RANGE_BIAS}{name}"):
                columns = self.layout.shared_columns(f"{RANGE_BIAS}{name}")[None]
                bias = np.array(self.mission.options.range_bias_sigma)
                blocks.append(linear.prior("range bias", columns, np.zeros((1, 1)), bias))
        return blocks

    def _range_block(
        self, part: SurveyPings, noise: Noise, places: Mapping[str, FloatArray]
    ) -> RangeBlock:
        pings, layout = part.pings, self.layout
        times = leg_times(pings)
        m, legs = times.shape
        names = [str(name) for name in pings.beacon]
        there = np.stack([places[name][:2] for name in names]) - self.centre
        here = part.position[:, :, :2].reshape(-1, 2) - self.centre
        scale = log_scale(layout, self.chain, times.ravel(), here, np.repeat(there, legs, axis=0))
        error = layout.slow_at(TRACK_ERROR, self.chain, times.ravel())
        measured, sigma = measured_times(pings)
        # Between two knots a walk strays from the straight line by walk^2 dt s (1 - s).
        bridge = (scale.dt * scale.s * (1.0 - scale.s)).reshape(m, legs).mean(axis=1)
        flight = np.zeros(m) if isinstance(pings, OneWayRange) else measured
        between = bridge * (self._walks(noise)["sound_speed"] * flight) ** 2
        columns = [layout.shared_columns(f"beacon {name}") for name in names]
        slant = isinstance(pings, SlantRange)
        return RangeBlock(
            kind_of(pings),
            part.segment,
            along_distances if slant else travel_time_model(self.mission.setup),
            TrackAntenna(error, part.position, (1.0 - LASTING_SHARE) * part.variance, between),
            FreeAntenna(np.stack(columns), legs),
            measured,
            noise.range_factor * sigma,
            scale,
            self._added(pings, names, m, legs),
        )

    def _added(self, pings: Pings, names: list[str], m: int, legs: int) -> Interpolation | None:
        """What adds to the travel times: the clock's offset, and each beacon's range bias."""
        parts: list[Interpolation] = []
        if isinstance(pings, OneWayRange):
            parts.append(self.layout.slow_at("clock_offset", self.chain, pings.t_receive))
        if self.mission.options.range_bias_sigma > 0.0:
            columns = np.stack(
                [self.layout.shared_columns(f"{RANGE_BIAS}{name}") for name in names]
            )
            weights, none = np.full((m, 1), legs / NOMINAL_SPEED), np.zeros(m)
            parts.append(Interpolation(columns[:, None], weights, none, none))
        return Interpolation.together(parts) if parts else None
