"""Rays that turn once beyond the faster end: ends at nearly the same depth, with a gradient."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ubl_graph.acoustics.profile import Nodes
from ubl_graph.acoustics.rays import GRAZING, MISS, Rays, layer_times, stack
from ubl_graph.arrays import FloatArray, IntArray

_TURNING = 60  # bound on the bracketed steps, of which 8 are usual; random profiles took 41
SAMPLES = np.linspace(0.0, 1.0, 7)  # where X is looked at while a ray turns within one layer


class _Turns(NamedTuple):
    """Rays that pass the lower end, turn in a given layer below, and come back to the lower end.

    One column for each of P pairs of a row and a layer. The cosine w = sqrt(1 - p^2 c_r^2) at the
    speed c_r above which a ray turns in the layer, and no earlier, runs from 0 to `widest`; in w
    the reach X(w) is smooth, though not monotonic: it falls where the gradient grows with depth.
    """

    row: IntArray  # (P,)
    thickness: FloatArray  # (K + 1, P) of the layers passed; those below the lower end twice
    speed: FloatArray  # (K + 2, P) at their ends; the last is where the layer of turning starts
    e: FloatArray  # (K + 2, P) 1 - (speed / c_r)^2
    reference: FloatArray  # (P,) c_r
    gradient: FloatArray  # (P,) of the layer of turning, positive
    widest: FloatArray  # (P,)
    lower_end: int  # row of `speed` that is the lower end

    def pick(self, columns: IntArray) -> _Turns:
        """Return some of the pairs."""
        return _Turns(
            self.row[columns],
            self.thickness[:, columns],
            self.speed[:, columns],
            self.e[:, columns],
            self.reference[columns],
            self.gradient[columns],
            self.widest[columns],
            self.lower_end,
        )

    def tangents(self, w: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return p (P,), the cosines (K + 2, P) and the chords' dx/dz (K + 1, P)."""
        sine = (1.0 - w) * (1.0 + w)
        cosine = np.sqrt(w * w + sine * self.e)
        p = np.sqrt(sine) / self.reference
        both = np.maximum(cosine[:-1] + cosine[1:], 1.0 / GRAZING)
        return p, cosine, p * (self.speed[:-1] + self.speed[1:]) / both

    def reach(self, w: FloatArray) -> FloatArray:
        """Return X(w), (P,)."""
        p, cosine, tangent = self.tangents(w)
        layers = np.add.reduce(self.thickness * tangent)
        return layers + 2.0 * cosine[-1] / (p * self.gradient)

    def rays(self, w: FloatArray, away: FloatArray) -> Rays:
        """Return the rays, their time brought from X(w) to the distance `away`."""
        p, cosine, tangent = self.tangents(w)
        arc = 2.0 * np.arctanh(cosine[-1]) / self.gradient
        time = layer_times(self.thickness, self.speed, tangent) + arc
        ends = [0, self.lower_end]
        return Rays(time + p * (away - self.reach(w)), p, cosine[ends] / self.speed[ends])


def turns_below(
    nodes: Nodes, depth: FloatArray, away: FloatArray, ceiling: FloatArray
) -> _Turns | None:
    """Pairs of rows and layers for which a turning ray can be faster than the time `ceiling`."""
    z, c, gradient = nodes
    ends = np.interp(depth, z, c)
    first = z.searchsorted(np.fmin.reduce(depth[1]), "right")
    thickness, speed = stack(z, c, depth, ends)
    # Only from an end that is the fastest place between the two can a ray go on outward.
    open_ = np.maximum.reduce(speed) <= ends[1]
    if first >= z.size or not open_.any():
        return None
    below = z[first:, None] > depth[1]
    deeper = np.concatenate((depth[1:], np.maximum(z[first:, None], depth[1])))
    faster = np.concatenate((ends[1:], np.where(below, c[first:, None], ends[1])))
    # A ray turns at the first depth where c = 1/p, so in a layer that brings a new maximum.
    record = np.maximum.accumulate(faster)
    # It is no shorter than the straight line folded at that layer, and nowhere faster than c
    # where it turns.
    shortest = np.hypot(away, 2.0 * deeper[:-1] - depth[0] - depth[1])
    layer, row = np.nonzero((faster[1:] > record[:-1]) & open_ & (shortest <= ceiling * faster[1:]))
    if not row.size:
        return None
    reference, entry, end = record[layer, row], faster[layer, row], faster[layer + 1, row]
    out, out_speed = stack(
        z, c, np.stack((depth[1, row], deeper[layer, row])), np.stack((ends[1, row], entry))
    )
    speeds = np.concatenate((speed[:, row], out_speed))
    return _Turns(
        row=row,
        # The lower end stands twice, with a layer of no thickness between.
        thickness=np.concatenate((thickness[:, row], np.zeros((1, row.size)), 2.0 * out)),
        speed=speeds,
        e=(reference - speeds) * (reference + speeds) / (reference * reference),
        reference=reference,
        gradient=gradient[first + layer],
        widest=np.sqrt((end - reference) * (end + reference)) / end,
        lower_end=speed.shape[0] - 1,
    )


def turning_rays(nodes: Nodes, depth: FloatArray, away: FloatArray, ceiling: FloatArray) -> Rays:
    """First arrivals among the rays that turn below both ends; infinite times where is none."""
    rows = away.size
    result = Rays(np.full(rows, np.inf), np.zeros(rows), np.zeros((2, rows)))
    turns = turns_below(nodes, depth, away, ceiling)
    if turns is None:
        return result
    # Every change of sign of X - away between samples of a layer brackets a ray.
    distance = away[turns.row]
    samples = SAMPLES[:, None] * turns.widest
    excess = np.stack([turns.reach(w) for w in samples]) - distance
    place, column = np.nonzero((excess[:-1] <= 0.0) != (excess[1:] <= 0.0))
    if not column.size:
        return result
    turns, distance = turns.pick(column), distance[column]
    w = _bracketed(
        turns,
        distance,
        (samples[place, column], samples[place + 1, column]),
        (excess[place, column], excess[place + 1, column]),
    )
    rays = turns.rays(w, distance)
    early = np.flatnonzero(rays.time <= ceiling[turns.row] * (1.0 + 1e-12))
    order = early[np.argsort(-rays.time[early], kind="stable")]
    row = turns.row[order]  # of several values for one row the last stays, the fastest
    result.time[row], result.p[row] = rays.time[order], rays.p[order]
    result.vertical[:, row] = rays.vertical[:, order]
    return result


def _bracketed(
    turns: _Turns,
    distance: FloatArray,
    bracket: tuple[FloatArray, FloatArray],
    excess: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """Solve X(w) = distance by the Illinois method, with a bisection every eighth step."""
    (left, right), (f_left, f_right) = bracket, excess
    w, moved_left = left, np.zeros(left.size, dtype=np.bool_)
    for k in range(_TURNING):
        secant = right - f_right * (right - left) / (f_right - f_left)
        inside = (secant - left) * (secant - right) < 0.0
        middle = 0.5 * (left + right)
        w = middle if k % 8 == 7 else np.where(inside, secant, middle)
        f = turns.reach(w) - distance
        if (np.abs(f) <= 1e-3 * MISS * distance).all():
            break
        moves_left = (f <= 0.0) == (f_left <= 0.0)
        # An end kept twice running has its value halved, or it would never move.
        again = np.where(moves_left == moved_left, 0.5, 1.0) if k else 1.0
        left, right = np.where(moves_left, w, left), np.where(moves_left, right, w)
        f_left = np.where(moves_left, f, again * f_left)
        f_right = np.where(moves_left, again * f_right, f)
        moved_left = moves_left
    return w
