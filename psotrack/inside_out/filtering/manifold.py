"""Orientations as points of a manifold, in small batches and float64: quaternions, small turns, their Jacobians.

An orientation q is perturbed from the right, q exp(turn), with a small turn about the camera's own axes, as in
`CameraPath`. Formulas: J. Solà, J. Deray, D. Atchuthan, A micro Lie theory for state estimation in robotics,
arXiv:1812.01537, appendices A and B. SciPy's rotations compute the same, but for a batch of ten they take longer than
all other arithmetic of a filter.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from psotrack.geometry import cross_matrices

#: Batches. A batch of 1 is broadcast to any size.
Turns = Float[np.ndarray, "#batch 3"]
Quaternions = Float[np.ndarray, "#batch 4"]
Matrices = Float[np.ndarray, "#batch 3 3"]

#: Squared angle below which a series replaces a quotient whose numerator and denominator both vanish. The relative
#: error of the series is below 1e-14 there.
_SMALL_RAD2 = 1e-3
_EYE = np.eye(3)
#: Component and sign of each entry of the matrix that multiplies with a quaternion from the left.
_COMPONENT = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])
_SIGN = np.array([[1, -1, -1, -1], [1, 1, -1, 1], [1, 1, 1, -1], [1, -1, 1, 1]], float)
_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


def turned(orientation_wxyz: Quaternions, turn: Turns) -> Quaternions:
    """The orientation q turned about its own axes: q exp(turn), normalised."""
    half = np.sqrt(_squared(turn)[:, 0]) / 2
    step = np.concatenate([np.cos(half), np.sinc(half / np.pi) / 2 * turn], axis=1)
    product = _product(orientation_wxyz, step)
    return product / np.sqrt((product * product).sum(axis=1, keepdims=True))


def turn_between(from_wxyz: Quaternions, to_wxyz: Quaternions) -> Turns:
    """The turn, of at most pi, for which `turned(from, turn)` equals `to`; either argument may be a batch of 1."""
    apart = _product(from_wxyz * _CONJUGATE, to_wxyz)
    # q and -q are the same orientation: take the one with the smaller turn.
    apart = np.where(apart[:, :1] < 0, -apart, apart)
    sine = np.sqrt((apart[:, 1:] ** 2).sum(axis=1, keepdims=True))
    scale = np.where(sine > 1e-9, 2 * np.arctan2(sine, apart[:, :1]) / np.maximum(sine, 1e-9), 2.0)
    return scale * apart[:, 1:]


def rotation_matrices(orientation_wxyz: Quaternions) -> Matrices:
    """Rotation matrices of unit quaternions."""
    w, vector = orientation_wxyz[:, 0, None, None], orientation_wxyz[:, 1:]
    crossed = cross_matrices(vector)
    return _EYE + 2 * (w * crossed + crossed @ crossed)


def right_jacobian(turn: Turns) -> Matrices:
    """J with exp(turn + d) = exp(turn) exp(J d) for small d."""
    squared, crossed = _squared(turn), cross_matrices(turn)
    angle2 = np.maximum(squared, _SMALL_RAD2)
    angle = np.sqrt(angle2)
    small = squared < _SMALL_RAD2
    first = np.where(small, 1 / 2 - squared / 24 + squared**2 / 720, (1 - np.cos(angle)) / angle2)
    third = (angle - np.sin(angle)) / (angle2 * angle)
    second = np.where(small, 1 / 6 - squared / 120 + squared**2 / 5040, third)
    return _EYE - first * crossed + second * (crossed @ crossed)


def right_jacobian_inverse(turn: Turns) -> Matrices:
    """J with log(exp(turn) exp(d)) = turn + J d for small d; for turns of at most pi."""
    squared, crossed = _squared(turn), cross_matrices(turn)
    angle2 = np.maximum(squared, _SMALL_RAD2)
    half = np.sqrt(angle2) / 2
    series = 1 / 12 + squared / 720 + squared**2 / 30240
    exact = (1 - half / np.tan(half)) / angle2
    return _EYE + crossed / 2 + np.where(squared < _SMALL_RAD2, series, exact) * (crossed @ crossed)


def _product(left: Quaternions, right: Quaternions) -> Quaternions:
    return ((left[:, _COMPONENT] * _SIGN) @ right[:, :, None])[:, :, 0]


def _squared(turn: Turns) -> Float[np.ndarray, "#batch 1 1"]:
    return (turn * turn).sum(axis=1)[:, None, None]
