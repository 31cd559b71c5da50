"""How likely a track is for a vehicle that may have kept its course.

Where one beacon is heard, what tells a track from its mirror image is its shape. Odometry measures
it, with noise; and taken at its word, the noise of a straight track is a shape. Ranges then speak
for one side or the other by chance: in half an hour with a DVL of 1 cm/s by 20 to 1 and more, for
the wrong side as often as for the right one. A posterior that lets the vehicle go anywhere that
odometry does not forbid holds exactly straight tracks for impossible; people sail them all day.

So the vehicle's velocity wanders here by an unknown amount, from not at all upwards, and the data
themselves say how much they need: a hierarchical prior (Gelman et al., Bayesian Data Analysis,
ch. 5) whose scale is summed over. A turn that odometry shows beyond its noise leaves the small
scales no weight, and nothing changes then.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.errors import SolverError
from ubl_graph.factors.block import LinearBlock
from ubl_graph.layout import Chain, Layout
from ubl_graph.problem import Problem
from ubl_graph.solve.evidence import evidence, on_same_terms

#: Noise density of the wandering velocity, m^2/s^3: from one that forbids nothing, by steps of this
#: factor, down to that of a vehicle which strays from a straight line by so little, m.
LOOSEST, STEP, STRAYS = 1.0, 100.0, 0.02
#: Half of the vehicles keep their course, before anything is measured.
KEEPS_COURSE = 0.5
#: A scale whose likelihood is less by this, in logarithm, than the best one's has no part.
NO_PART = 30.0
#: The velocity may change where nodes stand, once in so many seconds at the most, and so often.
LEAST_GAP, MOST_KINKS = 2.0, 400
#: What stands this near to a straight line stands on it, m.
ON_LINE = 1e-4
#: Blocks of residuals that see the shape of a track.
SHAPE = ("odometry", "velocity", "heading", "attitude", "turn", "rate", "compass", "gyro")


def log_mass(problem: Problem, x: FloatArray) -> tuple[float, FloatArray]:
    """Logarithm of the mass about a minimum, but for a constant of the data.

    Parameters
    ----------
    problem : Problem
        Of which minimum.
    x : array
        Near it, flat vector.

    Returns
    -------
    float
        -inf where the normal equations are singular.
    array
        The minimum, flat vector, with the scale unbounded.

    Raises
    ------
    SolverError
        Where the cost at `x` is not finite.
    """
    free = evidence(problem, x)
    if not sees_shape(problem) or not np.isfinite(free.log):
        return free.log, free.x
    scales = _scales(problem.layout)
    prior = np.full(len(scales), np.log((1.0 - KEEPS_COURSE) / max(len(scales) - 1, 1)))
    prior[-1] = np.log(KEEPS_COURSE)
    told: list[float] = []
    start = free.x
    for scale, log_prior in zip(scales, prior, strict=True):
        try:
            found = on_same_terms(wandering(problem, scale), free, start)
        except SolverError:
            break
        if not np.isfinite(found.log) or (told and found.log < max(told) - NO_PART):
            break
        start = found.x
        told.append(found.log + log_prior)
    return (float(np.logaddexp.reduce(told)) if told else free.log), free.x


def sees_shape(problem: Problem) -> bool:
    """Whether anything but ranges, fixes and the motion prior says how the vehicle moves."""
    return any(word in b.name for b in problem.blocks for word in SHAPE if "prior" not in b.name)


def wandering(problem: Problem, psd: float) -> Problem:
    """The problem of a vehicle whose velocity wanders with a noise density of `psd`, m^2/s^3."""
    blocks = [b for chain in problem.layout.chains for b in _wander(problem.layout, chain, psd)]
    return replace(problem, blocks=(*problem.blocks, *blocks))


def _scales(layout: Layout) -> FloatArray:
    """Noise densities that are tried, the loosest first."""
    span = max(float(np.ptp(chain.t)) for chain in layout.chains)
    least = 3.0 * STRAYS**2 / max(span, 1.0) ** 3
    count = max(int(np.ceil(np.log(LOOSEST / least) / np.log(STEP))), 1)
    return np.geomspace(LOOSEST, least, count + 1)


def _wander(layout: Layout, chain: Chain, psd: float) -> list[LinearBlock]:
    """What ties the nodes of a chain to a velocity that wanders."""
    knots = _knots(chain.t)
    if len(knots) < 3:
        return []
    blocks = [_kinks(layout, chain, knots, psd)]
    between = np.setdiff1d(np.arange(knots[-1]), knots)
    return [*blocks, _bridges(layout, chain, knots, between, psd)] if len(between) else blocks


def _kinks(layout: Layout, chain: Chain, knots: IntArray, psd: float) -> LinearBlock:
    """Change of the horizontal velocity where the track may bend: ~ N(0, psd times the time)."""
    before, after = np.diff(chain.t[knots])[:-1], np.diff(chain.t[knots])[1:]
    slopes = np.stack([1.0 / before, -1.0 / before - 1.0 / after, 1.0 / after], axis=1)
    sigma = np.sqrt(psd * 0.5 * (before + after))
    nodes = np.stack([knots[:-2], knots[1:-1], knots[2:]], axis=1)
    return _of_three("kinks", layout, chain, nodes, slopes, sigma)


def _bridges(
    layout: Layout, chain: Chain, knots: IntArray, between: IntArray, psd: float
) -> LinearBlock:
    """Where nodes between two knots are off the straight line: as an integrated walk would be."""
    last = np.searchsorted(knots, between)
    nodes = np.stack([knots[last - 1], between, knots[last]], axis=1)
    begin, t, end = chain.t[nodes].T
    share = (t - begin) / (end - begin)
    sigma = np.sqrt(psd * (end - begin) ** 3 / 3.0) * share * (1.0 - share)
    weights = np.stack([share - 1.0, np.ones(len(share)), -share], axis=1)
    return _of_three("bridges", layout, chain, nodes, weights, np.maximum(sigma, ON_LINE))


def _of_three(
    name: str,
    layout: Layout,
    chain: Chain,
    nodes: IntArray,
    weights: FloatArray,
    sigma: FloatArray,
) -> LinearBlock:
    """Sums of the horizontal positions of three nodes (M, 3) of a chain: ~ N(0, sigma^2)."""
    rows = len(sigma)
    matrix = (weights / sigma[:, None])[:, None, :, None] * np.eye(2)[None, :, None, :]
    columns = layout.node_columns("position", chain.first + nodes.ravel())[:, :2]
    whitening = -2.0 * float(np.log(sigma).sum())
    return LinearBlock(
        name,
        columns.reshape(rows, 6),
        matrix.reshape(rows, 2, 6),
        np.zeros((rows, 2)),
        log_det=lambda: whitening,
    )


def _knots(t: FloatArray) -> IntArray:
    """Nodes at which the velocity may change, as far apart as is asked."""
    gap = max(LEAST_GAP, float(t[-1] - t[0]) / MOST_KINKS)
    kept = [0]
    for k in range(1, len(t)):
        if t[k] - t[kept[-1]] >= gap:
            kept.append(k)
    return np.array(kept)
