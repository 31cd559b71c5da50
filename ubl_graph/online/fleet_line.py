"""One vehicle of an online fleet: its odometry of the last lag, and its nodes.

Odometry is only kept as it comes. What lies between two nodes is compounded when a solve asks for
it, and anew where a late record falls between them. A gap is bridged: the vehicle goes on as before
it, with noise that grows as the options' motion prior lets it.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ubl_graph import lie
from ubl_graph.arrays import FloatArray
from ubl_graph.cooperative.fleet import Member
from ubl_graph.measurements import Odometry
from ubl_graph.odometry_chain import INSTANT, Steps, composed
from ubl_graph.odometry_noise import PLANAR, in_space, odometry_covariances, whitening_of
from ubl_graph.options import Options

#: A vehicle of which no odometry is known yet may go so fast, m/s, and turn so fast, rad/s.
UNKNOWN_SPEED, UNKNOWN_RATE = 2.0, 0.2
#: However long a gap, the heading is not less known than this, rad.
ANY_HEADING = np.pi


class Piece(NamedTuple):
    """Change of pose from one time (s) to another; forward, left, up."""

    t_from: float
    t_to: float
    way: FloatArray  # (3,), m
    turn: FloatArray  # (3,), rad
    covariance: FloatArray  # (3, 3) of a planar vehicle, or (6, 6)


class Step(NamedTuple):
    """Compounded odometry from the node before."""

    way: FloatArray
    turn: FloatArray
    white: FloatArray  # W with W C W' = 1
    dt: float


@dataclass(slots=True, eq=False)
class Node:
    """A pose of a vehicle at a time.

    Attributes
    ----------
    t : float
        s.
    x : array, shape (3,) or (6,)
        Its columns: east, north, yaw, or position and rotation vector.
    step : Step, optional
        From the node before; None where it is to be compounded anew.
    number : int
        Among all nodes, as they were last packed.
    held : int
        How many records and rows need the node where it is.
    """

    t: float
    x: FloatArray
    step: Step | None = None
    number: int = -1
    held: int = 0


@dataclass(eq=False)
class Line:
    """A vehicle's odometry and nodes.

    Parameters
    ----------
    member : Member
        Lever arms.
    options : Options
        The vehicle's, with what belongs to the whole.

    Attributes
    ----------
    leans : bool
        Whether nothing tells roll and pitch: planar odometry of a vehicle in space does not.
    """

    member: Member
    options: Options
    pieces: list[Piece] = field(default_factory=list[Piece])
    nodes: list[Node] = field(default_factory=list[Node])
    ups: list[tuple[float, float]] = field(default_factory=list[tuple[float, float]])
    depth_sigma: float | None = None
    leans: bool = False

    def __post_init__(self) -> None:
        self.planar = self.options.node == "pose2"
        vehicle = self.member.vehicle
        self.transducer, self.depth_arm = vehicle.transducer.body, vehicle.depth_sensor.body
        turning = self.options.angular_acceleration_psd
        flat, vertical = self.options.horizontal_psd, self.options.vertical_psd
        self._psd = np.array([flat, flat, *(() if self.planar else (vertical,))])
        self._turn_psd = np.full(1 if self.planar else 3, turning)

    @property
    def located(self) -> bool:
        """Whether it has a place."""
        return bool(self.nodes)

    @property
    def end(self) -> float | None:
        """End of the newest odometry, s."""
        return self.pieces[-1].t_to if self.pieces else None

    # -- odometry --

    def take(self, records: Odometry) -> list[str]:
        """Keep odometry records; why each one does not count, empty where it does."""
        covariance = odometry_covariances(records, self.options)
        if self.planar and covariance.shape[1] == 6:
            covariance = covariance[:, PLANAR[:, None], PLANAR[None, :]]
        elif not self.planar and covariance.shape[1] == 3:
            covariance = in_space(covariance)
            self.leans = True
        ways, turns = records.translation, records.rotation_vector
        if self.planar:
            ways[:, 2] = turns[:, 0] = turns[:, 1] = 0.0
        rows = zip(
            records.t_from.tolist(), records.t_to.tolist(), ways, turns, covariance, strict=True
        )
        return [self._keep(Piece(*row)) for row in rows]

    def _keep(self, piece: Piece) -> str:
        """Put a piece, or what of it is new, among the others."""
        if not self.pieces or piece.t_from >= self.pieces[-1].t_to - INSTANT:
            at = len(self.pieces)
        else:
            at = bisect_left(self.pieces, piece.t_from, key=lambda p: p.t_from)
        low, high = piece.t_from, piece.t_to
        if at and self.pieces[at - 1].t_to > low + INSTANT:
            low = self.pieces[at - 1].t_to
        if at < len(self.pieces) and self.pieces[at].t_from < high - INSTANT:
            high = self.pieces[at].t_from
        if high - low < 2.0 * INSTANT:
            there = self.pieces[min(at, len(self.pieces) - 1)]
            same = abs(there.t_from - piece.t_from) + abs(there.t_to - piece.t_to) < INSTANT
            return "duplicate" if same else "overlaps odometry that is there"
        if (low, high) != (piece.t_from, piece.t_to):
            piece = _part(piece, low, high)
        self.pieces.insert(at, piece)
        self._touch(low, high)
        return ""

    def _touch(self, low: float, high: float) -> None:
        """Have the steps that reach over a time span compounded anew."""
        at = bisect_right(self.nodes, low, key=lambda n: n.t)
        for node in self.nodes[max(at, 1) :]:
            node.step = None
            if node.t >= high:
                break
        # What was bridged before the first odometry went on as that did.
        if self.pieces[0].t_from == low:
            for node in self.nodes[1:at]:
                node.step = None

    def forget(self, t: float) -> None:
        """Drop what ended before a time (s); one piece stays to go on from."""
        keep = bisect_right(self.pieces, t, key=lambda p: p.t_to)
        del self.pieces[: min(keep, len(self.pieces) - 1)]
        del self.ups[: max(bisect_right(self.ups, t, key=lambda u: u[0]) - 1, 0)]

    def between(self, times: Sequence[float]) -> Steps:
        """Compounded odometry from each of the times (s, increasing) to the next, gaps bridged."""
        first, last = times[0], times[-1]
        low = bisect_right(self.pieces, first + INSTANT, key=_end)
        high = bisect_left(self.pieces, last - INSTANT, key=_begin)
        some = self._bridged(self.pieces[low:high], low, first, last)
        parts: list[Piece] = []
        group: list[int] = []
        k = 0
        for piece in some:
            begin = max(piece.t_from, first)
            while k + 2 < len(times) and times[k + 1] <= begin + INSTANT:
                k += 1
            while True:
                end = min(piece.t_to, times[k + 1])
                whole = begin - piece.t_from < INSTANT and piece.t_to - end < INSTANT
                parts.append(piece if whole else _part(piece, begin, end))
                group.append(k)
                if k + 2 == len(times) or piece.t_to <= times[k + 1] + INSTANT:
                    break
                begin, k = end, k + 1
        ways, turns = np.array([p.way for p in parts]), np.array([p.turn for p in parts])
        noise = np.array([p.covariance for p in parts])
        if self.planar:
            pieces = Steps(turns[:, 2], ways[:, :2], noise)
        else:
            pieces = Steps(lie.rotation(turns), ways, noise)
        return composed(pieces, np.array(group))

    def _bridged(
        self, pieces: Sequence[Piece], at: int, first: float, last: float
    ) -> Sequence[Piece]:
        """Pieces without gaps from one time to another; `at` is the first one's number."""
        out: list[Piece] = []
        reached = first
        before = self.pieces[at - 1] if at else (self.pieces[0] if self.pieces else None)
        for piece in pieces:
            if piece.t_from > reached + INSTANT:
                out.append(self._bridge(before or piece, reached, piece.t_from))
            out.append(piece)
            reached, before = piece.t_to, piece
        if last > reached + INSTANT:
            out.append(self._bridge(before, reached, last))
        return out

    def _bridge(self, like: Piece | None, t_from: float, t_to: float) -> Piece:
        """As the vehicle went on without anything said of it."""
        dt = t_to - t_from
        drifted = self._psd * dt**3 / 3.0
        turned = self._turn_psd * dt**3 / 3.0
        if like is None:
            drifted = drifted + (UNKNOWN_SPEED * dt) ** 2
            turned = turned + (UNKNOWN_RATE * dt) ** 2
            own = np.zeros((len(drifted) + len(turned),) * 2)
            way, turn = np.zeros(3), np.zeros(3)
        else:
            share = dt / (like.t_to - like.t_from)
            own = share * like.covariance
            way, turn = _along(like, share)
        noise = np.concatenate([drifted, np.minimum(turned, ANY_HEADING**2)])
        return Piece(t_from, t_to, way, turn, own + np.diag(np.maximum(noise, 1e-12)))

    # -- nodes --

    def node_near(self, t: float) -> Node | None:
        """The node at a time, if there is one."""
        at = bisect_left(self.nodes, t - INSTANT, key=lambda n: n.t)
        if at < len(self.nodes) and self.nodes[at].t <= t + INSTANT:
            return self.nodes[at]
        return None

    def node_at(self, t: float) -> Node:
        """The node at a time (s, not before the first one), made where there is none."""
        found = self.node_near(t)
        if found is not None:
            return found
        at = bisect_right(self.nodes, t, key=lambda n: n.t)
        before = self.nodes[at - 1]
        step = self.step(before.t, t)
        node = Node(t, moved(before.x, step.way, step.turn), step)
        if at < len(self.nodes):
            self.nodes[at].step = None
        self.nodes.insert(at, node)
        return node

    def drop(self, node: Node) -> None:
        """Take out a node that nothing holds; its neighbours are joined instead."""
        at = self.nodes.index(node)
        if at + 1 < len(self.nodes):
            self.nodes[at + 1].step = None
        del self.nodes[at]

    def step(self, t_from: float, t_to: float) -> Step:
        """Compounded odometry from one time to a later one."""
        return self._steps((t_from, t_to))[0]

    def _steps(self, times: Sequence[float]) -> list[Step]:
        steps = self.between(times)
        turns, ways = turns_and_ways(steps)
        rows = zip(
            ways, turns, whitening_of(steps.covariance), np.diff(times).tolist(), strict=True
        )
        return [Step(*row) for row in rows]

    def refresh(self) -> None:
        """Compound what is to be compounded anew."""
        at = 1
        while at < len(self.nodes):
            if self.nodes[at].step is not None:
                at += 1
                continue
            run = at
            while run < len(self.nodes) and self.nodes[run].step is None:
                run += 1
            made = self._steps([n.t for n in self.nodes[at - 1 : run]])
            for node, step in zip(self.nodes[at:run], made, strict=True):
                node.step = step
            at = run

    def before(self, t: float) -> Node:
        """The last node that is not after a time; the first one where all are."""
        return self.nodes[max(bisect_right(self.nodes, t + INSTANT, key=lambda n: n.t) - 1, 0)]

    def take_up(self, t: float, up: float) -> bool:
        """Note the height (m) of a fix, which a depth overrules; whether it is new."""
        at = bisect_left(self.ups, (t, up))
        if self.depth_sigma is not None or self.ups[at : at + 1] == [(t, up)]:
            return False
        self.ups.insert(at, (t, up))
        return True

    def drop_up(self, t: float, up: float) -> None:
        """Forget the height of a fix that was refused."""
        if self.depth_sigma is None:
            self.ups = [one for one in self.ups if one != (t, up)]

    def up_at(self, t: FloatArray) -> FloatArray:
        """Up of a planar vehicle, (N,), m."""
        if not self.ups:
            start = self.member.segment.start
            level = 0.0 if start is None or start.up is None else start.up
            return np.full(len(t), level)
        if len(self.ups) == 1:
            return np.full(len(t), self.ups[0][1])
        told = np.array(self.ups)
        return np.interp(t, told[:, 0], told[:, 1])


def turns_and_ways(steps: Steps) -> tuple[FloatArray, FloatArray]:
    """Rotation vectors and ways of steps, (M, 3) each, rad and m."""
    if not steps.planar:
        return lie.rotation_vector(steps.rotation), steps.way
    none = np.zeros(len(steps))
    return (
        np.stack([none, none, steps.rotation], axis=1),
        np.column_stack([steps.way, none]),
    )


def _begin(piece: Piece) -> float:
    return piece.t_from


def _end(piece: Piece) -> float:
    return piece.t_to


def moved(x: FloatArray, way: FloatArray, turn: FloatArray) -> FloatArray:
    """Columns of the pose that a change of pose leads to from those of another."""
    if len(x) == 3:
        cos, sin = np.cos(x[2]), np.sin(x[2])
        along = np.array([cos * way[0] - sin * way[1], sin * way[0] + cos * way[1], turn[2]])
        return x + along
    rotation = lie.rotation(x[None, 3:])
    turned = lie.rotation_vector(rotation @ lie.rotation(turn[None]))[0]
    return np.concatenate([x[:3] + rotation[0] @ way, turned])


def _along(piece: Piece, share: float) -> tuple[FloatArray, FloatArray]:
    """Way and turn of a share of a piece, or of several times it, its twist held."""
    angle = float(piece.turn[2])
    if abs(angle) < math.pi and not piece.turn[:2].any():
        # Chords of one circle: in closed form.
        half, part = 0.5 * angle, 0.5 * share * angle
        longer = share * _sinc(part) / _sinc(half)
        cos, sin = longer * math.cos(part - half), longer * math.sin(part - half)
        along, aside, up = piece.way.tolist()
        way = np.array([cos * along - sin * aside, sin * along + cos * aside, share * up])
        return way, share * piece.turn
    turn = piece.turn[None]
    velocity = np.einsum("mij,mj->mi", lie.rotation_slope_inverse(-turn), piece.way[None])
    parted = share * turn
    way = np.einsum("mij,mj->mi", lie.rotation_slope(-parted), share * velocity)[0]
    return way, parted[0]


def _sinc(angle: float) -> float:
    return 1.0 - angle * angle / 6.0 if abs(angle) < 1e-4 else math.sin(angle) / angle


def _part(piece: Piece, low: float, high: float) -> Piece:
    """What of a piece lies between two times."""
    share = (high - low) / (piece.t_to - piece.t_from)
    way, turn = _along(piece, share)
    return Piece(low, high, way, turn, share * piece.covariance)
