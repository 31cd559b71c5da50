"""Robust losses: derivative, efficiency, limits."""

import numpy as np
import pytest
from scipy.stats import norm

from ubl_graph.errors import ConfigurationError
from ubl_graph.factors.loss import WIDTHS, RobustLoss
from ubl_graph.options import Options

NAMES = pytest.mark.parametrize("name", list(WIDTHS))
R = np.linspace(-30.0, 30.0, 60_001)
#: Far beyond all widths, and beyond what any record can be off by in standard deviations.
FAR = np.array([1e3, 1e6, 1e10, -1e10])


@NAMES
@pytest.mark.parametrize("widening", [1.0, 3.0, 0.5])
def test_weight_is_the_derivative_of_the_cost_over_the_residual(name, widening):
    loss = RobustLoss(name).widened(widening)
    slope = np.gradient(loss.cost(R), R, edge_order=2)
    kinks = np.abs(np.abs(R) - loss.width) < 0.01
    np.testing.assert_allclose(slope[~kinks], (loss.weights(R) * R)[~kinks], atol=6e-4)


@NAMES
def test_half_the_square_of_the_shaped_residual_is_the_cost(name):
    loss = RobustLoss(name)
    np.testing.assert_allclose(0.5 * loss.shaped(R) ** 2, loss.cost(R), rtol=1e-12)
    assert (np.sign(loss.shaped(R)) == np.sign(R)).all()


@NAMES
def test_small_residuals_cost_their_half_square(name):
    small = np.array([1e-4, -1e-4, 1e-9])
    np.testing.assert_allclose(RobustLoss(name).cost(small), 0.5 * small**2, rtol=1e-6)


@NAMES
def test_a_weight_is_between_nothing_and_one_however_far(name):
    loss = RobustLoss(name)
    for r in (R, FAR):
        weights = loss.weights(r)
        assert ((weights >= 0.0) & (weights <= 1.0)).all()
        assert np.isfinite(loss.shaped(r)).all()
        assert (loss.curvature(r) >= 0.0).all()
        assert np.isfinite(loss.curvature(r)).all()


@NAMES
def test_cost_never_falls_with_the_residual(name):
    cost = RobustLoss(name).cost(np.concatenate([R[R >= 0.0], FAR[:3]]))
    assert (np.diff(cost) >= -1e-12).all()


@pytest.mark.parametrize(
    ("name", "most"),
    [
        ("geman_mcclure", WIDTHS["geman_mcclure"] ** 2 / 2.0),
        ("tukey", WIDTHS["tukey"] ** 2 / 6.0),
        ("dcs", 1.5 * WIDTHS["dcs"] ** 2),
    ],
)
def test_bounded_losses_have_a_highest_cost(name, most):
    np.testing.assert_allclose(RobustLoss(name).cost(FAR[1:]), most, rtol=1e-6)


@pytest.mark.parametrize("name", [n for n in WIDTHS if n != "none"])
def test_width_gives_95_percent_efficiency_on_normal_noise(name):
    """Asymptotic efficiency E[psi']^2 / E[psi^2] of the M-estimator, by quadrature."""
    r = np.linspace(-10.0, 10.0, 400_001)
    step, density = r[1] - r[0], norm.pdf(r)
    psi = RobustLoss(name).weights(r) * r
    slope = np.gradient(psi, r)
    efficiency = (slope * density).sum() ** 2 * step / (psi**2 * density).sum()
    assert efficiency == pytest.approx(0.95, abs=1e-4)


@pytest.mark.parametrize("name", ["cauchy", "geman_mcclure", "dcs", "tukey"])
def test_an_outlier_has_less_pull_the_farther_out_it_is(name):
    pull = RobustLoss(name).weights(np.array([10.0, 100.0])) * [10.0, 100.0]
    assert pull[1] < pull[0] or pull[1] == pull[0] == 0.0


@NAMES
def test_a_widened_loss_is_the_loss_in_other_units(name):
    """w^2 rho(r / w), so that small residuals cost what they did."""
    loss, wide = RobustLoss(name), RobustLoss(name).widened(2.0).widened(3.5)
    np.testing.assert_allclose(wide.cost(R), 49.0 * loss.cost(R / 7.0), rtol=1e-12)
    np.testing.assert_allclose(wide.weights(R), loss.weights(R / 7.0), rtol=1e-12)
    np.testing.assert_allclose(wide.curvature(R), loss.curvature(R / 7.0), rtol=1e-9, atol=1e-12)


@NAMES
def test_newton_takes_the_second_derivative_where_it_is_well_above_nothing(name):
    loss = RobustLoss(name)
    second = np.gradient(loss.weights(R) * R, R, edge_order=2)
    kinks = np.abs(np.abs(R) - loss.width) < 0.01
    curved = (second > 0.26 * loss.weights(R)) & ~kinks
    assert curved.any()
    np.testing.assert_allclose(loss.curvature(R)[curved], second[curved], atol=2e-3)


def test_options_take_every_loss_and_no_other():
    assert {Options(loss=name).loss for name in WIDTHS} == set(WIDTHS)
    with pytest.raises(ConfigurationError, match="tukey"):
        Options(loss="welsch")
