"""Tracks that the data allow: which solutions are distinct, and how likely each of them is.

Every minimum of the cost that was found is a basin of the posterior. With the cost C at the minimum
and H = J'J there, Laplace's approximation of the mass of a basin is

    log mass = -C - 1/2 log det H + constant

(`ubl_graph.solve.evidence`), which weighs all of them by normal noise and tells outliers at each of
them by the same rule. The masses, divided by their sum, are the posterior weights. Minima that were
not found have none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.assembly import direction, trajectory_of
from ubl_graph.errors import SolverError
from ubl_graph.layout import Chain
from ubl_graph.options import Options
from ubl_graph.problem import Problem
from ubl_graph.result import Hypothesis
from ubl_graph.solve.marginals import Covariances, Marginals
from ubl_graph.solve.rounds import Solution
from ubl_graph.steadiness import log_mass

#: An answer holds from this weight on: it is wrong once in twenty times at the most.
HOLDS = 0.95
#: A hypothesis of less weight than this is not kept: odds of a thousand to one.
KEPT = 1e-3
#: Two tracks that are nowhere farther apart than this, m, or than so many standard deviations, are
#: one.
APART, COVERED_SIGMAS = 1.0, 3.0
#: What a reason begins with where another track fits.
ANOTHER = "ambiguous: another track"
#: Logarithms of masses are worked out to about this; of equals the first stays the answer.
SAME_MASS = 0.02
#: So many solutions are weighed, the cheapest first; the others count by their cost.
MOST_WEIGHED = 8
#: The same for solutions that are dearer than the cheapest by more than this: their residuals alone
#: speak against them by 20 000 to 1. (Of two pings a circle about one beacon, the other ping taken
#: for an outlier, has a large mass, and nobody would go there.)
WORTH_WEIGHING = 10.0


@dataclass(frozen=True, eq=False)
class Basin:
    """A minimum of the cost, and how much of the posterior belongs to it.

    Attributes
    ----------
    solution : Solution
        The minimum.
    log_mass : float
        Logarithm of the mass, but for a constant of the data.
    """

    solution: Solution
    log_mass: float


@dataclass(frozen=True, eq=False)
class Verdict:
    """What is to be said of a segment's hypotheses.

    Attributes
    ----------
    hypotheses : tuple of Hypothesis
        The answer first, then the heaviest.
    pruned : float
        Weight of those that were left out.
    rival : array, shape (nodes of the problem, 3), or None
        Positions of the heaviest other track, where the answer does not hold.
    reason : str or None
        What to say of it.
    runner_up : float or None
        How much dearer the next best track elsewhere is.
    """

    hypotheses: tuple[Hypothesis, ...]
    pruned: float
    rival: FloatArray | None
    reason: str | None
    runner_up: float | None


def weigh(problem: Problem, solutions: Sequence[Solution]) -> list[Basin]:
    """Distinct minima among solutions with their masses: the answer first, then the cheapest.

    The answer is the heaviest; of equals the first that was given.

    Parameters
    ----------
    problem : Problem
        Whose minima.
    solutions : sequence of Solution
        At least one. Some may be the same minimum.
    """
    distinct = _distinct(problem, solutions)
    if len(distinct) == 1:
        return [Basin(distinct[0], 0.0)]
    basins = _weighed(problem, distinct)
    most = max(b.log_mass for b in basins)
    heaviest = next(b for b in basins if b.log_mass >= most - SAME_MASS)
    return [heaviest, *(b for b in basins if b is not heaviest)]


def _distinct(problem: Problem, solutions: Sequence[Solution]) -> list[Solution]:
    kept: list[Solution] = []
    for solution in solutions:
        if all(_farthest(problem, solution.x, other.x) > APART for other in kept):
            kept.append(solution)
    return kept


def _farthest(problem: Problem, a: FloatArray, b: FloatArray) -> float:
    """How far apart two estimates are (rms over the nodes of a chain), in the worst chain, m."""
    gap = problem.layout.positions(a) - problem.layout.positions(b)
    return max(_rms(gap[chain.nodes]) for chain in problem.layout.chains)


def _rms(gap: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(gap**2, axis=1))))


def _weighed(problem: Problem, solutions: Sequence[Solution]) -> list[Basin]:
    """Masses; where one cannot be worked out all of them go by their costs."""
    cheapest = min(s.cost for s in solutions)
    cheap = sorted((s for s in solutions if s.cost < cheapest + WORTH_WEIGHING), key=_cost)
    weighed: list[tuple[Solution, float, FloatArray]] = []
    for solution in cheap[:MOST_WEIGHED]:
        try:
            mass, x = log_mass(problem, solution.x)
        except SolverError:
            mass, x = -np.inf, solution.x
        if not np.isfinite(mass):
            return [Basin(s, -s.cost) for s in solutions]
        # Without the outliers' pull a shallow minimum may run out into another one.
        if all(_farthest(problem, x, other) > APART for _, _, other in weighed):
            weighed.append((solution, mass, x))
    first, mass, _ = weighed[0]
    done = {id(s): m for s, m, _ in weighed}
    tried = {id(s) for s in cheap[:MOST_WEIGHED]}
    return [
        Basin(s, done.get(id(s), mass + first.cost - s.cost))
        for s in solutions
        if id(s) in done or id(s) not in tried
    ]


def _cost(solution: Solution) -> float:
    return solution.cost


def judge(
    problem: Problem,
    basins: Sequence[Basin],
    marginals: Covariances,
    chain: Chain,
    options: Options,
) -> Verdict:
    """Weigh the tracks of one segment against each other.

    Tracks that the answer's covariance covers are the answer: the same minimum, or the same flat
    valley. So are those that differ in another segment alone.

    Parameters
    ----------
    problem : Problem
        Solved.
    basins : sequence of Basin
        From `weigh`, the answer first.
    marginals : Covariances
        Of the answer.
    chain : Chain
        The segment's nodes.
    options : Options
        Of the mission.
    """
    answer = basins[0]
    elsewhere = _elsewhere(problem, basins, marginals, chain)
    rivals = sorted(elsewhere, key=lambda b: -b.log_mass)
    masses = np.array([answer.log_mass, *(b.log_mass for b in rivals)])
    weights: FloatArray = np.exp(masses - masses.max())
    weights /= weights.sum()
    told = [_told(problem, answer, marginals, chain, options, float(weights[0]))]
    for basin, weight in zip(rivals, weights[1:], strict=True):
        if weight < KEPT:
            continue
        try:
            own = Marginals(problem, basin.solution)
        except SolverError:
            continue
        told.append(_told(problem, basin, own, chain, options, float(weight)))
    costs = [max(b.solution.cost - answer.solution.cost, 0.0) for b in rivals]
    reason = rival = None
    if weights[0] < HOLDS:
        layout = problem.layout
        rival = layout.positions(rivals[0].solution.x)
        gap = (layout.positions(answer.solution.x) - rival)[chain.nodes]
        reason = _ambiguous(gap, float(weights[0]), float(weights[1]))
    pruned = max(1.0 - sum(h.weight for h in told), 0.0)
    return Verdict(tuple(told), pruned, rival, reason, min(costs, default=None))


def _elsewhere(
    problem: Problem, basins: Sequence[Basin], marginals: Covariances, chain: Chain
) -> list[Basin]:
    """Basins whose track of a chain is another one than the answer's, one of each."""
    sigma = np.sqrt(np.linalg.eigvalsh(marginals.of("position")[chain.nodes])[:, -1])
    covered = np.maximum(APART, COVERED_SIGMAS * sigma)
    places = [problem.layout.positions(basins[0].solution.x)[chain.nodes]]
    kept: list[Basin] = []
    for basin in sorted(basins[1:], key=lambda b: -b.log_mass):
        here = problem.layout.positions(basin.solution.x)[chain.nodes]
        if all((np.linalg.norm(here - place, axis=1) > covered).any() for place in places):
            kept.append(basin)
            places.append(here)
    return kept


def _told(
    problem: Problem,
    basin: Basin,
    marginals: Covariances,
    chain: Chain,
    options: Options,
    weight: float,
) -> Hypothesis:
    solution = basin.solution
    trajectory = trajectory_of(problem, solution, marginals, chain, options)
    status = "converged" if solution.converged else "not converged"
    return Hypothesis(trajectory, weight, solution.cost, status)


def _ambiguous(gap: FloatArray, own: float, other: float) -> str:
    """What to say of an answer that does not hold; `gap` (N, 3), m, from the other track."""
    along = direction(np.linalg.eigh(gap.T @ gap)[1][:, -1])
    return (
        f"{ANOTHER}, {_rms(gap):.0f} m away (rms, mostly {along}), fits as well "
        f"(weight {other:.2g}, this one's is {own:.2g}); a start, a fix, a turn or a second beacon "
        "off the line would tell"
    )


def settled(basins: Sequence[Basin], answer: Solution) -> list[Basin]:
    """Basins with the answer as another engine confirmed it."""
    return [replace(basins[0], solution=answer), *basins[1:]]
