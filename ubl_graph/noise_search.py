"""The search for the noise under which a mission's data are likeliest.

Each number is searched on a logarithmic scale, one after the other, until none of them makes the
data more likely. No reference track is looked at, and no covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from ubl_graph.arrays import FloatArray
from ubl_graph.builder import SegmentModel
from ubl_graph.errors import SolverError
from ubl_graph.factors import linear
from ubl_graph.graph import build_problem, model_segment
from ubl_graph.initial import START_LIMIT
from ubl_graph.measurements import OneWayRange, TwoWayRange
from ubl_graph.mission import Mission, Segment
from ubl_graph.nodes import LEAST_MOVE, NOMINAL_SPEED, node_times, order_of
from ubl_graph.options import AUTO, Motion, Options
from ubl_graph.pose_initial import find_tracks
from ubl_graph.problem import Problem
from ubl_graph.solve.banded import BandedEngine
from ubl_graph.solve.evidence import log_evidence
from ubl_graph.solve.robust import graduated
from ubl_graph.track import Track, carried, start_vector
from ubl_graph.trajectory import process_noise

#: The first acceleration of a vehicle under water is zero within this, m/s^2. The smoother takes
#: next to nothing for known; a likelihood would hold that against the model that has one.
FIRST_ACCELERATION = 0.1
#: Motion noise that moves a vehicle in all its mission by less than this share of what all pings
#: together could see is none.
NO_MOTION = 0.05
#: Largest noise density, m^2/s^3 or m^2/s^5: that of a vehicle that does as it likes.
MOST_NOISE = 1.0
#: Vertical noise is at least this share of the horizontal one, and the other way round: a
#: thousandth of its motion. Nodes stand where the larger one wants them, so close that far less of
#: the other would be lost in rounding.
LEAST_SHARE = 1e-6
#: Factors on the travel times' sigmas, and random walks of the sound speed, 1/sqrt(s).
FACTORS, WALKS = (0.03, 100.0), (1e-8, 1e-3)
#: Stands for the infinite cost of noise under which nothing can be solved.
IMPOSSIBLE = 1e12
#: Motion noise is taken where it makes the data more likely by this: a number more is worth one
#: (Akaike 1974).
WORTH_NOISE = 1.0
#: What is known beforehand, in decades about the stated or default value: travel times' sigmas are
#: right within a factor of three, the sound speed's walk within ten.
SPREADS = {"travel_time_sigma": 0.5, "sound_speed_walk": 1.0}
#: Ranges and fixes that each number wants.
RECORDS_A_NUMBER = 5
#: Numbers are found to this share of a decade,
TOLERANCE = 0.1
#: and all of them are gone through until a pass makes the data less than so much more likely,
WORTH_A_PASS = 0.1
#: at most so often, the later ones in steps smaller by this.
MOST_PASSES, LATER_STEPS = 4, 0.3

#: Called with how far the search is, 0 to 1.
Progress = Callable[[float], None]


@dataclass(frozen=True)
class _Knob:
    """A number that is searched: decadic logarithms of where to begin, of the bounds, of a step."""

    start: float
    low: float
    high: float
    step: float


class NoiseSearch:
    """The search for one motion prior.

    Parameters
    ----------
    mission : Mission
        With defaults in place of what is left to the data.
    asked : Options
        As the user gave them.
    motion : str
        The motion prior.

    Attributes
    ----------
    best : float
        Largest logarithm of the likelihood so far.
    at : dict of str to float
        Decadic logarithms of the numbers there, by option; of the travel times' sigmas that of
        their factor.
    evaluations : int
        So far.
    """

    def __init__(self, mission: Mission, asked: Options, motion: Motion) -> None:
        self.motion: Motion = motion
        options = replace(mission.options, motion=motion)
        self._mission = replace(mission, options=options)
        self._models, tracks = _modelled(self._mission)
        self._odometry = any(m.bottom or m.water for m in self._models)
        constant_velocity = motion == "constant_velocity"
        self._horizontal = "acceleration_psd" if constant_velocity else "jerk_psd"
        self._vertical = f"vertical_{self._horizontal}"
        self._knobs = self._all_knobs(asked)
        self.at = {name: knob.start for name, knob in self._knobs.items()}
        self.evaluations = 0
        self._layout = self._problem(self.at).layout
        self._x = start_vector(self._mission, self._layout, tracks[0])
        self.best = -np.inf
        self._begin(tracks)

    def _begin(self, tracks: Sequence[Sequence[Track]]) -> None:
        """Likelihood at the start, from every track that was found, and from the graduated ones."""
        layout = self._layout
        for some in tracks:
            self._evaluate(self.at, start=start_vector(self._mission, layout, some))
        self._graduate()
        if "travel_time_sigma" in self._knobs:
            for decades in (-1.0, 1.0):
                self._evaluate({**self.at, "travel_time_sigma": decades})

    def _graduate(self) -> None:
        """The same numbers from a track that outliers had less part in, where there may be some."""
        problem = self._problem(self.at)
        if problem.loss.name != "none":
            with suppress(SolverError):
                self._evaluate(self.at, start=graduated(BandedEngine(problem), self._x))

    @property
    def scarce(self) -> str:
        """Why there are too few data for so many numbers; empty where there are enough."""
        records = [r for m in self._models for r in (*_ranges(m.segment), m.segment.position)]
        count = sum(len(r) for r in records if r is not None)
        needed = RECORDS_A_NUMBER * len(self._knobs)
        if count >= needed:
            return ""
        return (
            f"{count} ranges and fixes are too few for {len(self._knobs)} numbers, {needed} are not"
        )

    @property
    def names(self) -> frozenset[str]:
        """Options that were searched."""
        return frozenset(self._knobs)

    @property
    def vertical(self) -> tuple[str, ...]:
        """The vertical noise density, where it was searched."""
        return (self._vertical,) if self._vertical in self._knobs else ()

    def run(self, progress: Progress) -> None:
        """Go through all numbers until none makes the data more likely."""
        passes = MOST_PASSES if len(self._knobs) > 1 else 1
        for number in range(passes):
            before = self.best
            for k, (name, knob) in enumerate(self._knobs.items()):
                progress((number + k / len(self._knobs)) / passes)
                self._line(name, knob, knob.step if number == 0 else LATER_STEPS * knob.step)
            if self.best - before < WORTH_A_PASS:
                break
        self._graduate()
        self._spare()

    def _spare(self) -> None:
        """Take no motion noise where noise makes the data hardly any likelier."""
        for name in (self._horizontal, self._vertical):
            if name in self._knobs:
                at = {**self.at, name: self._knobs[name].low}
                self._evaluate(at, least=self.best - WORTH_NOISE)

    def answer(self) -> Mission:
        """The mission with the numbers that are the best."""
        return self._posed(self.at)

    @property
    def factor(self) -> float:
        """On the travel times' sigmas."""
        return 10.0 ** self.at.get("travel_time_sigma", 0.0)

    def _posed(self, at: dict[str, float]) -> Mission:
        """The mission with these numbers."""
        values = {name: 10.0**u for name, u in at.items()}
        factor = values.pop("travel_time_sigma", 1.0)
        for one, other in ((self._horizontal, self._vertical), (self._vertical, self._horizontal)):
            if one in values:
                beside = values.get(other) or getattr(self._mission.options, other) or 0.0
                values[one] = max(values[one], LEAST_SHARE * beside)
        options = replace(self._mission.options, **values)
        segments = tuple(_scaled(s, factor) for s in self._mission.segments)
        if "travel_time_sigma" in self._knobs:
            stated = np.concatenate([r.sigma for s in segments for r in _ranges(s)])
            options = replace(options, travel_time_sigma=float(np.median(stated)))
        return replace(self._mission, options=options, segments=segments)

    def _all_knobs(self, asked: Options) -> dict[str, _Knob]:
        options, free = self._mission.options, not _joined(self._models)
        knobs: dict[str, _Knob] = {}

        def add(name: str, start: float, low: float, high: float, step: float) -> None:
            begin, least, most = (float(np.log10(x)) for x in (start, low, high))
            knobs[name] = _Knob(min(max(begin, least), most), least, most, step)

        if getattr(asked, self._horizontal) == AUTO and free:
            low = self._least_noise()
            add(self._horizontal, options.horizontal_psd, low, MOST_NOISE, 1.0)
            if getattr(asked, self._vertical) is None:
                add(self._vertical, options.horizontal_psd, low, MOST_NOISE, 1.0)
        ranges = [r for m in self._models for r in _ranges(m.segment)]
        if asked.travel_time_sigma == AUTO and ranges:
            add("travel_time_sigma", 1.0, *FACTORS, 0.3)
        if asked.sound_speed_walk == AUTO and ranges and options.estimate_sound_speed:
            add("sound_speed_walk", options.number("sound_speed_walk"), *WALKS, 0.7)
        return knobs

    def _least_noise(self) -> float:
        """Noise density that is as good as none, m^2/s^3 or m^2/s^5.

        In a segment it moves the vehicle by less than its ranges and fixes can see, but between two
        nodes by no less than double precision can.
        """
        order = order_of(self._mission.options)

        def density(moved: float, dt: float) -> float:
            return moved**2 / float(process_noise(order, dt)[0, 0, 0])

        unseen = [
            density(NO_MOTION * _resolved(m.segment), max(float(m.t[-1] - m.t[0]), 1.0))
            for m in self._models
        ]
        least = min(*unseen, MOST_NOISE)
        options = replace(
            self._mission.options,
            **{self._horizontal: least, self._vertical: least},
        )
        nodes = [self._remodelled(m, m.segment, options).t for m in self._models]
        apart = min((float(np.diff(t).min()) for t in nodes if len(t) > 1), default=1.0)
        return min(max(least, density(LEAST_MOVE, apart)), MOST_NOISE)

    def _line(self, name: str, knob: _Knob, step: float) -> None:
        """Search one number, the others held: bracket the best value in steps, then narrow down."""
        first = step
        tried = {self.at[name]: self.best}

        def value(u: float) -> float:
            u = float(np.clip(u, knob.low, knob.high))
            if u not in tried:
                tried[u] = self._evaluate({**self.at, name: u})
            return tried[u]

        middle = self.at[name]
        for sign in (-1.0, 1.0):
            step = first
            while value(middle + sign * step) > tried[middle]:
                middle = float(np.clip(middle + sign * step, knob.low, knob.high))
                step *= 1.5
                if middle in (knob.low, knob.high):
                    break
        points = sorted(tried)
        i = points.index(middle)
        low, high = points[max(i - 1, 0)], points[min(i + 1, len(points) - 1)]

        def cost(u: float) -> float:
            return min(-value(u), IMPOSSIBLE)

        if high - low > TOLERANCE:
            minimize_scalar(
                cost, bounds=(low, high), method="bounded", options={"xatol": TOLERANCE}
            )

    def _problem(self, at: dict[str, float]) -> Problem:
        mission = self._posed(at)
        models = [
            self._remodelled(model, segment, mission.options)
            for model, segment in zip(self._models, mission.segments, strict=True)
        ]
        problem = build_problem(mission, models)
        blocks = tuple(
            linear.prior("acceleration", b.columns, 0.0 * b.target, np.array(FIRST_ACCELERATION))
            if isinstance(b, linear.LinearBlock) and b.name == "acceleration prior"
            else b
            for b in problem.blocks
        )
        return replace(problem, blocks=blocks)

    def _remodelled(self, model: SegmentModel, segment: Segment, options: Options) -> SegmentModel:
        """The segment with its new sigmas, and nodes where the new noise wants them."""
        segment = replace(segment, start=model.segment.start)
        if self._odometry or options.node_spacing is not None:
            return replace(model, segment=segment)
        if options.node != "point":
            return replace(model, segment=segment, t=model_segment(segment, options).t)
        return replace(model, segment=segment, t=node_times(segment, options))

    def _evaluate(
        self,
        at: dict[str, float],
        *,
        start: FloatArray | None = None,
        least: float | None = None,
    ) -> float:
        """Logarithm of the likelihood; where it is above `least`, the best so far, it is kept."""
        self.evaluations += 1
        problem = self._problem(at)
        x = carried(self._layout, self._x, problem.layout) if start is None else start
        try:
            value, x = log_evidence(problem, x)
        except SolverError:
            return -np.inf
        for name, spread in SPREADS.items():
            if name in at:
                value -= 0.5 * ((at[name] - self._knobs[name].start) / spread) ** 2
        if value > (self.best if least is None else least):
            self.best, self.at, self._x, self._layout = value, at, x, problem.layout
        return value


def _resolved(segment: Segment) -> float:
    """What all ranges and fixes of a segment could tell of one place, m."""
    sigmas = [np.empty(0)]
    for rows in _ranges(segment):
        legs = 2.0 if isinstance(rows, TwoWayRange) else 1.0
        sigmas.append(NOMINAL_SPEED / legs * rows.sigma)
    if segment.position is not None:
        sigmas.append(np.sqrt(segment.position.covariances[:, 0, 0]))
    each = np.concatenate(sigmas)
    return float(1.0 / np.sqrt((1.0 / each**2).sum())) if len(each) else 1.0


def _modelled(mission: Mission) -> tuple[list[SegmentModel], list[list[Track]]]:
    """All segments' models and starts; a start prior that the ranges contradict is left out.

    Of a single segment all tracks that the search finds worth trying, one by one; of several the
    best of each.
    """
    models: list[SegmentModel] = []
    tracks: list[tuple[Track, ...]] = []
    for segment in mission.segments:
        model = model_segment(segment, mission.options)
        starts = find_tracks(mission, model)
        if starts.start_sigmas is not None and starts.start_sigmas >= START_LIMIT:
            model = replace(model, segment=replace(segment, start=None))
            starts = find_tracks(mission, model)
        models.append(model)
        tracks.append(starts.tracks)
    if len(models) == 1:
        return models, [[track] for track in tracks[0]]
    return models, [[some[0] for some in tracks]]


def _joined(models: Sequence[SegmentModel]) -> bool:
    """Whether odometry joins all nodes: then the motion prior has nothing to say."""
    for model in models:
        covered = np.zeros(len(model.t) - 1, dtype=np.bool_)
        for samples in (model.bottom, model.water):
            if samples is not None:
                covered |= samples.between(model.t[:-1], model.t[1:]).covered
        if not covered.all():
            return False
    return True


def _ranges(segment: Segment) -> list[TwoWayRange | OneWayRange]:
    both = (segment.two_way_range, segment.one_way_range)
    return [rows for rows in both if rows is not None and len(rows)]


def _scaled(segment: Segment, factor: float) -> Segment:
    """The segment with its travel times' sigmas multiplied."""
    if factor == 1.0:
        return segment
    two_way, one_way = segment.two_way_range, segment.one_way_range
    return replace(
        segment,
        two_way_range=None if two_way is None else replace(two_way, sigma=factor * two_way.sigma),
        one_way_range=None if one_way is None else replace(one_way, sigma=factor * one_way.sigma),
    )
