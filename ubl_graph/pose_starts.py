"""Starts for vehicles with odometry, ranges, and no known start pose.

Levenberg-Marquardt on the first windows of a track (`ubl_graph.pose_chain`) runs from starts all
around, side by side in one array; the robust loss begins as wide as the residuals are and narrows
(graduated non-convexity). The distinct answers are carried on to windows further along, half as
many again each time, until they hold the whole track. All earlier ranges stay in the fit, so that
answers which only later data tell apart (one beacon, a vehicle that stands, a straight track) are
not decided early.

Source: Yang, Antonante, Tzoumas and Carlone 2020, Graduated non-convexity for robust spatial
perception (the narrowing loss).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.errors import UnobservableError
from ubl_graph.pose_chain import (
    KNOT,
    RANGE_SCALE,
    SCALE,
    SHARED,
    TURN_BIAS,
    WIDTH,
    Chain,
    Points,
)
from ubl_graph.pose_windows import Anchors, ReckonedTrack, TrackRanges, Unknowns, select

#: Ranges that the first fit has, if the track has them.
FIRST_RANGES = 24
#: Starts of the first fit: directions around a beacon, headings, ranges that are tried.
AZIMUTHS, HEADINGS, START_RANGES = 12, 12, 3
#: Where the turn bias is unknown: step of the turn over the first fit (rad), and most steps.
TURN_STEP, MOST_TURNS = 0.5, 7
#: A heading better known than this is not searched, rad; a position, m.
KNOWN_HEADING, KNOWN_POSITION = 0.3, 20.0
#: Share of windows by which answers are carried on at once.
LONGER = 0.5
#: Starts kept after the first, rough iterations, and answers carried from window to window.
REFINED, CARRIED = 96, 24
#: Answers dearer than the best by more than both, a cost and a share of the best's, are dropped.
HOPELESS, HOPELESS_SHARE = 300.0, 0.3
#: Answers this little dearer than the best are one valley, and are spread over it.
VALLEY_COST = 10.0
#: Answers that differ by less in all knots are one: m, rad.
SAME_PLACE, SAME_HEADING = 5.0, 0.1
#: The loss is so many times as wide as the median residual, stage by stage, and then its own width.
NARROWING = (2.0, 1.0, 0.5)
#: That median is taken over so many ranges.
ABOUT = 25
ROUGH_ITERATIONS, STAGE_ITERATIONS, LAST_ITERATIONS = 6, 10, 60
#: The last solve ends where a step saves less cost than the first number, the others at the second.
SETTLED, ENOUGH = 1e-6, 1e-3


@dataclass(frozen=True, eq=False)
class PoseStart:
    """A track in the world.

    Attributes
    ----------
    position : array, shape (N, 3)
        East, north, up at the track's times, m.
    yaw : array, shape (N,)
        Counter-clockwise from east, rad, continuous.
    turn_bias : float
        What the odometry turns too far clockwise, rad/s.
    scale : float
        True displacement = (1 + scale) odometry.
    range_scale : float
        Measured distance = exp(range_scale) true distance.
    cost : float
        Robust cost of the ranges, and half the squares of all else.
    """

    position: FloatArray
    yaw: FloatArray
    turn_bias: float
    scale: float
    range_scale: float
    cost: float


def find_pose_starts(
    track: ReckonedTrack,
    ranges: TrackRanges,
    unknowns: Unknowns | None = None,
    anchors: Anchors | None = None,
    kept: int = 8,
) -> list[PoseStart]:
    """Distinct places and headings of a track, best first.

    Parameters
    ----------
    track : ReckonedTrack
    ranges : TrackRanges
    unknowns : Unknowns, optional
        Left out: a place and a heading are all that is unknown.
    anchors : Anchors, optional
        Such as a start prior.
    kept : int
        At most so many answers. Where the data leave a whole valley open (one beacon) they are
        spread over it.

    Returns
    -------
    list of PoseStart

    Raises
    ------
    UnobservableError
        Where there is neither a range nor an anchor with a position.
    """
    anchors = anchors or Anchors.none()
    if not len(ranges.t) and not np.isfinite(anchors.sigma[:, :2]).all(axis=1).any():
        raise UnobservableError(
            "nothing says where the vehicle is: no range, no fix and no start position",
            "give a start position",
        )
    unknowns = unknowns or Unknowns()
    chain = Chain(track, ranges, unknowns, anchors)
    count = _first_windows(chain)
    search = _Search(chain)
    theta, cost = search.settle(search.roughly(_starts(chain, count), count), count)
    while count < chain.windows:
        rows = _hopeful(_distinct(theta, cost, CARRIED), cost)
        count = min(chain.windows, count + max(1, int(LONGER * count)))
        theta, cost = search.settle(chain.predict(theta[rows], count), count)
    starts: list[PoseStart] = []
    for i in _distinct(theta, cost, kept):
        position, yaw = chain.poses(theta[i])
        bias, scale, range_scale = (float(theta[i, c]) for c in (TURN_BIAS, SCALE, RANGE_SCALE))
        starts.append(PoseStart(position, yaw, bias, scale, range_scale, float(cost[i])))
    return starts


def _first_windows(chain: Chain) -> int:
    """As few windows as hold enough ranges, or the first anchored one."""
    enough = min(FIRST_RANGES, len(chain.ranges.t))
    if not enough:
        placed = np.isfinite(chain.anchors.sigma[:, :2]).all(axis=1)
        return int(chain.anchored.window[np.argmax(placed)]) + 1
    return int(chain.sighted.window[enough - 1]) + 1


def _starts(chain: Chain, windows: int) -> FloatArray:
    """Answers that put the track on range circles or on an anchor, turned all around."""
    bias, heading = _turns(chain, windows)
    bias, heading = (a.ravel() for a in np.meshgrid(bias, heading, indexing="ij"))
    theta = np.zeros((len(bias), SHARED + KNOT))
    theta[:, TURN_BIAS] = bias
    theta[:, SHARED + 2] = chain.track.position[0, 2]
    theta[:, SHARED + 3] = heading
    anchors = chain.anchors
    known = KNOWN_POSITION if len(chain.ranges.t) else np.inf
    placed = (anchors.sigma[:, :2] < known).all(axis=1)
    placed &= chain.anchored.window < windows
    made: list[FloatArray] = []
    for row in np.flatnonzero(placed)[:1]:
        target = complex(*anchors.position[row, :2])
        made.append(_moved(chain, theta, select(chain.anchored, slice(row, row + 1)), target))
    if not made:
        count = len(chain.sighted.within(windows).window)
        for row in np.unique(np.linspace(0, count - 1, START_RANGES).astype(int)):
            made += _on_circle(chain, theta, int(row))
    return chain.predict(np.concatenate(made), windows)


def _turns(chain: Chain, windows: int) -> tuple[FloatArray, FloatArray]:
    """Turn biases and turns of the first knot to start at."""
    sigma = chain.unknowns.turn_bias
    lasted = float(chain.track.t[chain.joints[windows]] - chain.track.t[0])
    steps = min(MOST_TURNS // 2, int(np.ceil(2.0 * sigma * lasted / TURN_STEP - 0.5)))
    bias = np.linspace(-2.0 * sigma, 2.0 * sigma, 2 * steps + 1) if steps > 0 else np.zeros(1)
    anchors = chain.anchors
    known = (anchors.yaw_sigma < KNOWN_HEADING) & (chain.anchored.window < windows)
    if known.any():
        row = int(np.argmax(known))
        return bias, anchors.yaw[row : row + 1] - chain.anchored.yaw[row]
    return bias, 2.0 * np.pi * np.arange(HEADINGS) / HEADINGS


def _on_circle(chain: Chain, theta: FloatArray, row: int) -> list[FloatArray]:
    """The same turns with one antenna on the circle of its range, in every direction."""
    beacon, distance = chain.ranges.beacon[row], float(chain.ranges.distance[row])
    up = float(chain.sighted.up[row])
    levels = [up] if chain.unknowns.up == 0.0 else [up, 0.5 * (up + beacon[2]), float(beacon[2])]
    made: list[FloatArray] = []
    for level in levels:
        lifted = theta.copy()
        lifted[:, SHARED + 2] += level - up
        reach = np.sqrt(max(distance**2 - (level - beacon[2]) ** 2, (0.05 * distance) ** 2))
        for azimuth in 2.0 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS:
            target = complex(*beacon[:2]) + reach * np.exp(1j * azimuth)
            made.append(_moved(chain, lifted, select(chain.sighted, slice(row, row + 1)), target))
    return made


def _moved(chain: Chain, theta: FloatArray, point: Points, target: complex) -> FloatArray:
    """Move each answer so that one point of its track lies on a target."""
    theta = theta.copy()
    gap = target - chain.view(theta, point, np.zeros(1, dtype=np.int64)).place[:, 0]
    theta[:, SHARED], theta[:, SHARED + 1] = gap.real, gap.imag
    return theta


class _Search:
    """Robust Levenberg-Marquardt over a chain for many answers at once."""

    def __init__(self, chain: Chain) -> None:
        self.chain = chain
        u = chain.unknowns
        sigma = np.array([u.turn_bias, u.scale, u.range_scale])
        self.held = sigma == 0.0
        self.weight = np.where(self.held, 0.0, 1.0 / np.where(self.held, 1.0, sigma))

    def roughly(self, theta: FloatArray, windows: int) -> FloatArray:
        """The best of many starts after a few iterations with a wide loss."""
        wide = self._median(theta, windows) * NARROWING[0]
        theta, cost = self._descend(theta, windows, wide, ROUGH_ITERATIONS)
        # Compared by the loss that counts, wide as each needs it.
        cost = self._system(theta, windows, np.ones_like(wide))[0]
        return theta[np.argsort(cost, kind="stable")[:REFINED]]

    def settle(self, theta: FloatArray, windows: int) -> tuple[FloatArray, FloatArray]:
        """Answers and costs after the loss has narrowed to its own width."""
        for factor in NARROWING:
            width = np.maximum(1.0, factor * self._median(theta, windows))
            theta, _ = self._descend(theta, windows, width, STAGE_ITERATIONS)
        own = np.ones((len(theta), len(self.chain.sighted.within(windows).window)))
        whole = windows == self.chain.windows
        return self._descend(theta, windows, own, LAST_ITERATIONS, SETTLED if whole else ENOUGH)

    def _median(self, theta: FloatArray, windows: int) -> FloatArray:
        """Median residual of the ranges about each of them in time, 1 at least; shape (S, M)."""
        off = np.abs(self.chain.range_rows(theta, windows).residual)
        span = min(ABOUT, off.shape[1])
        if not span:
            return off
        medians = np.median(np.lib.stride_tricks.sliding_window_view(off, span, axis=1), axis=-1)
        middle = np.clip(np.arange(off.shape[1]) - span // 2, 0, off.shape[1] - span)
        return np.maximum(medians[:, middle], 1.0)

    def _descend(
        self,
        theta: FloatArray,
        windows: int,
        width: FloatArray,
        iterations: int,
        settled: float = ENOUGH,
    ) -> tuple[FloatArray, FloatArray]:
        theta = theta.copy()
        damping = np.full(len(theta), 1e-3)
        cost, gradient, hessian = self._system(theta, windows, width)
        active = np.arange(len(theta))
        diagonal = np.arange(theta.shape[1])
        for _ in range(iterations):
            damped = hessian[active]
            # A direction that nothing holds keeps a trace of stiffness.
            damped[:, diagonal, diagonal] *= 1.0 + damping[active, None]
            damped[:, diagonal, diagonal] += 1e-9
            step = np.linalg.solve(damped, gradient[active][..., None])[..., 0]
            trial = theta[active] - step
            c, g, h = self._system(trial, windows, width[active])
            better = c < cost[active]
            done = better & (cost[active] - c < settled)
            won = active[better]
            for kept, new in ((theta, trial), (cost, c), (gradient, g), (hessian, h)):
                kept[won] = new[better]
            damping[active] *= np.where(better, 0.1, 10.0)
            active = active[~done & (damping[active] < 1e8)]
            if not len(active):
                break
        return theta, cost

    def _system(
        self, theta: FloatArray, windows: int, width: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Cost (S,), gradient (S, C) and Gauss-Newton Hessian (S, C, C)."""
        chain, columns = self.chain, theta.shape[1]
        off = theta[:, :SHARED] * self.weight
        cost = 0.5 * (off**2).sum(axis=1)
        gradient = np.zeros_like(theta)
        hessian = np.zeros((len(theta), columns, columns))
        gradient[:, :SHARED] = off * self.weight
        hessian[:, range(SHARED), range(SHARED)] = self.weight**2
        if chain.unknowns.up > 0.0:
            lift = (theta[:, SHARED + 2] - chain.track.position[0, 2]) / chain.unknowns.up
            cost += 0.5 * lift**2
            gradient[:, SHARED + 2] += lift / chain.unknowns.up
            hessian[:, SHARED + 2, SHARED + 2] += chain.unknowns.up**-2
        robust = (WIDTH * width) ** 2
        for rows, losses in (
            (chain.range_rows(theta, windows), robust),
            (chain.anchor_rows(theta, windows), None),
            (chain.joint_rows(theta, windows), None),
        ):
            r, jacobian = rows.residual, rows.jacobian
            if losses is None:
                weighted = jacobian
                cost += 0.5 * (r**2).sum(axis=1)
            else:
                weighted = jacobian / (1.0 + r**2 / losses)[..., None]
                cost += 0.5 * (losses * np.log1p(r**2 / losses)).sum(axis=1)
            bounds = np.searchsorted(rows.window, np.arange(windows + 1))
            for w in np.unique(rows.window):
                here = slice(bounds[w], bounds[w + 1])
                c = np.r_[:SHARED, SHARED + KNOT * w : SHARED + KNOT * (w + 2)]
                turned = weighted[:, here].swapaxes(1, 2)
                gradient[:, c] += (turned @ r[:, here, None])[..., 0]
                hessian[:, c[:, None], c] += turned @ jacobian[:, here]
        return cost, *self._without_held(gradient, hessian)

    def _without_held(
        self, gradient: FloatArray, hessian: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Columns that are not unknown stay as they are."""
        held = np.flatnonzero(self.held)
        if self.chain.unknowns.up == 0.0:
            held = np.concatenate([held, np.arange(SHARED + 2, gradient.shape[1], KNOT)])
        gradient[:, held] = 0.0
        hessian[:, held] = 0.0
        hessian[:, :, held] = 0.0
        hessian[:, held, held] = 1.0
        return gradient, hessian


def _hopeful(rows: IntArray, cost: FloatArray) -> IntArray:
    """Drop answers far dearer than the best, but not the runner-up."""
    limit = cost[rows[0]] + max(HOPELESS, HOPELESS_SHARE * cost[rows[0]])
    return rows[: max(2, int(np.count_nonzero(cost[rows] < limit)))]


def _distinct(theta: FloatArray, cost: FloatArray, most: int) -> IntArray:
    """Rows of distinct answers, best first; those of one valley as far apart as can be."""
    # A tie in cost is broken by the start's number: the same data give the same order.
    order = np.argsort(cost, kind="stable")
    knots = theta[order, SHARED:].reshape(len(order), -1, KNOT)

    def apart(i: int) -> FloatArray:
        gap = knots - knots[i]
        place = np.linalg.norm(gap[..., :3], axis=-1) / SAME_PLACE
        turn = np.abs(np.angle(np.exp(1j * gap[..., 3]))) / SAME_HEADING
        return np.maximum(place, turn).max(axis=1)

    kept, nearest = [0], apart(0)
    valley = cost[order] < cost[order[0]] + VALLEY_COST
    while len(kept) < most and (nearest > 1.0).any():
        inside = nearest * valley
        # The valley first, then whatever comes next in cost.
        i = int(np.argmax(inside)) if inside.max() > 1.0 else int(np.argmax(nearest > 1.0))
        kept.append(i)
        nearest = np.minimum(nearest, apart(i))
    return order[np.sort(kept)]
