"""Rotation matrices and cross-product matrices against the definitions of quaternions and cross products."""

import numpy as np
import pytest

from psotrack.geometry import cross_matrices, rotation_matrices


def product(left, right):
    """Product of two quaternions, wxyz: w = w w' - v . v', and v = w v' + w' v + v x v'."""
    w = left[0] * right[0] - left[1:] @ right[1:]
    return np.array([w, *(left[0] * right[1:] + right[0] * left[1:] + np.cross(left[1:], right[1:]))])


def test_matrices_turn_as_their_quaternions_do():
    rng = np.random.default_rng(0)
    turns = rng.normal(size=(4, 3, 4))
    turns /= np.linalg.norm(turns, axis=-1, keepdims=True)
    turns[2, 1] = np.nan
    vector = rng.normal(size=3)
    found = rotation_matrices(turns)
    assert np.isnan(found[2, 1]).all()
    for index in np.ndindex(4, 3):
        if index != (2, 1):
            q = turns[index]
            turned = product(product(q, np.array([0.0, *vector])), q * [1, -1, -1, -1])
            np.testing.assert_allclose(found[index] @ vector, turned[1:], rtol=0, atol=1e-14)


@pytest.mark.parametrize("shape", [(0, 4), (3, 4)])
def test_nan_quaternions_give_nan_matrices(shape):
    found = rotation_matrices(np.full(shape, np.nan))
    assert found.shape == (*shape[:-1], 3, 3)
    assert np.isnan(found).all()


def test_cross_matrices_are_cross_products():
    rng = np.random.default_rng(1)
    vectors, others = rng.normal(size=(2, 5, 2, 3))
    expected = np.cross(vectors, others)
    # Rounding of differences of products of small numbers.
    np.testing.assert_allclose(np.matvec(cross_matrices(vectors), others), expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(
        cross_matrices(vectors[0, 0]) @ others[0, 0], expected[0, 0], rtol=0, atol=1e-14
    )
