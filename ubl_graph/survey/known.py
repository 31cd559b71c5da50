"""A survey from a track that is known: the ranges of all segments in one small problem."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.mission import Mission, Segment
from ubl_graph.mission_checks import RANGE_KINDS
from ubl_graph.pings import Pings, leg_times
from ubl_graph.problem import Problem
from ubl_graph.result import RangeResiduals
from ubl_graph.solve.banded import BandedEngine
from ubl_graph.survey.check import distance_checks
from ubl_graph.survey.model import Noise, SurveyModel, SurveyOptions, SurveyPings
from ubl_graph.survey.noise import likeliest_noise
from ubl_graph.survey.result import LeaveOneOut, SurveyResult
from ubl_graph.survey.solving import Estimate, approach, typical_range
from ubl_graph.survey.track import FixTrack
from ubl_graph.work import AMBIGUOUS_COST, COVERED_SIGMAS, Work

#: A track that strays from a straight line by less than this share of the typical range may have
#: its beacons on either side.
STRAIGHT_SHARE = 0.1


def known_pings(mission: Mission) -> tuple[list[SurveyPings], int]:
    """The ranges at whose every leg fixes say where the transducer is, and how many are not so."""
    parts: list[SurveyPings] = []
    lost = 0
    for segment in mission.segments:
        track = FixTrack(segment, mission.vehicle)
        for kind in RANGE_KINDS:
            pings = getattr(segment, kind)
            if pings is None or not len(pings):
                continue
            times = leg_times(pings)
            position, variance, known = track.at(times.ravel())
            whole = known.reshape(times.shape).all(axis=1)
            lost += int((~whole).sum())
            if whole.any():
                place = position.reshape(*times.shape, 3)[whole]
                spread = variance.reshape(*times.shape, 3)[whole]
                parts.append(SurveyPings(segment.name, pings[whole], place, spread))
    return parts, lost


def range_count(segments: Sequence[Segment]) -> int:
    """Ranges of some segments."""
    records = [getattr(s, kind) for s in segments for kind in RANGE_KINDS]
    return sum(len(r) for r in records if r is not None)


class KnownSurvey:
    """A survey from a known track.

    Parameters
    ----------
    work : Work
        Progress, times, warnings.
    mission : Mission
        Beacons, sound speed, options.
    pings : sequence of SurveyPings
        All ranges.
    options : SurveyOptions
        What is estimated.
    """

    def __init__(
        self, work: Work, mission: Mission, pings: Sequence[SurveyPings], options: SurveyOptions
    ) -> None:
        self._work, self._mission, self._options = work, mission, options
        self._model = SurveyModel(mission, pings, options)
        self._pings: list[Pings] = [p.pings for p in self._model.pings]

    def run(self) -> SurveyResult:
        """Solve without priors, find the noise, check what was given, and solve with it.

        Raises
        ------
        SolverError
            Where a solver fails.
        """
        work, model = self._work, self._model
        with work.stage("solve"):
            alone = self._solve(model.problem(model.noise, {}), model.start())
        noise = model.noise
        if self._options.fit_noise:
            with work.stage("noise"):
                noise, why = likeliest_noise(model, alone.problem, alone.solution)
            if why:
                work.warn("", why)
        with work.stage("solve"):
            x = alone.solution.x
            alone = self._solve(model.problem(noise, {}, model.beacons_at(x)), x)
            alone, rival = self._mirrored(alone)
        check = distance_checks(self._mission, model.names, *alone.beacons(model.names))
        final = alone
        sigmas = {b.name: b.sigma for b in self._mission.beacons if b.name not in check.named}
        if any(sigmas[name].any() for name in model.names if name in sigmas):
            with work.stage("solve"):
                x = alone.solution.x
                final = self._solve(model.problem(noise, sigmas, model.beacons_at(x)), x)
                final, rival = self._mirrored(final)
        for name in check.named:
            work.warn("", f"the given position of '{name}' disagrees with its ranges; left out")
        return self._result(final, noise, check, rival)

    def _solve(self, problem: Problem, x: FloatArray) -> Estimate:
        engine = BandedEngine(problem)
        begin = approach(engine, x, [p.beacon for p in self._pings])
        return Estimate(problem, self._work.solve(engine, begin))

    def _mirrored(self, alone: Estimate) -> tuple[Estimate, str]:
        """The cheaper of a solution and its mirror image in a track that is all but straight.

        The second value says so where both fit as well, and is empty else.
        """
        model = self._model
        track = np.concatenate([p.position.reshape(-1, 3)[:, :2] for p in model.pings])
        middle = track.mean(axis=0)
        spread, axes = np.linalg.eigh((track - middle).T @ (track - middle) / len(track))
        if np.sqrt(max(spread[0], 0.0)) > STRAIGHT_SHARE * typical_range(self._pings):
            return alone, ""
        across = axes[:, 0]
        places: dict[str, FloatArray] = {}
        for name, place in model.beacons_at(alone.solution.x).items():
            off = float((place[:2] - middle) @ across)
            places[name] = place - np.append(2.0 * off * across, 0.0)
        problem = alone.problem
        engine = BandedEngine(problem)
        image = Estimate(problem, self._work.solve(engine, model.start(places)))
        best, other = (alone, image) if alone.cost <= image.cost else (image, alone)
        position, covariance = best.beacons(model.names)
        apart = np.linalg.norm(other.beacons(model.names)[0] - position, axis=1).max()
        blocks = [covariance[i : i + 3, i : i + 3] for i in range(0, len(covariance), 3)]
        sigma = np.sqrt(max(np.linalg.eigvalsh(block)[-1] for block in blocks))
        if other.cost - best.cost > AMBIGUOUS_COST or apart < COVERED_SIGMAS * sigma:
            return best, ""
        return best, (
            f"ambiguous: the track is straight, and beacons mirrored in it, {apart:.0f} m away, "
            "fit as well; a line across, or positions given with a sigma, would tell"
        )

    def _result(
        self, final: Estimate, noise: Noise, check: LeaveOneOut, rival: str
    ) -> SurveyResult:
        model = self._model
        status, reason = final.status(model.names, self._pings)
        if rival and status == "converged":
            status, reason = "unobservable", rival
        tables = final.residuals(self._pings)
        segments = [np.full(len(t), p.segment) for t, p in zip(tables, model.pings, strict=True)]
        return SurveyResult(
            self._mission,
            self._options,
            "known track",
            model.names,
            *final.beacons(model.names),
            final.slow(model.chain.t),
            final.range_bias(model.names),
            RangeResiduals.joined(tables),
            np.concatenate(segments),
            np.concatenate([p.position[:, 0] for p in model.pings]),
            noise,
            check,
            status,
            reason,
        )
