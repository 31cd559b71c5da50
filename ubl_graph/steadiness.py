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
    blocks = [b for chain in problem.layout.chains if (b := _kinks(problem.layout, chain, psd))]
    return replace(problem, blocks=(*problem.blocks, *blocks))


def _scales(layout: Layout) -> FloatArray:
    """Noise densities that are tried, the loosest first."""
    span = max(float(np.ptp(chain.t)) for chain in layout.chains)
    least = 3.0 * STRAYS**2 / max(span, 1.0) ** 3
    count = max(int(np.ceil(np.log(LOOSEST / least) / np.log(STEP))), 1)
    return np.geomspace(LOOSEST, least, count + 1)


def _kinks(layout: Layout, chain: Chain, psd: float) -> LinearBlock | None:
    """Change of the horizontal velocity where the track may bend: ~ N(0, psd times the time)."""
    knots = _knots(chain.t)
    if len(knots) < 3:
        return None
    t = chain.t[knots]
    before, after = np.diff(t)[:-1], np.diff(t)[1:]
    sigma = np.sqrt(psd * 0.5 * (before + after))
    slopes = np.stack([1.0 / before, -1.0 / before - 1.0 / after, 1.0 / after], axis=1)
    matrix = (slopes / sigma[:, None])[:, None, :, None] * np.eye(2)[None, :, None, :]
    columns = layout.node_columns("position", chain.first + knots)[:, :2]
    joined = np.concatenate([columns[:-2], columns[1:-1], columns[2:]], axis=1)
    rows = len(sigma)
    whitening = -2.0 * float(np.log(sigma).sum())
    return LinearBlock(
        "kinks",
        joined,
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
