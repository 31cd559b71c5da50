"""smooth(mission) -> Result: the main path.

A segment is modelled, its start is found, its graph solved, its covariances taken. Segments that
share nothing are solved one by one: one that the data leave open does not harm the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from ubl_graph.arrays import FloatArray
from ubl_graph.assembly import assemble_segment, beacons_of, shared_of
from ubl_graph.builder import SegmentModel
from ubl_graph.consistency import assess, calibrated, inflated
from ubl_graph.graph import build_problem, model_segment, shares_unknowns
from ubl_graph.hypotheses import Basin, judge, settled, weigh
from ubl_graph.initial import START_LIMIT, Starts
from ubl_graph.mission import Mission
from ubl_graph.pose_initial import find_tracks
from ubl_graph.problem import Problem
from ubl_graph.result import Result, SegmentResult, Shared
from ubl_graph.solve.choice import choose
from ubl_graph.solve.marginals import Marginals, shared_covariance
from ubl_graph.solve.rounds import Engine, Solution
from ubl_graph.track import mirror_images, place, start_vector, track_of, unanchored
from ubl_graph.tuning import Tuning, tuned
from ubl_graph.work import Progress, Work, confirmed

#: Costs nearer than this are equal: two engines, or machines, round differently.
SAME_COST = 1e-6
#: Mirror images of an answer are solved from, and so often of a better one that they lead to.
MIRRORINGS = 3
#: A profile may end so much above the deepest beacon, as a share of its depth.
PROFILE_SLACK = 0.1
#: Outliers are a few per cent; where a fifth of the pings disagree, something else is wrong.
SUSPICIOUS_SHARE = 0.2
#: Sigmas would have to be twice too small to explain this.
SUSPICIOUS_CHI_SQUARE = 4.0


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
    work = _Work(mission.options.max_iterations, progress, mission=mission)
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
    result = Result(
        mission, tuple(segments), beacons, shared, tuple(work.warnings), work.wall_times, tuning
    )
    return _mended(work, result)


def _mended(work: _Work, result: Result) -> Result:
    """The result with what the options ask of held-out pings."""
    options = result.mission.options
    if options.noise == "inflated":
        with work.stage("held-out"):
            found = assess(result)
            mission = inflated(result.mission, found)
        mission = replace(mission, options=replace(mission.options, noise="given"))
        return _told_of_both(result, replace(smooth(mission, work.progress), inflation=found))
    if options.covariance == "calibrated":
        with work.stage("held-out"):
            return calibrated(result)
    return result


def _told_of_both(first: Result, second: Result) -> Result:
    """The second of two solves, with what should be known of the first."""
    names = dict.fromkeys([*first.wall_times, *second.wall_times])
    times = {n: first.wall_times.get(n, 0.0) + second.wall_times.get(n, 0.0) for n in names}
    warnings = tuple(dict.fromkeys([*first.warnings, *second.warnings]))
    return replace(second, tuning=first.tuning, warnings=warnings, wall_times=times)


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
        expected = _expected(work, problem, [s for _, s in searched])
        basins, solver = _solved(work, problem, group, [s for _, s in searched])
    solution = basins[0].solution
    with work.stage("covariance"):
        marginals = Marginals(problem, solution)
        results: list[SegmentResult] = []
        by_model = zip(group, (starts for _, starts in searched), strict=True)
        for chain, (model, starts) in zip(problem.layout.chains, by_model, strict=True):
            verdict = judge(problem, basins, marginals, chain, work.mission.options)
            runner_up, reason = verdict.runner_up, verdict.reason
            if runner_up is None:
                runner_up = starts.runner_up
            if len(group) == 1:
                reason = unanchored(model) or reason
            results.append(
                assemble_segment(
                    problem,
                    solution,
                    marginals,
                    chain,
                    model,
                    reason,
                    verdict.rival,
                    number,
                    solver,
                    runner_up,
                    work.mission.options,
                    hypotheses=verdict.hypotheses,
                    pruned=verdict.pruned,
                )
            )
        return results, shared_of(problem, solution, marginals, expected)


def _expected(work: _Work, problem: Problem, starts: Sequence[Starts]) -> FloatArray | None:
    """How well the geometry of the start promises to tell what all nodes share."""
    if not problem.layout.shared:
        return None
    begin = start_vector(work.mission, problem.layout, [s.tracks[0] for s in starts])
    return shared_covariance(problem, begin)


def _solved(
    work: _Work, problem: Problem, group: Sequence[SegmentModel], starts: Sequence[Starts]
) -> tuple[list[Basin], str]:
    """The distinct solutions that were found, the answer first, and who solved it.

    They are looked for from the best start, from rivals of each segment, and from mirror images of
    the cheapest solution and of the heaviest.
    """
    choice = choose(problem, work.mission.options.solver)
    solutions = _solve_from(work, choice.scout, problem, starts)
    basins = weigh(problem, _ranked(solutions))
    mirrored: list[Solution] = []
    for _ in range(MIRRORINGS):
        fresh = [basins[0].solution, _ranked(solutions)[0]]
        fresh = [s for k, s in enumerate(fresh) if not any(s is t for t in [*mirrored, *fresh[:k]])]
        images = [x for s in fresh for x in _images(work, problem, group, s)]
        if not images:
            break
        mirrored += fresh
        solutions += [work.solve(choice.scout, x) for x in images]
        basins = weigh(problem, _ranked(solutions))
    best, solver, note = confirmed(work, choice, basins[0].solution)
    for text in filter(None, (choice.note, note)):
        work.warn(group[0].segment.name if len(group) == 1 else "", text)
    return settled(basins, best), solver


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
    work: _Work, engine: Engine, problem: Problem, starts: Sequence[Starts]
) -> list[Solution]:
    """Solve from the best starts, and from each rival start of a segment."""
    begin = start_vector(work.mission, problem.layout, [s.tracks[0] for s in starts])
    solutions = work.solve_robustly(engine, begin)
    if len(starts) == 1:
        rivals = [start_vector(work.mission, problem.layout, [t]) for t in starts[0].tracks[1:]]
    else:
        rivals = _each_elsewhere(problem, starts, solutions[0])
    return solutions + [work.solve(engine, x) for x in rivals]


def _each_elsewhere(
    problem: Problem, starts: Sequence[Starts], found: Solution
) -> list[FloatArray]:
    """A solution of several segments with one of them at a rival start; flat vectors."""
    vectors: list[FloatArray] = []
    for chain, each in zip(problem.layout.chains, starts, strict=True):
        for track in each.tracks[1:]:
            x = found.x.copy()
            place(problem.layout, chain, track, x)
            vectors.append(x)
    return vectors


def _ranked(solutions: Sequence[Solution]) -> list[Solution]:
    """The cheapest first."""
    # Mirror images cost the same but for rounding: of equals the first stays the answer.
    least = min(s.cost for s in solutions)
    best = next(s for s in solutions if s.cost <= least + SAME_COST)
    return [best, *sorted((s for s in solutions if s is not best), key=lambda s: s.cost)]


def _images(
    work: _Work, problem: Problem, group: Sequence[SegmentModel], found: Solution
) -> list[FloatArray]:
    """A solution with one segment's track mirrored, in each way that there is; flat vectors."""
    images: list[FloatArray] = []
    for chain, model in zip(problem.layout.chains, group, strict=True):
        if unanchored(model) is not None:
            continue
        track = track_of(problem.layout, chain, found.x)
        for image in mirror_images(work.mission, model, track):
            x = found.x.copy()
            place(problem.layout, chain, image, x)
            images.append(x)
    return images


@dataclass
class _Work(Work):
    """What one call of `smooth` gathers on its way, with the mission as it stands."""

    mission: Mission = field(kw_only=True)
