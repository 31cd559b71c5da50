"""A survey from a track that is not known beforehand: vehicle and beacons in one graph.

The track comes from odometry, DVL, compass and fixes, as `smooth` takes them, and from the ranges
to the very beacons. What is known of the beacons holds the map: a given standard deviation is a
prior. Where no fix and no start says where the map is, positions that were given without one are
held, as `smooth` holds them, and what is left of a survey is the check: each in turn is set free.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.beacon import Beacon
from ubl_graph.builder import SegmentModel
from ubl_graph.errors import ConfigurationError
from ubl_graph.factors.ranges import RangeBlock
from ubl_graph.graph import build_problem, model_segment
from ubl_graph.mission import Mission, Segment
from ubl_graph.mission_checks import RANGE_KINDS
from ubl_graph.pings import Pings
from ubl_graph.pose_initial import find_tracks
from ubl_graph.result import RangeResiduals
from ubl_graph.solve.banded import BandedEngine
from ubl_graph.solve.robust import robustly
from ubl_graph.survey.check import likelihood_checks
from ubl_graph.survey.model import Noise, SurveyOptions
from ubl_graph.survey.noise import robust_scale
from ubl_graph.survey.result import LeaveOneOut, SurveyResult
from ubl_graph.survey.solving import Estimate, whitened_ranges
from ubl_graph.track import Track, start_vector
from ubl_graph.work import Work

#: Standard deviation of what is held, m.
HELD_SIGMA = 1e-3
#: Beacons known within a sigma that a map without a fix hangs on; where all are held, one more,
#: for there must be as many when one is set free.
ANCHORS = 2
#: Ranges that scatter by more than so many times their sigmas have these widened.
WIDER = 1.1
#: The solution with all that was given, among those with one beacon free.
ALL = ""


class JointSurvey:
    """A survey in which the track is found together with the beacons.

    Parameters
    ----------
    work : Work
        Progress, times, warnings.
    mission : Mission
        What was measured.
    options : SurveyOptions
        Kept for the result: gradients and noise are for a known track.

    Raises
    ------
    ConfigurationError
        Where nothing says where the track is.
    """

    def __init__(self, work: Work, mission: Mission, options: SurveyOptions) -> None:
        self._work, self._options = work, options
        self._given, self._mission = mission, _free_scale(mission)
        heard = {str(n) for s in mission.segments for rows in _ranges(s) for n in rows.beacon}
        self._names = tuple(n for n in mission.beacon_names if n in heard)
        self._planar = mission.options.node == "pose2"
        known = [bool(b.sigma[:2].any()) for b in mission.beacons if b.name in heard]
        anchored = any(
            s.start is not None or (s.position is not None and len(s.position))
            for s in mission.segments
        )
        self._holds = not anchored and not any(known)
        if not anchored and sum(known) < ANCHORS and (any(known) or len(known) <= ANCHORS):
            raise ConfigurationError(
                "nothing says where the track is: there are no fixes at the ranges, no start, and "
                f"{sum(known)} of the {len(known)} beacons that were heard have a sigma",
                "give position fixes every second, a start, or a sigma to two beacons",
                field="data",
            )

    def run(self) -> SurveyResult:
        """Solve with all that was given, set each beacon free in turn, and settle.

        Raises
        ------
        SolverError
            Where a solver fails.
        """
        work = self._work
        with work.stage("start"):
            models = [model_segment(s, self._mission.options) for s in self._mission.segments]
            tracks = [find_tracks(self._mission, model).tracks[0] for model in models]
        with work.stage("solve"):
            trials, factor = self._trials(models, tracks), 1.0
            best = min(trials.values(), key=lambda t: t.cost)
            parts = whitened_ranges(best.problem, best.solution.x, best.solution.frozen)
            scatter = robust_scale(np.concatenate(parts))
            if scatter > WIDER:
                factor = scatter
                text = (
                    f"ranges scatter {factor:.1f} times as wide as their sigmas, which are widened"
                )
                work.warn("", text)
                models = [replace(m, segment=_widened(m.segment, factor)) for m in models]
                trials = self._trials(models, tracks, trials)
        check = likelihood_checks(
            [b for b in self._mission.beacons if b.name in trials],
            trials[ALL].cost,
            trials,
            components=2 if self._planar else 3 if self._holds else None,
        )
        for name in check.named:
            work.warn("", f"the given position of '{name}' disagrees with all else; left out")
        if self._holds:
            work.warn(
                "",
                "only the beacons' own positions say where the track is: they are held as given, "
                "and checked",
            )
        return self._result(trials[(*check.named, ALL)[0]], models, factor, check)

    def _trials(
        self,
        models: Sequence[SegmentModel],
        tracks: Sequence[Track],
        before: Mapping[str, Estimate] | None = None,
    ) -> dict[str, Estimate]:
        """Solutions with all that was given, and with each beacon free of which that is much.

        They begin at those `before`, where there are any.
        """
        trials: dict[str, Estimate] = {}
        names = [ALL, *(b.name for b in self._mission.beacons if self._is_given(b))]
        for number, name in enumerate(names):
            self._work.begin(number / len(names), 1.0 / len(names))
            mission = self._freed(name)
            problem = build_problem(mission, models)
            engine = BandedEngine(problem)
            begin = start_vector(mission, problem.layout, tracks)
            solve = partial(self._work.solve, engine)
            if before is not None:
                found = [solve(before[name].solution.x)]
            else:
                found = robustly(solve, engine, begin)
                if trials:
                    found.append(solve(trials[ALL].solution.x))
            trials[name] = Estimate(problem, min(found, key=lambda s: s.cost))
        return trials

    def _is_given(self, beacon: Beacon) -> bool:
        return beacon.name in self._names and (self._holds or bool(beacon.sigma[:2].any()))

    def _freed(self, name: str) -> Mission:
        """The mission with all beacons as given but one, which is free."""
        beacons = tuple(replace(b, sigma=self._sigma(b, name)) for b in self._mission.beacons)
        options = replace(self._mission.options, estimate_beacons=True)
        return replace(self._mission, beacons=beacons, options=options)

    def _sigma(self, beacon: Beacon, free: str) -> FloatArray:
        """Standard deviations of a beacon's prior, m; 0 is none."""
        sigma = np.array(beacon.sigma)
        if self._holds or beacon.name not in self._names:
            sigma = np.where(sigma > 0.0, sigma, HELD_SIGMA)
        if beacon.name == free:
            sigma = np.zeros(3)
        if self._planar:
            sigma[2] = HELD_SIGMA
        return sigma

    def _result(
        self,
        final: Estimate,
        models: Sequence[SegmentModel],
        factor: float,
        check: LeaveOneOut,
    ) -> SurveyResult:
        by_name = {model.segment.name: model.segment for model in models}
        blocks = [b for b in final.problem.blocks if isinstance(b, RangeBlock)]
        pings: list[Pings] = [getattr(by_name[b.chain], b.name) for b in blocks]
        tables = final.residuals(pings)
        names = check.named if self._holds else self._names
        status, reason = final.status(names, pings)
        walk = self._mission.options.number("sound_speed_walk")
        return SurveyResult(
            self._given,
            self._options,
            "joint",
            names,
            *final.beacons(names),
            {},
            final.range_bias(self._names),
            RangeResiduals.joined(tables),
            np.concatenate([np.full(len(b), b.chain) for b in blocks]),
            final.problem.layout.positions(final.solution.x),
            Noise(factor, walk),
            check,
            status,
            reason,
        )


def _ranges(segment: Segment) -> list[Pings]:
    records = [getattr(segment, kind) for kind in RANGE_KINDS]
    return [rows for rows in records if rows is not None and len(rows)]


def _widened(segment: Segment, factor: float) -> Segment:
    """The segment with the sigmas of all ranges multiplied."""
    changed: Mapping[str, Pings] = {
        kind: replace(rows, sigma=factor * rows.sigma)
        for kind in RANGE_KINDS
        if (rows := getattr(segment, kind)) is not None
    }
    return replace(segment, **changed)


def _free_scale(mission: Mission) -> Mission:
    """The mission with a common scale of all ranges as an unknown.

    A wrong sound speed moves all beacons apart. Were it not free, the one whose place the others
    hold the least would seem to be off.
    """
    options = mission.options.settled
    if not options.estimate_sound_speed:
        options = replace(options, estimate_sound_speed=True, sound_speed_walk=0.0)
    return replace(mission, options=options)
