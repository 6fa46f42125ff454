"""Gradient steps after the swarm, on objectives whose maxima are known."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from psotrack.tracking.refinement import STEP_M, climb

PEAK_M = np.array([[0.10, -0.20, 1.00], [0.50, 0.40, 1.50]])
LOW_M, HIGH_M = (np.full((2, 3), value, np.float32) for value in (-3.0, 3.0))


def hill(position_m):
    return -jnp.square(position_m - PEAK_M).sum(axis=-1)


@partial(jax.jit, static_argnums=0)
def run(objective, position, steps, low=LOW_M, high=HIGH_M):
    return climb(objective, position, steps, low, high)


def test_it_climbs():
    start = jnp.asarray(PEAK_M + 0.01, jnp.float32)
    top = run(hill, start, 10)
    # Ten steps of at most STEP_M along each axis are 2 cm: the way of 1 cm and a turn.
    assert np.abs(top - PEAK_M).max() < 2 * STEP_M
    np.testing.assert_array_equal(run(hill, start, 0), start)


def test_steps_are_adams():
    """Against Adam as in Kingma & Ba 2015, algorithm 1, in NumPy."""
    start = PEAK_M + np.array([[0.05, -0.03, 0.02], [0.01, 0.04, -0.06]])
    position, first, second = start.copy(), np.zeros((2, 3)), np.zeros((2, 3))
    for step in range(1, 8):
        gradient = 2 * (position - PEAK_M)
        first = 0.8 * first + 0.2 * gradient
        second = 0.95 * second + 0.05 * gradient**2
        position -= STEP_M * (first / (1 - 0.8**step)) / (np.sqrt(second / (1 - 0.95**step)) + 1e-8)
    # Each step went uphill, so the last is the best. Float32 keeps 1e-7 of a metre in each of seven steps.
    np.testing.assert_allclose(run(hill, jnp.asarray(start, jnp.float32), 7), position, atol=1e-6)


def rugged(position_m):
    return jnp.sin(position_m * jnp.array([20.0, 150.0, 900.0]) + jnp.array([[0.0], [2.0]])).sum(axis=-1)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 12))
def test_nobody_ends_lower_than_it_began(seed, steps):
    """On a rugged objective too, where steps go downhill; and within the bounds."""
    rng = np.random.default_rng(seed)
    start = jnp.asarray(rng.uniform(-1, 1, (2, 3)), jnp.float32)
    low, high = (jnp.asarray(start + side * rng.uniform(0, 0.01, (2, 3)), jnp.float32) for side in (-1, 1))
    top = run(rugged, start, steps, low, high)
    assert (rugged(top) >= rugged(start)).all()
    assert (top >= low).all()
    assert (top <= high).all()


def half(position_m):
    return jnp.where(jnp.array([True, False]), hill(position_m), jnp.nan)


def test_drones_climb_alone():
    """What one drone does is nothing to the other, and one without a fitness stays where it was."""

    start = jnp.asarray(PEAK_M + 0.01, jnp.float32)
    top = run(half, start, 10)
    np.testing.assert_array_equal(top[1], start[1])
    np.testing.assert_array_equal(top[0], run(hill, start, 10)[0])
