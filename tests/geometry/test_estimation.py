"""Estimation: least squares are compared with SciPy and dense algebra, the backward pass with one joint Gaussian."""

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from psotrack.geometry.estimation import (
    NormalEquations,
    backward_step,
    cauchy_loss,
    cauchy_weight,
    covariance_from_information,
    levenberg_marquardt,
)

TIME_S = np.linspace(0.0, 3.0, 25)


def curve(params):
    """(..., times), the values amplitude · exp(-rate t) + offset, and their derivatives, (..., times, 3)."""
    amplitude, rate, offset = (params[..., k, None] for k in range(3))
    decay = np.exp(-rate * TIME_S)
    slopes = np.stack([decay, -amplitude * TIME_S * decay, np.ones_like(decay)], axis=-1)
    return amplitude * decay + offset, slopes


@dataclass(frozen=True)
class Curves:
    """Problem of fitting a curve to values.

    Attributes:
        params: (3,), amplitude, rate and offset.
        values: (times,), the values to fit.
        robust: whether the loss is Cauchy's instead of squares.
    """

    params: np.ndarray
    values: np.ndarray
    robust: bool = False

    @property
    def squares(self):
        return (self.values - curve(self.params)[0]) ** 2

    @property
    def cost(self):
        loss = cauchy_loss(self.squares) if self.robust else self.squares
        return loss.sum(axis=-1)

    def equations(self):
        predicted, slopes = curve(self.params)
        weights = cauchy_weight(self.squares) if self.robust else np.ones(self.squares.shape)
        weighted = (slopes * weights[..., None]).swapaxes(-1, -2)
        return NormalEquations(weighted @ slopes, np.matvec(weighted, self.values - predicted))

    def moved(self, step):
        return replace(self, params=self.params + step.shared)


def measured_curves(count):
    """Values with noise of some curves."""
    rng = np.random.default_rng(1)
    params = rng.uniform((2, 0.5, -1), (5, 2, 1), (count, 3))
    return curve(params)[0] + rng.normal(0, 0.1, (count, len(TIME_S)))


@pytest.mark.parametrize("robust", [False, True])
def test_a_fit_equals_scipys(robust):
    (values,) = measured_curves(1)
    if robust:
        values[[3, 11]] += [20.0, -30.0]
    start = Curves(np.array([1.0, 0.1, 0.0]), values, robust)
    found = levenberg_marquardt(start, max_steps=200, least_gain=1e-14)
    expected = least_squares(
        lambda params: curve(params)[0] - values,
        start.params,
        lambda params: curve(params)[1],
        loss="cauchy" if robust else "linear",
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-12,
    )
    # Reweighted steps converge linearly, so the last digits of the parameters differ.
    np.testing.assert_allclose(found.params, expected.x, atol=1e-5 if robust else 1e-8)
    assert found.cost == pytest.approx(2 * expected.cost, rel=1e-9)


def test_no_step_raises_a_cost():
    starts = np.random.default_rng(3).uniform((0, 0.1, -1), (5, 2, 1), (20, 3))
    for params, values in zip(starts, measured_curves(20), strict=True):
        state = Curves(params, values)
        for steps in (1, 2, 3, 5, 8):
            after = levenberg_marquardt(state, max_steps=steps)
            assert after.cost <= state.cost
            state = after


def coupled_equations(blocks=5, m=3, n=4):
    """Normal equations with blocks, and the same equations as a dense matrix and its right side."""
    rng, cut = np.random.default_rng(5), blocks * m
    J = np.zeros((blocks, 10, cut + n))
    diagonal = [slice(k * m, k * m + m) for k in range(blocks)]
    for rows, columns in zip(J, diagonal, strict=True):
        rows[:, columns], rows[:, cut:] = rng.normal(size=(10, m)), rng.normal(size=(10, n))
    J = J.reshape(10 * blocks, cut + n)
    A, b = J.T @ J, J.T @ rng.normal(size=10 * blocks)
    own = np.stack([A[rows, rows] for rows in diagonal])
    between = A[:cut, cut:].reshape(blocks, m, n)
    return NormalEquations(A[cut:, cut:], b[cut:], own, b[:cut].reshape(blocks, m), between), A, b


def test_elimination_of_blocks_gives_the_dense_solution_and_covariance():
    equations, A, b = coupled_equations()
    for damping in (0.0, 0.3):
        step = equations.damped(damping).solved()
        expected = np.linalg.solve(A + damping * np.diag(np.diag(A)), b)
        np.testing.assert_allclose(np.append(step.blocks, step.shared), expected, atol=1e-10)
    found = covariance_from_information(equations.reduced().information)
    np.testing.assert_allclose(found, np.linalg.inv(A)[15:, 15:], rtol=1e-9, atol=1e-12)


def test_an_undetermined_unknown_has_no_covariance_and_is_not_moved():
    information = np.array([[4.0, 0.0], [0.0, 0.0]])
    with pytest.raises(np.linalg.LinAlgError):
        covariance_from_information(information)
    nearly = np.array([[1.0, 1.0], [1.0, 1.0 + 1e-9]])
    assert covariance_from_information(nearly)[0, 0] > 1e8
    with pytest.raises(np.linalg.LinAlgError):
        covariance_from_information(nearly, largest_inflation=1e6)
    step = NormalEquations(information, np.array([2.0, 0.0])).damped(1e-9).solved()
    np.testing.assert_allclose(step.shared, [0.5, 0.0], rtol=1e-8)


@pytest.mark.parametrize("xp", [np, jnp])
def test_the_backward_step_conditions_on_the_next_frame(xp):
    """The smoothed first of two frames is the Gaussian conditioned on a measurement of the second frame.

    A component without variance, and without a transition into other components, is not changed.
    """
    rng = np.random.default_rng(9)
    n = 4
    root, noise_root, F = rng.normal(size=(n, n)), rng.normal(size=(n, n)), rng.normal(size=(n, n))
    P, Q = root @ root.T, noise_root @ noise_root.T
    for matrix in (P, Q, F):
        matrix[3], matrix[:, 3] = 0.0, 0.0
    F[3, 3] = 1.0
    H, R, z = rng.normal(size=(2, n)), np.eye(2), np.array([1.0, -2.0])
    predicted = F @ P @ F.T + Q
    gain = predicted @ H.T @ np.linalg.inv(H @ predicted @ H.T + R)
    later_mean, later_P = gain @ z, predicted - gain @ H @ predicted
    H_now = H @ F
    S = H_now @ P @ H_now.T + H @ Q @ H.T + R
    gain_now = P @ H_now.T @ np.linalg.inv(S)
    change, covariance = backward_step(
        *(xp.asarray(part) for part in (P, F, Q, predicted, later_P, later_mean[:, None]))
    )
    # JAX computes in float32 here.
    tolerance = 1e-10 if xp is np else 1e-3
    np.testing.assert_allclose(change[:, 0], gain_now @ z, atol=tolerance)
    np.testing.assert_allclose(covariance, P - gain_now @ H_now @ P, atol=tolerance)
    np.testing.assert_array_equal(np.asarray(covariance)[3], 0.0)
    np.testing.assert_array_equal(covariance, np.asarray(covariance).T)
