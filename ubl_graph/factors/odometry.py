"""DVL odometry: high-rate body velocities preintegrated into displacements between nodes.

The DVL's velocity in world axes, u = R(t) v(t), is taken as piecewise linear between samples and
integrated once, exactly; a node interval's displacement is the difference of two values of that
integral. Errors of the DVL enter linearly (first order in the angles): with measured v

    v_true = (1 + scale) v + misalignment x v + bias

in forward-left-up axes, so that the same running integral, taken of R v, of R [-v]x and of R,
holds the displacement and its derivatives. What the heading reference reads too much turns the way
about the vertical instead: the two differ as soon as the vehicle rolls or pitches. Where it wanders
every node has its own, and over an interval the mean of both ends counts. A lever arm r of the DVL
adds (R1 - R0) r, and the current, for velocities relative to the water, its mean times dt.

To first order a way turned by b is too long by b^2 / 2, which goes into the scale: 6e-4 at 2
degrees, a fifth of a good DVL's sigma; 4e-3 at 5 degrees, more than that sigma. Where a heading
reference may be off by more, nodes should be poses: their residuals are not linear in the bias.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ubl_graph.arrays import BoolArray, FloatArray, IntArray
from ubl_graph.attitude import AttitudeTrack
from ubl_graph.factors.block import LinearBlock
from ubl_graph.frames import body_vector
from ubl_graph.layout import Chain, Layout
from ubl_graph.measurements import Velocity

#: A gap between samples longer than this many median sample intervals interrupts the odometry,
GAP_FACTOR = 5.0
#: but never one shorter than this, s.
MIN_GAP = 1.0

#: The states of odometry with their sizes: the DVL's errors, and what the heading reference reads
#: too much. All nodes share them, but for a heading bias that wanders.
DVL_STATES = (("dvl_scale", 1), ("dvl_misalignment", 3), ("dvl_bias", 3), ("heading_bias", 1))


@dataclass(frozen=True, eq=False)
class Displacements:
    """Preintegrated velocities over M intervals.

    Attributes
    ----------
    displacement : array, shape (M, 3)
        East, north, up of the DVL, m.
    by_misalignment : array, shape (M, 3, 3)
        Derivative by the misalignment angles, m/rad.
    by_bias : array, shape (M, 3, 3)
        Derivative by the bias, s.
    sigma : array, shape (M,)
        Standard deviation of each component, m.
    covered : array of bool, shape (M,)
        Whether samples cover the whole interval without a gap.
    """

    displacement: FloatArray
    by_misalignment: FloatArray
    by_bias: FloatArray
    sigma: FloatArray
    covered: BoolArray


class Preintegration:
    """Running integral of DVL velocities in world axes.

    Parameters
    ----------
    velocity : Velocity
        Samples of one reference (all bottom or all water), in any order of time.
    attitude : AttitudeTrack
        Of the vehicle.
    psd : float
        What the velocity does between two samples: white acceleration noise, m^2/s^3.
    longest_gap : float, optional
        Samples farther apart do not join, s; left out, the samples' own rate says it.
    """

    def __init__(
        self,
        velocity: Velocity,
        attitude: AttitudeTrack,
        psd: float,
        longest_gap: float | None = None,
    ) -> None:
        rows = velocity[np.argsort(velocity.t)]
        self.t: FloatArray = rows.t
        body = body_vector(rows.forward, rows.right, rows.down)
        rotation = attitude.at(self.t)
        cross = _cross_matrices(body)
        # World velocity, its derivative by misalignment and by bias, as 3 + 9 + 9 columns.
        self._rates = np.concatenate(
            [
                np.einsum("mij,mj->mi", rotation, body),
                -(rotation @ cross).reshape(-1, 9),
                rotation.reshape(-1, 9),
            ],
            axis=1,
        )
        gaps = np.diff(self.t)
        self.longest_gap = longest_gap_of(gaps) if longest_gap is None else longest_gap
        self._open = gaps <= self.longest_gap
        self._integral = _running(gaps[:, None] * (self._rates[1:] + self._rates[:-1]) / 2.0)
        # White sample noise held over a gap, and what linear interpolation in the gap misses.
        noise = (rows.sigma[1:] ** 2 + rows.sigma[:-1] ** 2) / 2.0
        self._variance = _running((noise * gaps**2 + psd * gaps**3 / 12.0)[:, None])[:, 0]
        self._missing = _running(np.where(self._open, 0.0, gaps)[:, None])[:, 0]
        self._sigma: FloatArray = rows.sigma

    def breaks(self) -> FloatArray:
        """Sample times at which coverage starts or ends, s: nodes should stand there."""
        closed = np.flatnonzero(~self._open)
        return self.t[np.concatenate([[0], closed, closed + 1, [len(self.t) - 1]])]

    def missing(self, t0: float, t1: float) -> float:
        """Seconds of the interval from `t0` to `t1` that no samples cover."""
        times = np.array([t0, t1])
        outside = np.maximum(self.t[0] - times, 0.0) - np.maximum(times - self.t[-1], 0.0)
        gaps = self._integrals_at(np.clip(times, self.t[0], self.t[-1]))[2]
        return float(outside[0] - outside[1] + gaps[1] - gaps[0])

    def between(self, t0: FloatArray, t1: FloatArray) -> Displacements:
        """Displacements of the DVL from `t0` to `t1`, (M,) each, s."""
        first, last = self._integrals_at(t0), self._integrals_at(t1)
        d = last[0] - first[0]
        variance = last[1] - first[1]
        missing = last[2] - first[2]
        covered = (t0 >= self.t[0] - 1e-6) & (t1 <= self.t[-1] + 1e-6) & (missing < 1e-6)
        return Displacements(
            d[:, :3],
            d[:, 3:12].reshape(-1, 3, 3),
            d[:, 12:].reshape(-1, 3, 3),
            np.sqrt(np.maximum(variance, 0.0)),
            covered,
        )

    def rates_at(self, t: FloatArray) -> Displacements:
        """The same for rates: velocity of the DVL at times (M,), m/s, and its derivatives."""
        k, s = self._place(t)
        k1 = np.minimum(k + 1, len(self.t) - 1)
        rates = (1.0 - s)[:, None] * self._rates[k] + s[:, None] * self._rates[k1]
        near = np.where(s < 0.5, k, k1)
        open_ = np.append(self._open, False)[k] | (s == 0.0) | (s == 1.0)
        covered = (t >= self.t[0] - 1e-6) & (t <= self.t[-1] + 1e-6) & open_
        return Displacements(
            rates[:, :3],
            rates[:, 3:12].reshape(-1, 3, 3),
            rates[:, 12:].reshape(-1, 3, 3),
            self._sigma[near],
            covered,
        )

    def _place(self, t: FloatArray) -> tuple[IntArray, FloatArray]:
        if len(self.t) == 1:
            return np.zeros(len(t), dtype=np.int64), np.zeros(len(t))
        k = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 2)
        s = np.clip((t - self.t[k]) / (self.t[k + 1] - self.t[k]), 0.0, 1.0)
        return k, s

    def _integrals_at(self, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Integral of the rates, variance and missing time from the first sample up to `t`."""
        k, s = self._place(t)
        k1 = np.minimum(k + 1, len(self.t) - 1)
        h = (self.t[k1] - self.t[k])[:, None]
        f = s[:, None]
        part = h * f * ((1.0 - f / 2.0) * self._rates[k] + f / 2.0 * self._rates[k1])
        variance = self._variance[k] + s * (self._variance[k1] - self._variance[k])
        missing = self._missing[k] + s * (self._missing[k1] - self._missing[k])
        return self._integral[k] + part, variance, missing


def longest_gap_of(gaps: FloatArray) -> float:
    """Longest gap (s) that samples bridge, by the times between them, shape (M,), s."""
    typical = float(np.median(gaps)) if len(gaps) else 1.0
    return max(GAP_FACTOR * typical, MIN_GAP)


def odometry(
    layout: Layout,
    chain: Chain,
    samples: Preintegration,
    lever: FloatArray,
    *,
    current: bool,
    heading_walk: float = 0.0,
) -> tuple[LinearBlock, BoolArray]:
    """Displacement rows of every covered interval: p1 - p0 - displacement, 3 each.

    Parameters
    ----------
    layout, chain
        Whose nodes.
    samples : Preintegration
        Of one reference.
    lever : array, shape (N, 3)
        Reference point to DVL at the nodes, world axes, m.
    current : bool
        Whether the velocities are relative to the water.
    heading_walk : float
        Random walk of the heading bias, rad per sqrt(s); counts where it is a state of the nodes.

    Returns
    -------
    LinearBlock, array of bool (N - 1,)
        And which intervals are covered.
    """
    moved = samples.between(chain.t[:-1], chain.t[1:])
    rows = np.flatnonzero(moved.covered)
    k = chain.first + rows
    dt = np.diff(chain.t)[rows]
    eye = np.broadcast_to(np.eye(3), (len(rows), 3, 3))
    columns = [layout.node_columns("position", k), layout.node_columns("position", k + 1)]
    parts = [-eye, eye]
    slopes = _error_slopes(moved, rows)
    for own, part in _error_parts(layout, slopes, (k, k + 1)):
        columns.append(own)
        parts.append(part)
    if current:
        half = np.zeros((len(rows), 3, 2))
        half[:, 0, 0] = half[:, 1, 1] = -dt / 2.0
        for end in (k, k + 1):
            columns.append(layout.node_columns("current", end))
            parts.append(half)
    whitener = np.eye(3) / moved.sigma[rows, None, None]
    if "heading_bias" in dict(layout.slow):
        across = slopes["heading_bias"][:, :, 0] * (heading_walk * np.sqrt(dt / 12.0))[:, None]
        whitener = _widened(moved.sigma[rows], across)
    target = moved.displacement[rows] - (lever[rows + 1] - lever[rows])
    block = LinearBlock(
        "water odometry" if current else "odometry",
        np.concatenate(columns, axis=1),
        whitener @ np.concatenate(parts, axis=2),
        np.einsum("mij,mj->mi", whitener, target),
    )
    return block, moved.covered


def node_velocity(
    layout: Layout,
    chain: Chain,
    samples: Preintegration,
    lever_rate: FloatArray,
    *,
    current: bool,
) -> LinearBlock:
    """Velocity rows at every covered node: v + d(R r)/dt - DVL velocity, 3 each.

    `lever_rate` is the DVL's velocity by rotation about the reference point, (N, 3), m/s.
    """
    rates = samples.rates_at(chain.t)
    rows = np.flatnonzero(rates.covered)
    k = chain.first + rows
    eye = np.broadcast_to(np.eye(3), (len(rows), 3, 3))
    columns = [layout.node_columns("velocity", k)]
    parts = [eye]
    for own, part in _error_parts(layout, _error_slopes(rates, rows), (k,)):
        columns.append(own)
        parts.append(part)
    if current:
        drift = np.zeros((len(rows), 3, 2))
        drift[:, 0, 0] = drift[:, 1, 1] = -1.0
        columns.append(layout.node_columns("current", k))
        parts.append(drift)
    inverse = 1.0 / rates.sigma[rows]
    target = rates.displacement[rows] - lever_rate[rows]
    return LinearBlock(
        "water velocity" if current else "velocity",
        np.concatenate(columns, axis=1),
        np.concatenate(parts, axis=2) * inverse[:, None, None],
        target * inverse[:, None],
    )


def _error_slopes(d: Displacements, rows: IntArray) -> dict[str, FloatArray]:
    """Derivatives of displacement or rate by each DVL state, (M, 3, size)."""
    way = d.displacement[rows]
    # Read too far clockwise, the way must be turned back, counter-clockwise about up.
    by_heading = np.stack([-way[:, 1], way[:, 0], np.zeros(len(way))], axis=1)
    slopes = (way[:, :, None], d.by_misalignment[rows], d.by_bias[rows], by_heading[:, :, None])
    return {name: slope for (name, _), slope in zip(DVL_STATES, slopes, strict=True)}


def _error_parts(
    layout: Layout, slopes: dict[str, FloatArray], nodes: tuple[IntArray, ...]
) -> list[tuple[IntArray, FloatArray]]:
    """Columns of the states that there are, and the rows' parts there.

    Of a state that travels with the nodes the mean over `nodes` counts.
    """
    out: list[tuple[IntArray, FloatArray]] = []
    travelling = dict(layout.slow)
    for name, slope in slopes.items():
        part = -slope * layout.unit(name)
        if name in travelling:
            out += [(layout.node_columns(name, k), part / len(nodes)) for k in nodes]
        elif layout.has(name):
            columns = layout.shared_columns(name)
            out.append((np.broadcast_to(columns, (len(part), len(columns))), part))
    return out


def _widened(sigma: FloatArray, across: FloatArray) -> FloatArray:
    """What whitens noise of covariance sigma^2 I + a a', (M, 3, 3): sigma (M,), a (M, 3).

    A random walk's mean over an interval strays from that of both ends by walk^2 dt / 12.
    """
    length = np.linalg.norm(across, axis=1)
    unit = np.divide(across, length[:, None], out=np.zeros_like(across), where=across != 0.0)
    narrowed = 1.0 - sigma / np.hypot(sigma, length)
    outer = unit[:, :, None] * unit[:, None, :]
    return (np.eye(3) - narrowed[:, None, None] * outer) / sigma[:, None, None]


def _cross_matrices(v: FloatArray) -> FloatArray:
    """[v]x with [v]x w = v x w, shape (M, 3, 3)."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = v[:, 2], -v[:, 1], v[:, 0]
    return out


def _running(steps: FloatArray) -> FloatArray:
    """Cumulative sums from zero along the first axis, one longer than `steps`."""
    return np.concatenate([np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)])
