"""Estimation: least squares are compared with SciPy and dense algebra."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from psotrack.geometry.estimation import (
    NormalEquations,
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


@pytest.mark.parametrize("robust", [False, True])
def test_a_fit_equals_scipys(robust):
    noise = np.random.default_rng(1).normal(0, 0.1, len(TIME_S))
    values = curve(np.array([3.0, 1.2, -0.4]))[0] + noise
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


def coupled_equations(blocks=5, m=3, n=4):
    """Normal equations with blocks, and the same equations as a dense matrix and its right side."""
    rng = np.random.default_rng(5)
    cut = blocks * m
    diagonal = [slice(k * m, k * m + m) for k in range(blocks)]
    J = np.zeros((blocks, 10, cut + n))
    J[..., cut:] = rng.normal(size=(blocks, 10, n))
    for rows, columns in zip(J, diagonal, strict=True):
        rows[:, columns] = rng.normal(size=(10, m))
    J = J.reshape(10 * blocks, cut + n)
    A = J.T @ J
    b = J.T @ rng.normal(size=10 * blocks)
    own = np.stack([A[rows, rows] for rows in diagonal])
    between = A[:cut, cut:].reshape(blocks, m, n)
    equations = NormalEquations(A[cut:, cut:], b[cut:], own, b[:cut].reshape(blocks, m), between)
    return equations, A, b


def test_elimination_of_blocks_gives_the_dense_solution_and_covariance():
    equations, A, b = coupled_equations()
    for damping in (0.0, 0.3):
        step = equations.damped(damping).solved()
        expected = np.linalg.solve(A + damping * np.diag(np.diag(A)), b)
        np.testing.assert_allclose(np.append(step.blocks, step.shared), expected, atol=1e-10)
    found = covariance_from_information(equations.reduced().information)
    np.testing.assert_allclose(found, np.linalg.inv(A)[15:, 15:], rtol=1e-9, atol=1e-12)
