"""Robust losses: derivative, efficiency, limits."""

import numpy as np
import pytest
from scipy.stats import norm

from ubl_graph.factors.loss import WIDTHS, RobustLoss

NAMES = pytest.mark.parametrize("name", list(WIDTHS))
R = np.linspace(-30.0, 30.0, 60_001)


@NAMES
def test_weight_is_the_derivative_of_the_cost_over_the_residual(name):
    loss = RobustLoss(name)
    slope = np.gradient(loss.cost(R), R, edge_order=2)
    kinks = np.abs(np.abs(R) - WIDTHS[name]) < 0.01
    np.testing.assert_allclose(slope[~kinks], (loss.weights(R) * R)[~kinks], atol=3e-4)


@NAMES
def test_half_the_square_of_the_shaped_residual_is_the_cost(name):
    loss = RobustLoss(name)
    np.testing.assert_allclose(0.5 * loss.shaped(R) ** 2, loss.cost(R), rtol=1e-12)
    assert (np.sign(loss.shaped(R)) == np.sign(R)).all()


@NAMES
def test_small_residuals_cost_their_half_square(name):
    small = np.array([1e-4, -1e-4])
    np.testing.assert_allclose(RobustLoss(name).cost(small), 0.5e-8, rtol=1e-6)


@pytest.mark.parametrize("name", [n for n in WIDTHS if n != "none"])
def test_width_gives_95_percent_efficiency_on_normal_noise(name):
    """Asymptotic efficiency E[psi']^2 / E[psi^2] of the M-estimator, by quadrature."""
    r = np.linspace(-10.0, 10.0, 400_001)
    step, density = r[1] - r[0], norm.pdf(r)
    psi = RobustLoss(name).weights(r) * r
    slope = np.gradient(psi, r)
    efficiency = (slope * density).sum() ** 2 * step / (psi**2 * density).sum()
    assert efficiency == pytest.approx(0.95, abs=1e-4)


@pytest.mark.parametrize("name", ["cauchy", "geman_mcclure", "dcs"])
def test_an_outlier_has_less_pull_the_farther_out_it_is(name):
    pull = RobustLoss(name).weights(np.array([10.0, 100.0])) * [10.0, 100.0]
    assert pull[1] < pull[0]
