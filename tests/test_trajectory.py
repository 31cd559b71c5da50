"""Motion priors against their matrix definition, and the trajectory read between nodes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ubl_graph.errors import TimeError
from ubl_graph.trajectory import (
    Trajectory,
    interpolation_variance,
    interpolation_weights,
    locate,
    longest_interval,
    process_noise,
    transition,
    whitening,
)

ORDERS = pytest.mark.parametrize("order", [2, 3])
intervals = st.floats(1e-3, 300.0)
places = st.floats(0.0, 1.0)
MANY = settings(max_examples=80, derandomize=True, deadline=None)


def generator(order: int) -> np.ndarray:
    """Matrix A of dx/dt = A x + white noise on the last component."""
    return np.diag(np.ones(order - 1), 1)


@ORDERS
@given(dt=intervals)
@MANY
def test_transition_and_noise_solve_the_stochastic_differential_equation(order, dt):
    """Van Loan's integral of the noise, by Gauss-Legendre quadrature (exact for polynomials)."""
    nodes, weights = np.polynomial.legendre.leggauss(6)
    s = 0.5 * dt * (nodes + 1.0)
    phi = transition(order, s)
    noise = phi[:, :, -1:] * phi[:, None, :, -1]
    integral = (0.5 * dt * weights[:, None, None] * noise).sum(axis=0)
    np.testing.assert_allclose(process_noise(order, dt)[0], integral, rtol=1e-12)
    slope = (transition(order, dt * (1 + 1e-6)) - transition(order, dt * (1 - 1e-6)))[0]
    expected = generator(order) @ transition(order, dt)[0]
    np.testing.assert_allclose(slope / (2e-6 * dt), expected, rtol=1e-6, atol=1e-8)


@ORDERS
@given(dt=intervals)
@MANY
def test_whitening_makes_the_noise_unit(order, dt):
    w = whitening(order, dt)[0]
    np.testing.assert_allclose(w @ process_noise(order, dt)[0] @ w.T, np.eye(order), atol=1e-9)


@ORDERS
@given(dt=intervals, s=places)
@MANY
def test_interpolation_is_the_conditional_mean_of_the_prior(order, dt, s):
    tau = s * dt
    q, part = process_noise(order, dt)[0], process_noise(order, tau)[0]
    scale = np.diag(dt ** (np.arange(order) - order + 0.5))
    # Conditioning a Gaussian on both ends, scaled so that the inverse is well conditioned.
    inverse = scale @ np.linalg.inv(scale @ q @ scale) @ scale
    psi = part @ transition(order, dt - tau)[0].T @ inverse
    lam = transition(order, tau)[0] - psi @ transition(order, dt)[0]
    for derivative in (0, 1):
        ours = interpolation_weights(order, np.array([dt]), np.array([s]), derivative)[0]
        expected = np.concatenate([lam[derivative], psi[derivative]])
        np.testing.assert_allclose(ours, expected, atol=1e-8 * dt**order, rtol=1e-8)
    left = part - psi @ q @ psi.T
    for derivative in (0, 1):
        ours = interpolation_variance(order, dt, s, derivative)
        variance, whole = left[derivative, derivative], q[derivative, derivative]
        assert ours == pytest.approx(variance, abs=1e-8 * whole)


@ORDERS
def test_interpolation_at_a_node_is_that_node_alone(order):
    weights = interpolation_weights(order, np.array([3.0, 3.0]), np.array([0.0, 1.0]))
    expected = np.zeros((2, 2 * order))
    expected[0, 0] = expected[1, order] = 1.0
    np.testing.assert_array_equal(weights, expected)


@ORDERS
def test_longest_interval_inverts_the_variance_in_the_middle(order):
    dt = longest_interval(order, 2e-3, 0.05)
    assert np.sqrt(2e-3 * interpolation_variance(order, dt, 0.5)) == pytest.approx(0.05)


def polynomial_trajectory(order: int) -> tuple[Trajectory, np.ndarray]:
    """Nodes on a random polynomial that the prior's mean reproduces exactly."""
    rng = np.random.default_rng(3)
    coefficients = rng.normal(size=(2 * order, 3))
    t = np.sort(rng.uniform(0.0, 4.0, 6))
    parts = [
        np.polynomial.polynomial.polyval(t, np.polynomial.polynomial.polyder(coefficients, d)).T
        for d in range(3)
    ]
    covariance = np.tile(np.diag([1.0, 4.0, 9.0]), (6, 1, 1))
    acceleration = parts[2] if order == 3 else None
    return Trajectory(t, parts[0], parts[1], acceleration, covariance, (0.1, 0.3)), coefficients


@ORDERS
def test_trajectory_reproduces_polynomials_between_its_nodes(order):
    trajectory, coefficients = polynomial_trajectory(order)
    times = np.linspace(trajectory.t[0], trajectory.t[-1], 101)
    states = trajectory.at(times)
    polynomial = np.polynomial.polynomial
    np.testing.assert_allclose(
        states.position, polynomial.polyval(times, coefficients).T, atol=1e-9
    )
    velocity = polynomial.polyval(times, polynomial.polyder(coefficients)).T
    np.testing.assert_allclose(states.velocity, velocity, atol=1e-8)


def test_without_joint_covariances_that_of_the_position_is_linear_between_nodes():
    trajectory, _ = polynomial_trajectory(2)
    at_nodes = trajectory.at(trajectory.t)
    np.testing.assert_allclose(at_nodes.covariance, trajectory.covariance, atol=1e-12)
    middle = 0.5 * (trajectory.t[1:] + trajectory.t[:-1])
    between = trajectory.at(middle).covariance
    dt = np.diff(trajectory.t)
    expected = np.array([1.0, 4.0, 9.0]) + (dt**3 / 192)[:, None] * [0.1, 0.1, 0.3]
    np.testing.assert_allclose(np.einsum("nii->ni", between), expected)
    assert np.isnan(at_nodes.velocity_covariance).all()


@pytest.mark.parametrize("t", [-1.0, 9.0, np.nan, np.inf])
def test_times_outside_are_refused(t):
    trajectory, _ = polynomial_trajectory(2)
    with pytest.raises(TimeError, match="outside the trajectory"):
        trajectory.at([1.5, t])


def test_a_single_node_is_read_at_its_time():
    one = Trajectory(
        np.array([5.0]), np.ones((1, 3)), np.zeros((1, 3)), None, np.eye(3)[None], (1.0, 1.0)
    )
    np.testing.assert_array_equal(one.at(5.0).position, np.ones((1, 3)))


def test_locate_snaps_to_nodes_within_a_nanosecond():
    k, dt, s = locate(np.array([0.0, 1.0, 3.0]), np.array([0.0, 1.0 - 1e-10, 1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(k, [0, 0, 1, 1, 1])
    np.testing.assert_array_equal(s, [0.0, 1.0, 0.0, 0.5, 1.0])
    np.testing.assert_array_equal(dt, [1.0, 1.0, 2.0, 2.0, 2.0])
