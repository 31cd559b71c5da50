"""Gyro rates integrated into turns between nodes, with what a bias of the rates adds to them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from ubl_graph import lie
from ubl_graph.arrays import BoolArray, FloatArray
from ubl_graph.factors.odometry import longest_gap_of
from ubl_graph.measurements import AngularRate


@dataclass(frozen=True, eq=False)
class Turns:
    """Integrated rates over M intervals.

    Attributes
    ----------
    rotation : array, shape (M, 3, 3)
        Axes at the begin of the interval to those at its end.
    by_bias : array, shape (M, 3, 3)
        What a constant bias of the rates adds, in the axes at the end, s.
    sigma : array, shape (M,)
        Standard deviation about each axis, rad.
    covered : array of bool, shape (M,)
        Whether samples cover the whole interval without a gap.
    """

    rotation: FloatArray
    by_bias: FloatArray
    sigma: FloatArray
    covered: BoolArray


class GyroTrack:
    """Rates integrated from the first sample on.

    Between two samples the rate is their mean. White noise of the samples counts as held for the
    time between them.

    Parameters
    ----------
    rates : AngularRate
        In any order of time, two at the least.
    longest_gap : float, optional
        Samples farther apart do not join, s; left out, the samples' own rate says it.
    """

    def __init__(self, rates: AngularRate, longest_gap: float | None = None) -> None:
        rows = rates[np.argsort(rates.t)]
        self.t: FloatArray = rows.t
        self._rate: FloatArray = rows.rate
        self._sigma: FloatArray = rows.sigma
        gaps = np.diff(self.t)
        self._open = gaps <= (longest_gap_of(gaps) if longest_gap is None else longest_gap)
        steps = lie.rotation(gaps[:, None] * 0.5 * (self._rate[1:] + self._rate[:-1]))
        matrices = np.empty((len(self.t), 3, 3))
        matrices[0] = np.eye(3)
        for k, step in enumerate(steps):
            matrices[k + 1] = matrices[k] @ step
        #: Rotations to the axes at the first sample.
        self.rotations = Rotation.from_matrix(matrices)
        self._slerp = Slerp(self.t, self.rotations)
        area = 0.5 * gaps[:, None, None] * (matrices[1:] + matrices[:-1])
        self._integral = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(area, axis=0)])
        noise = 0.5 * (rows.sigma[1:] ** 2 + rows.sigma[:-1] ** 2) * gaps**2
        self._variance = np.concatenate([[0.0], np.cumsum(noise)])
        self._missing = np.concatenate([[0.0], np.cumsum(np.where(self._open, 0.0, gaps))])

    def between(self, t0: FloatArray, t1: FloatArray) -> Turns:
        """Turns from `t0` to `t1`, (M,) each, s."""
        first, last = (np.clip(t, self.t[0], self.t[-1]) for t in (t0, t1))
        before, after = self._slerp(first).as_matrix(), self._slerp(last).as_matrix()
        area = self._integral_at(last) - self._integral_at(first)
        variance = self._at(self._variance, last) - self._at(self._variance, first)
        missing = self._at(self._missing, last) - self._at(self._missing, first)
        covered = (t0 >= self.t[0] - 1e-6) & (t1 <= self.t[-1] + 1e-6) & (missing < 1e-6)
        least = self._sigma.min() ** 2 * 1e-6
        return Turns(
            np.swapaxes(before, 1, 2) @ after,
            np.swapaxes(after, 1, 2) @ area,
            np.sqrt(np.maximum(variance, least)),
            covered,
        )

    def rates_at(self, t: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Rates (M, 3) at times (M,), rad/s, their standard deviations, and which there are."""
        inside = (t >= self.t[0] - 1e-6) & (t <= self.t[-1] + 1e-6)
        held = np.clip(t, self.t[0], self.t[-1])
        rate = np.stack([self._at(axis, held) for axis in self._rate.T], axis=1)
        k = np.clip(np.searchsorted(self.t, held, side="right") - 1, 0, len(self.t) - 2)
        on_sample = (np.abs(held - self.t[k]) < 1e-9) | (np.abs(held - self.t[k + 1]) < 1e-9)
        return rate, self._at(self._sigma, held), inside & (self._open[k] | on_sample)

    def _at(self, values: FloatArray, t: FloatArray) -> FloatArray:
        return np.interp(t, self.t, values)

    def _integral_at(self, t: FloatArray) -> FloatArray:
        flat = self._integral.reshape(len(self.t), 9)
        return np.stack([self._at(column, t) for column in flat.T], axis=1).reshape(-1, 3, 3)
