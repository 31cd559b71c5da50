"""Odometry compounded from node to node: many short records as few long ones.

Records that join end to start are put one after the other between the times where nodes are
wanted. With Z the change of pose and e its noise in the last pose's axes, Z Exp(e), two of them
follow each other as

    Z1 Exp(e1) Z2 Exp(e2) = Z1 Z2 Exp(Ad(Z2^-1) e1 + e2)    to first order in the noise,

so that covariances add once the first has been carried along. Source: Barfoot and Furgale 2014,
Associating uncertainty with three-dimensional poses, eq. 31.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ubl_graph import lie
from ubl_graph.arrays import BoolArray, FloatArray, IntArray
from ubl_graph.measurements import Odometry
from ubl_graph.measurements.motion import SHORTEST_STEP
from ubl_graph.nodes import SAME_INSTANT
from ubl_graph.odometry_noise import PLANAR, in_space, odometry_covariances
from ubl_graph.options import Options

#: Ends nearer to each other than this are the same, s.
INSTANT = max(SAME_INSTANT, SHORTEST_STEP)
#: No compound goes farther than this of itself, m: half of what a record of odometry may hold.
FARTHEST = 5e3
#: Forward, left, up into forward, right, down and back.
_SIGNS = np.array([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class Steps:
    """Changes of pose, one a row.

    Attributes
    ----------
    rotation : array, shape (M, 3, 3) or (M,)
        Second pose's axes in the first's; of a planar vehicle the angle, rad, counter-clockwise.
    way : array, shape (M, 3) or (M, 2)
        Displacement in the first pose's axes (forward, left, up), m.
    covariance : array, shape (M, 6, 6) or (M, 3, 3)
        Of the noise in the second pose's axes, along then about, m^2 and rad^2.
    """

    rotation: FloatArray
    way: FloatArray
    covariance: FloatArray

    @property
    def planar(self) -> bool:
        """Whether the motion is one in a plane."""
        return self.rotation.ndim == 1

    def __len__(self) -> int:
        return len(self.rotation)

    def __getitem__(self, rows: IntArray | BoolArray) -> Steps:
        return Steps(self.rotation[rows], self.way[rows], self.covariance[rows])

    def then(self, other: Steps) -> Steps:
        """Each followed by the other's of the same row."""
        carry = other.backward()
        covariance = carry @ self.covariance @ np.swapaxes(carry, 1, 2) + other.covariance
        if self.planar:
            way = self.way + _turned(self.rotation, other.way)
            return Steps(self.rotation + other.rotation, way, covariance)
        way = self.way + np.einsum("mij,mj->mi", self.rotation, other.way)
        return Steps(self.rotation @ other.rotation, way, covariance)

    def backward(self) -> FloatArray:
        """Ad(Z^-1): a motion in the first pose's axes as the second pose has it."""
        if not self.planar:
            back = np.swapaxes(self.rotation, 1, 2)
            return lie.adjoint(back, -np.einsum("mij,mj->mi", back, self.way))
        cos, sin = np.cos(self.rotation), np.sin(self.rotation)
        along, aside = self.way.T
        out = np.zeros((len(self), 3, 3))
        out[:, 0, 0] = out[:, 1, 1] = cos
        out[:, 0, 1], out[:, 1, 0] = sin, -sin
        out[:, 0, 2] = sin * along - cos * aside
        out[:, 1, 2] = cos * along + sin * aside
        out[:, 2, 2] = 1.0
        return out


def compounded(
    records: Odometry, times: FloatArray, options: Options, farthest: float = FARTHEST
) -> Odometry:
    """Odometry from one wanted time to the next, and to where the records begin and end.

    Parameters
    ----------
    records : Odometry
        M records, in any order. Those that join end to start are compounded; where there is a gap
        between two, both sides keep their ends. Records that overlap others in time stay as they
        are: they say something of their own.
    times : array, shape (N,)
        Where nodes are wanted, s, in any order. A time within a record cuts it there as if its
        twist had been constant, its covariance in proportion to time; one that is within 2e-6 s of
        a record's end is that end. Times in gaps count for nothing.
    options : Options
        For the noise (`odometry_noise.odometry_covariances`), and the kind of node: in space
        planar records are compounded as spatial ones that stay in their plane.
    farthest : float, default 5000
        A compound of a longer way is given in parts, m.

    Returns
    -------
    Odometry
        K records by time, with their covariances. These hold the options' share already: the
        result is meant for options with `odometry_noise = "given"`.
    """
    if not len(records):
        return records
    records = records[np.argsort(records.t_from, kind="stable")]
    begin, end = records.t_from, records.t_to
    alone = _overlapping(begin, end)
    joins = _joins(begin, end) & ~(alone | np.append(alone[1:], True))
    which, t_from, t_to = _cut(begin, end, _apart(times), alone)
    share = (t_to - t_from) / (end - begin)[which]
    pieces = _pieces(records, options, which, share)

    follows = (which[1:] == which[:-1]) | joins[which[:-1]]
    wanted = _near(times, t_from[1:])
    way: FloatArray = np.cumsum(np.linalg.norm(pieces.way, axis=1)) // farthest
    opens = np.concatenate([[True], ~follows | wanted | (np.diff(way) > 0.0)])
    first = np.flatnonzero(opens)
    last = np.append(first[1:], len(opens)) - 1
    return _records(t_from[first], t_to[last], composed(pieces, np.cumsum(opens) - 1))


def steps_of(records: Odometry, *, planar: bool) -> Steps:
    """Records that have covariances as changes of pose.

    Parameters
    ----------
    records : Odometry
        Of `compounded`.
    planar : bool
        Whether to leave out what leads out of the plane.
    """
    covariance = records.covariances_flu
    assert covariance is not None
    if planar:
        if covariance.shape[1] == 6:
            covariance = covariance[:, PLANAR[:, None], PLANAR[None, :]]
        return Steps(records.rotation_vector[:, 2], records.translation[:, :2], covariance)
    if covariance.shape[1] == 3:
        covariance = in_space(covariance)
    return Steps(lie.rotation(records.rotation_vector), records.translation, covariance)


def _joins(begin: FloatArray, end: FloatArray) -> BoolArray:
    """Whether each record is followed by the next without a gap, (M,)."""
    return np.append(np.abs(begin[1:] - end[:-1]) <= INSTANT, False)


def _overlapping(begin: FloatArray, end: FloatArray) -> BoolArray:
    """Whether each of some records, sorted by their begin, overlaps another, (M,)."""
    alone = np.zeros(len(begin), dtype=np.bool_)
    alone[:-1] |= end[:-1] > begin[1:] + INSTANT
    alone[1:] |= np.maximum.accumulate(end)[:-1] > begin[1:] + INSTANT
    return alone


def _apart(times: FloatArray) -> FloatArray:
    """Times in order, ones of the same instant once."""
    ordered = np.unique(np.asarray(times, dtype=np.float64))
    return ordered[np.diff(ordered, prepend=-np.inf) > INSTANT]


def _near(times: FloatArray, t: FloatArray) -> BoolArray:
    """Whether there is one of the times at each of `t`."""
    if not len(times):
        return np.zeros(len(t), dtype=np.bool_)
    ordered = np.sort(times)
    after = np.searchsorted(ordered, t)
    gap = np.minimum(
        np.abs(ordered[after.clip(0, len(ordered) - 1)] - t),
        np.abs(ordered[(after - 1).clip(0)] - t),
    )
    return gap <= INSTANT


def _cut(
    begin: FloatArray, end: FloatArray, times: FloatArray, whole: BoolArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Records cut at the times within them: number of the record, begin and end of each piece."""
    first = np.searchsorted(times, begin + INSTANT, side="right")
    cuts = np.searchsorted(times, end - INSTANT, side="left") - first
    cuts = np.where(whole, 0, np.maximum(cuts, 0))
    which = np.repeat(np.arange(len(begin)), cuts + 1)
    opening = np.concatenate([[0], np.cumsum(cuts + 1)[:-1]])
    place = np.arange(len(which)) - opening[which]
    t_from, t_to = begin[which], end[which]
    inner = place > 0
    t_from[inner] = times[(first[which] + place - 1)[inner]]
    ended = place < cuts[which]
    t_to[ended] = times[(first[which] + place)[ended]]
    return which, t_from, t_to


def _pieces(records: Odometry, options: Options, which: IntArray, share: FloatArray) -> Steps:
    """Shares of records, as if their twists had been constant."""
    covariance = odometry_covariances(records, options)
    planar = records.dimension == 2 and options.node != "pose3"
    if records.dimension == 2 and not planar:
        covariance = in_space(covariance)
    turn = share[:, None] * records.rotation_vector[which]
    way = records.translation[which]
    parted = share < 1.0
    if parted.any():
        # A twist's way is the slope of its turn times its velocity.
        whole = lie.rotation_slope_inverse(-records.rotation_vector[which][parted])
        velocity = np.einsum("mij,mj->mi", whole, way[parted])
        along = lie.rotation_slope(-turn[parted])
        way[parted] = share[parted, None] * np.einsum("mij,mj->mi", along, velocity)
    noise = share[:, None, None] * covariance[which]
    if planar:
        return Steps(turn[:, 2], way[:, :2], noise)
    return Steps(lie.rotation(turn), way, noise)


def composed(pieces: Steps, group: IntArray) -> Steps:
    """Steps of each group put one after the other.

    Parameters
    ----------
    pieces : Steps
        In order.
    group : array of int, shape (M,)
        Whose each one is, not decreasing.
    """
    return _in_plane(pieces, group) if pieces.planar else _in_pairs(pieces, group)


def _in_plane(pieces: Steps, group: IntArray) -> Steps:
    """In the plane the poses of all steps in a row are sums: each group is what lies between two.

    A step's noise is seen from its group's end, where all of them add.
    """
    opens = np.concatenate([[True], group[1:] != group[:-1]])
    first = np.flatnonzero(opens)
    last = np.append(first[1:], len(group)) - 1
    yaw = np.concatenate([[0.0], np.cumsum(pieces.rotation)])
    place = np.concatenate([np.zeros((1, 2)), np.cumsum(_turned(yaw[:-1], pieces.way), axis=0)])
    end = last[np.cumsum(opens) - 1] + 1
    after = np.arange(len(group)) + 1
    rest = Steps(
        yaw[end] - yaw[after], _turned(-yaw[after], place[end] - place[after]), pieces.covariance
    )
    carry = rest.backward()
    seen = carry @ pieces.covariance @ np.swapaxes(carry, 1, 2)
    turn, way = yaw[last + 1] - yaw[first], _turned(-yaw[first], place[last + 1] - place[first])
    # What stands alone stays as it is, to the last bit.
    lone = first == last
    turn[lone], way[lone] = pieces.rotation[first[lone]], pieces.way[first[lone]]
    return Steps(turn, way, np.add.reduceat(seen, first, axis=0))


def _turned(angle: FloatArray, v: FloatArray) -> FloatArray:
    """Vectors (M, 2) turned counter-clockwise."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([cos * v[:, 0] - sin * v[:, 1], sin * v[:, 0] + cos * v[:, 1]], axis=1)


def _in_pairs(pieces: Steps, group: IntArray) -> Steps:
    """Neighbours are joined pairwise until one is left of each group.

    As many passes as the longest group has binary digits.
    """
    while True:
        opens = np.concatenate([[True], group[1:] != group[:-1]])
        if opens.all():
            return pieces
        first = np.flatnonzero(opens)
        rank = np.arange(len(group)) - first[np.cumsum(opens) - 1]
        lead = rank % 2 == 0
        paired = np.flatnonzero(lead & np.append(~opens[1:], False))
        joined = pieces[paired].then(pieces[paired + 1])
        rotation, way, covariance = (
            part.copy() for part in (pieces.rotation, pieces.way, pieces.covariance)
        )
        rotation[paired], way[paired] = joined.rotation, joined.way
        covariance[paired] = joined.covariance
        pieces, group = Steps(rotation, way, covariance)[lead], group[lead]


def _records(t_from: FloatArray, t_to: FloatArray, steps: Steps) -> Odometry:
    signs = _SIGNS if steps.planar else np.tile(_SIGNS, 2)
    covariance = 0.5 * (steps.covariance + np.swapaxes(steps.covariance, 1, 2))
    covariance *= np.outer(signs, signs)
    common = {
        "t_from": t_from,
        "t_to": t_to,
        "forward": steps.way[:, 0],
        "right": -steps.way[:, 1],
        "covariance": covariance,
    }
    if steps.planar:
        over: FloatArray = np.remainder(steps.rotation + np.pi, 2.0 * np.pi) - np.pi
        # What is no more than half a turn stays as it is, to the last bit.
        turn = np.where(np.abs(steps.rotation) > np.pi, over, steps.rotation)
        return Odometry.unchecked(**common, about_down=-turn)
    about = lie.rotation_vector(steps.rotation) * _SIGNS
    return Odometry.unchecked(
        **common,
        down=-steps.way[:, 2],
        about_forward=about[:, 0],
        about_right=about[:, 1],
        about_down=about[:, 2],
    )
