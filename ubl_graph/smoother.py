"""smooth(mission) -> Result: the main path.

A segment is modelled, its start is found, its graph solved, its covariances taken. Segments that
share nothing are solved one by one: one that the data leave open does not harm the others.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from time import perf_counter

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.assembly import assemble_segment, beacons_of, direction, shared_of
from ubl_graph.builder import SegmentModel
from ubl_graph.errors import SolverError
from ubl_graph.graph import build_problem, model_segment, shares_unknowns
from ubl_graph.initial import START_LIMIT, Starts
from ubl_graph.layout import Chain
from ubl_graph.mission import Mission
from ubl_graph.pose_initial import find_tracks
from ubl_graph.problem import Problem
from ubl_graph.result import DOWN_WEIGHTED, Result, SegmentResult, Shared
from ubl_graph.solve.choice import Choice, choose
from ubl_graph.solve.marginals import Marginals
from ubl_graph.solve.rounds import Engine, Solution, confirms, graduated, solve
from ubl_graph.track import mirror_images, place, start_vector, track_of, unanchored
from ubl_graph.tuning import Tuning, tuned

#: A second track counts as no worse where its cost is higher by less than this: odds of 20 to 1.
AMBIGUOUS_COST = 3.0
#: Costs nearer than this are equal: two engines, or machines, round differently.
SAME_COST = 1e-6
#: A second track nearer than so many standard deviations is the same flat valley, not a rival.
COVERED_SIGMAS = 3.0
#: Where more pings than this are down-weighted, a graduated solve is tried as well.
DOUBTFUL_SHARE = 0.01
#: A profile may end so much above the deepest beacon, as a share of its depth.
PROFILE_SLACK = 0.1
#: Outliers are a few per cent; where a fifth of the pings disagree, something else is wrong.
SUSPICIOUS_SHARE = 0.2
#: Sigmas would have to be twice too small to explain this.
SUSPICIOUS_CHI_SQUARE = 4.0

#: Called with what is being done and how far the whole is, 0 to 1.
Progress = Callable[[str, float], None]


def smooth(mission: Mission, progress: Progress | None = None) -> Result:
    """Smooth a mission: the most probable trajectory given all its records, and how sure it is.

    Parameters
    ----------
    mission : Mission
        From `load_mission`, or made in Python.
    progress : callable, optional
        Called now and then with a text and the share done; `ubl-graph smooth` draws a bar by it.

    Returns
    -------
    Result
        With status "unobservable" and the reason where the data leave the track open.

    Raises
    ------
    DataError
        Where the records do not make sense together.
    SolverError
        Where a solver fails on data that are sound.

    Examples
    --------
    >>> from ubl_graph.sim import straight_pass
    >>> mission, truth = straight_pass(seed=1)
    >>> result = smooth(mission)
    >>> result.status
    'converged'
    """
    work = _Work(mission, progress)
    tuning = _tune(work)
    mission = work.mission
    _judge_profile(work)
    with work.stage("model"):
        models = [model_segment(segment, mission.options) for segment in mission.segments]
    groups = [models] if shares_unknowns(mission, models) else [[model] for model in models]
    segments: list[SegmentResult] = []
    shared: dict[str, Shared] = {}
    for number, group in enumerate(groups):
        work.begin(number / len(groups), 1.0 / len(groups))
        results, unknowns = _smooth_group(work, group, number)
        segments += results
        shared |= unknowns
    for segment in segments:
        _judge(work, segment)
    beacons = beacons_of(mission, shared)
    shared = {name: s for name, s in shared.items() if not name.startswith("beacon ")}
    return Result(
        mission, tuple(segments), beacons, shared, tuple(work.warnings), work.wall_times, tuning
    )


def _tune(work: _Work) -> Tuning | None:
    """Put numbers where the options say "auto"."""
    automatic = work.mission.options.automatic
    if not automatic:
        return None
    with work.stage("noise"):
        work.mission, tuning = tuned(work.mission, lambda share: work.tell("noise", share))
    work.reset()
    done = set(tuning.chosen)
    if "motion" in done:
        # The noise of the prior that was not taken was searched too, and is of no use.
        done |= {"acceleration_psd", "jerk_psd"}
    left = [name for name in automatic if name not in done]
    if left:
        why = tuning.trouble or "it does not apply, or nothing in the data speaks for a number"
        work.warn("", f'{", ".join(left)} = "auto": the default stands; {why}')
    return tuning


def _judge_profile(work: _Work) -> None:
    """Warn where the sound-speed profile ends well above the deepest beacon."""
    profile = work.mission.sound_speed
    deepest = max((-float(b.position[2]) for b in work.mission.beacons), default=0.0)
    last = float(profile.depth[-1])
    if not profile.is_constant and deepest > last + PROFILE_SLACK * deepest:
        work.warn(
            "",
            f"the sound-speed profile ends at {last:g} m, the deepest beacon is at {deepest:g} m; "
            "the last gradient was continued",
        )


def _judge(work: _Work, segment: SegmentResult) -> None:
    """Warn of what does not stop a solver but should stop a user."""
    residuals = segment.residuals
    if residuals is not None:
        share = float(residuals.down_weighted.mean())
        if share > SUSPICIOUS_SHARE:
            # Distances know no sound speed; whoever measured them may have taken a wrong one.
            scale = "the ranges' scale" if (residuals.kind == "slant").all() else "sound speed"
            work.warn(
                segment.name,
                f"{100 * share:.0f} % of the pings are down-weighted; check beacons, {scale}, "
                "sigmas and the start before trusting this track",
            )
        blind = int((~residuals.found).sum())
        if blind:
            work.warn(
                segment.name,
                f"{blind} pings have no direct ray at the estimate; a straight line stands in "
                "(column direct_ray of residuals.csv)",
            )
    ratio = segment.chi_square / max(segment.degrees_of_freedom, 1)
    if ratio > SUSPICIOUS_CHI_SQUARE:
        work.warn(
            segment.name,
            f"chi-square per degree of freedom is {ratio:.1f}: the data contradict each other or "
            "their sigmas are too small",
        )


def _smooth_group(
    work: _Work, group: Sequence[SegmentModel], number: int
) -> tuple[list[SegmentResult], dict[str, Shared]]:
    """Solve segments that share unknowns (most often a single one) in one problem."""
    with work.stage("start"):
        searched = [_search(work, model) for model in group]
    group = [model for model, _ in searched]
    with work.stage("solve"):
        problem = build_problem(work.mission, group)
        solution, rivals, solver = _solved(work, problem, group, [s for _, s in searched])
    with work.stage("covariance"):
        marginals = Marginals(problem, solution)
        results: list[SegmentResult] = []
        by_model = zip(group, (starts for _, starts in searched), strict=True)
        for chain, (model, starts) in zip(problem.layout.chains, by_model, strict=True):
            rival, track, runner_up = _rival(problem, solution, marginals, rivals, chain)
            if runner_up is None:
                runner_up = starts.runner_up
            if len(group) == 1:
                rival = unanchored(model) or rival
            results.append(
                assemble_segment(
                    problem,
                    solution,
                    marginals,
                    chain,
                    model,
                    rival,
                    track,
                    number,
                    solver,
                    runner_up,
                    work.mission.options,
                )
            )
        return results, shared_of(problem, solution, marginals)


def _solved(
    work: _Work, problem: Problem, group: Sequence[SegmentModel], starts: Sequence[Starts]
) -> tuple[Solution, list[Solution], str]:
    """The best solution, the others that were found, and who solved it."""
    choice = choose(problem, work.mission.options.solver)
    best, others = _solve_from(work, choice.scout, group, starts)
    best, solver, note = _confirmed(work, choice, best)
    for text in filter(None, (choice.note, note)):
        work.warn(group[0].segment.name if len(group) == 1 else "", text)
    return best, others, solver


def _search(work: _Work, model: SegmentModel) -> tuple[SegmentModel, Starts]:
    """Find a segment's start; a start prior that all pings contradict is left out, and said."""
    starts = find_tracks(work.mission, model)
    if starts.start_sigmas is None or starts.start_sigmas < START_LIMIT:
        return model, starts
    work.warn(
        model.segment.name,
        f"the start prior lies {starts.start_sigmas:.0f} sigma from where the ranges put the "
        "vehicle; it was left out",
    )
    model = replace(model, segment=replace(model.segment, start=None))
    return model, find_tracks(work.mission, model)


def _solve_from(
    work: _Work, engine: Engine, group: Sequence[SegmentModel], starts: Sequence[Starts]
) -> tuple[Solution, list[Solution]]:
    """Solve from the best start, from the rivals of a single segment, and from mirror images.

    Returns the cheapest solution, and the others, cheapest first.
    """
    problem = engine.problem
    begin = start_vector(work.mission, problem.layout, [s.tracks[0] for s in starts])
    solutions = [work.solve(engine, begin)]
    if _down_weighted(problem, solutions[0]) > DOUBTFUL_SHARE:
        solutions.append(work.solve(engine, graduated(engine, begin)))
        solutions.sort(key=lambda s: s.cost)
    layout = problem.layout
    starts_at: list[FloatArray] = []
    if len(group) == 1:
        rivals = starts[0].tracks[1:]
        starts_at += [start_vector(work.mission, layout, [track]) for track in rivals]
    for chain, model in zip(layout.chains, group, strict=True):
        if unanchored(model) is None:
            found = track_of(layout, chain, solutions[0].x)
            for image in mirror_images(work.mission, model, found):
                x = solutions[0].x.copy()
                place(layout, chain, image, x)
                starts_at.append(x)
    solutions += [work.solve(engine, x) for x in starts_at]
    # Mirror images cost the same but for rounding: of equals the first stays the answer.
    least = min(s.cost for s in solutions)
    best = next(s for s in solutions if s.cost <= least + SAME_COST)
    return best, sorted((s for s in solutions if s is not best), key=lambda s: s.cost)


def _confirmed(work: _Work, choice: Choice, found: Solution) -> tuple[Solution, str, str]:
    """The scout's answer, shown to the other engine.

    Returns the answer that counts, who gave it, and what a user should know of that.
    """
    scout, last = choice.scout, choice.last
    if last is scout or not found.converged:
        return found, scout.name, ""
    try:
        if confirms(last, found):
            return found, f"{scout.name}, confirmed by {last.name}", ""
        again = work.solve(last, found.x)
    except SolverError as error:
        note = f"{last.name} could not confirm the answer of {scout.name}: {error}"
        return found, scout.name, note
    return replace(again, iterations=found.iterations + again.iterations), last.name, ""


def _down_weighted(problem: Problem, solution: Solution) -> float:
    """Share of the robust rows that count for less than half."""
    weights = [
        problem.loss.weights(block.evaluate(solution.x, held, jacobian=False)[0])[:, 0]
        for block, held in zip(problem.blocks, solution.frozen, strict=True)
        if block.robust
    ]
    return float((np.concatenate(weights) < DOWN_WEIGHTED).mean()) if weights else 0.0


def _rival(
    problem: Problem,
    best: Solution,
    marginals: Marginals,
    others: Sequence[Solution],
    chain: Chain,
) -> tuple[str | None, FloatArray | None, float | None]:
    """Another track of a segment that fits as well and that the covariance does not cover.

    Returns what to say of it, its positions at all nodes, and how much dearer the next best track
    elsewhere is, whether or not it fits as well.
    """
    runner_up: float | None = None
    sigma = np.sqrt(np.linalg.eigvalsh(marginals.of("position")[chain.nodes])[:, -1])
    covered = max(1.0, COVERED_SIGMAS * float(np.sqrt(np.mean(sigma**2))))
    for other in others:
        here, there = (problem.layout.positions(s.x)[chain.nodes] for s in (best, other))
        gap = here - there
        apart = float(np.sqrt(np.mean(np.sum(gap**2, axis=1))))
        extra = max(other.cost - best.cost, 0.0)
        if apart <= covered:
            continue
        runner_up = extra if runner_up is None else runner_up
        if extra < AMBIGUOUS_COST:
            along = direction(np.linalg.eigh(gap.T @ gap)[1][:, -1])
            text = (
                f"ambiguous: another track, {apart:.0f} m away (rms, mostly {along}), fits as well "
                f"(its cost is {extra:.2g} higher); a start, a fix, a turn or a second beacon off "
                "the line would tell"
            )
            return text, problem.layout.positions(other.x), runner_up
    return None, None, runner_up


@dataclass
class _Work:
    """What one call of `smooth` gathers on its way."""

    mission: Mission
    progress: Progress | None
    warnings: list[str] = field(default_factory=list[str])
    wall_times: dict[str, float] = field(default_factory=dict[str, float])
    _done: float = 0.0
    _share: float = 1.0
    _told: float = 0.0

    def reset(self) -> None:
        """Count progress from the beginning."""
        self._told = 0.0

    def begin(self, done: float, share: float) -> None:
        self._done, self._share = done, share

    def warn(self, segment: str, text: str) -> None:
        self.warnings.append(f"{segment}: {text}" if segment else text)

    @contextmanager
    def stage(self, name: str) -> Generator[None]:
        """Time a stage."""
        self.tell(name, 0.0)
        begin = perf_counter()
        yield
        self.wall_times[name] = self.wall_times.get(name, 0.0) + perf_counter() - begin

    def tell(self, text: str, share: float) -> None:
        # Never backwards: a stage that begins knows less of the whole than the one that ended.
        self._told = max(self._told, self._done + self._share * share)
        if self.progress is not None:
            self.progress(text, self._told)

    def solve(self, engine: Engine, x: FloatArray) -> Solution:
        most = self.mission.options.max_iterations

        def each(iteration: int, cost: float) -> None:
            # Nobody knows how many iterations are left; a bar that nears its end serves.
            self.tell(f"iteration {iteration}, cost {cost:.4g}", 1.0 - 0.85**iteration)

        return solve(engine, x, most, each)
