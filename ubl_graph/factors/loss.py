"""Robust losses rho(r) of a whitened residual r, and their weights rho'(r)/r.

A GTSAM Robust noise model inside an interpolated factor crashes the process, so the loss sits in
the residual, the same for every solver: `shaped` gives a residual whose square is twice the
cost, `weights` the factors of iteratively re-weighted least squares. Widths give 95 %
efficiency on normal noise.

Source: Zhang 1997, Parameter estimation techniques, sect. 9.4; MacTavish and Barfoot 2015 for
Geman-McClure and DCS as used in SLAM; Yang, Antonante, Tzoumas and Carlone 2020, Graduated
non-convexity, for the widened losses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.options import Loss

#: Width of each loss in standard deviations: 95 % asymptotic efficiency on normal noise,
#: E[psi']^2 / E[psi^2] = 0.95 (solved numerically in tests/test_loss.py).
WIDTHS: dict[str, float] = {
    "none": np.inf,
    "huber": 1.345,
    "cauchy": 2.3849,
    "geman_mcclure": 3.7874,
    "dcs": 1.8983,
    "tukey": 4.6851,
}


@dataclass(frozen=True)
class RobustLoss:
    """A loss by name; see `ubl_graph.options.Options.loss`.

    Attributes
    ----------
    name : str
        cauchy, huber, geman_mcclure, dcs, tukey or none.
    widening : float
        Factor on its width. The wider, the farther out it is convex; at 1 it is the loss itself.
    """

    name: Loss
    widening: float = 1.0

    @property
    def width(self) -> float:
        """Width in standard deviations."""
        return self.widening * WIDTHS[self.name]

    def widened(self, factor: float) -> RobustLoss:
        """The same loss with `factor` times its width."""
        return replace(self, widening=factor * self.widening)

    def cost(self, r: FloatArray) -> FloatArray:
        """rho(r); r^2 / 2 near zero."""
        c = self.width
        q = r * r
        match self.name:
            case "none":
                return 0.5 * q
            case "huber":
                a = np.abs(r)
                return np.where(a <= c, 0.5 * q, c * (a - 0.5 * c))
            case "cauchy":
                return 0.5 * c * c * np.log1p(q / (c * c))
            case "geman_mcclure":
                return 0.5 * q / (1.0 + q / (c * c))
            case "dcs":
                phi = c * c
                return np.where(q <= phi, 0.5 * q, phi * (1.5 * q - 0.5 * phi) / (q + phi))
            case "tukey":
                # c^2/6 (1 - (1 - u)^3), multiplied out: nothing cancels near zero.
                inside = np.minimum(q, c * c)
                u = inside / (c * c)
                return 0.5 * inside * (1.0 - u + u * u / 3.0)

    def weights(self, r: FloatArray) -> FloatArray:
        """rho'(r) / r, 1 near zero: what a residual still counts, 0 to 1."""
        c = self.width
        q = r * r
        match self.name:
            case "none":
                return np.ones_like(r)
            case "huber":
                return c / np.maximum(np.abs(r), c)
            case "cauchy":
                return 1.0 / (1.0 + q / (c * c))
            case "geman_mcclure":
                return 1.0 / (1.0 + q / (c * c)) ** 2
            case "dcs":
                return np.minimum(1.0, 2.0 * c * c / (q + c * c)) ** 2
            case "tukey":
                return np.maximum(1.0 - q / (c * c), 0.0) ** 2

    def curvature(self, r: FloatArray) -> FloatArray:
        """What Newton's method weighs a row by: rho''(r), where it is not much below the weight.

        Where it is less than a quarter of that, or negative, the weight itself stands in: a step
        must not take a far row for one that does not pull.
        """
        weight, second = self.weights(r), self._second_derivative(r)
        return np.where(second > 0.25 * weight, second, weight)

    def _second_derivative(self, r: FloatArray) -> FloatArray:
        """rho''(r)."""
        c = self.width
        q = r * r
        u = q / (c * c)
        match self.name:
            case "none":
                return np.ones_like(r)
            case "huber":
                return (u <= 1.0).astype(np.float64)
            case "cauchy":
                return (1.0 - u) / (1.0 + u) ** 2
            case "geman_mcclure":
                return (1.0 - 3.0 * u) / (1.0 + u) ** 3
            case "dcs":
                phi = c * c
                return np.where(q <= phi, 1.0, 4.0 * phi**2 * (phi - 3.0 * q) / (q + phi) ** 3)
            case "tukey":
                return np.where(u <= 1.0, (1.0 - u) * (1.0 - 5.0 * u), 0.0)

    def shaped(self, r: FloatArray) -> FloatArray:
        """sign(r) sqrt(2 rho(r)): half its square is the cost."""
        return np.sign(r) * np.sqrt(2.0 * self.cost(r))
