"""What solving a problem takes whoever asks: progress, times, warnings, and a look at rivals."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from time import perf_counter

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.assembly import direction
from ubl_graph.errors import SolverError
from ubl_graph.hypotheses import APART, COVERED_SIGMAS
from ubl_graph.layout import Chain
from ubl_graph.problem import Problem
from ubl_graph.solve.choice import Choice
from ubl_graph.solve.marginals import Covariances
from ubl_graph.solve.robust import robustly
from ubl_graph.solve.rounds import Engine, Solution, confirms, solve

#: A second track counts as no worse where its cost is higher by less than this: odds of 20 to 1.
AMBIGUOUS_COST = 3.0

#: Called with what is being done and how far the whole is, 0 to 1.
Progress = Callable[[str, float], None]


@dataclass
class Work:
    """What one call of a smoother gathers on its way."""

    max_iterations: int
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
        """Begin a part of the whole."""
        self._done, self._share = done, share

    def warn(self, segment: str, text: str) -> None:
        """Keep what a user should know, of a segment or of all."""
        self.warnings.append(f"{segment}: {text}" if segment else text)

    @contextmanager
    def stage(self, name: str) -> Generator[None]:
        """Time a stage."""
        self.tell(name, 0.0)
        begin = perf_counter()
        yield
        self.wall_times[name] = self.wall_times.get(name, 0.0) + perf_counter() - begin

    def tell(self, text: str, share: float) -> None:
        """Tell what is being done, and how much of this part is."""
        # Never backwards: a stage that begins knows less of the whole than the one that ended.
        self._told = max(self._told, self._done + self._share * share)
        if self.progress is not None:
            self.progress(text, self._told)

    def solve(self, engine: Engine, x: FloatArray) -> Solution:
        """Solve from `x`, and tell of each iteration."""

        def each(iteration: int, cost: float) -> None:
            # Nobody knows how many iterations are left; a bar that nears its end serves.
            self.tell(f"iteration {iteration}, cost {cost:.4g}", 1.0 - 0.85**iteration)

        return solve(engine, x, self.max_iterations, each)

    def solve_robustly(self, engine: Engine, x: FloatArray) -> list[Solution]:
        """Solve from `x`, and again where outliers leave doubt; the least cost first."""
        return robustly(lambda start: self.solve(engine, start), engine, x)


def confirmed(work: Work, choice: Choice, found: Solution) -> tuple[Solution, str, str]:
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


def rival_of(
    problem: Problem,
    best: Solution,
    marginals: Covariances,
    others: Sequence[Solution],
    chain: Chain,
) -> tuple[str | None, FloatArray | None, float | None]:
    """Another track of a segment that fits as well and that the covariance does not cover.

    Returns what to say of it, its positions at all nodes, and how much dearer the next best track
    elsewhere is, whether or not it fits as well.
    """
    runner_up: float | None = None
    sigma = np.sqrt(np.linalg.eigvalsh(marginals.of("position")[chain.nodes])[:, -1])
    covered = max(APART, COVERED_SIGMAS * float(np.sqrt(np.mean(sigma**2))))
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
