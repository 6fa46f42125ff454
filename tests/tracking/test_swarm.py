"""The particle swarm: one step worked out by hand, and invariants."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_refused, assert_same, draw_coverage, float32, ring_rig
from hypothesis import given
from hypothesis import strategies as st
from windows import cut_at

from psotrack.geometry import make_extents
from psotrack.settings import SwarmSettings
from psotrack.tracking.swarm import DroneFitness, ScoreInputs, SearchRegion, SoftIoU, find_search, optimiser

#: Coefficients of a swarm where a test sets no others.
COEFFICIENTS = {"inertia": 0.6, "cognitive": 1.5, "social": 1.5}


def params(groups=1, dims=2, *, max_step=10.0, low=-100.0, high=100.0, **coefficients):
    return optimiser.SwarmParams(
        **{name: np.float32(value) for name, value in (COEFFICIENTS | coefficients).items()},
        max_step=np.full(dims, max_step, np.float32),
        low=np.full((groups, dims), low, np.float32),
        high=np.full((groups, dims), high, np.float32),
    )


def sphere(position):
    return -(position**2).sum(axis=-1)


def random_positions(particles, groups, dims, seed=0, scale=5.0):
    rng = np.random.default_rng(seed)
    return np.float32(rng.uniform(-scale, scale, (particles, groups, dims)))


def evaluated_start(objective, position, knobs):
    """The initial swarm after its evaluation."""
    return optimiser.evaluate(objective, optimiser.init(position, knobs))


def advance(key, objective, state, knobs):
    """The swarm after one move and its evaluation, as at the end of an iteration."""
    return optimiser.evaluate(objective, optimiser.move(key, state, knobs))


run = jax.jit(optimiser.run, static_argnums=1)
init = jax.jit(evaluated_start, static_argnums=0)
step = jax.jit(advance, static_argnums=1)


def mixed(word):
    """The last steps of MurmurHash3 on a word of 32 bits, in Python integers."""
    word ^= word >> 16
    word = word * 0x85EBCA6B % 2**32
    word ^= word >> 13
    word = word * 0xC2B2AE35 % 2**32
    return word ^ (word >> 16)


def random_factors(key, shape):
    """Two factors for each element, from the hash of the key and the element's number."""
    first, last = jax.random.key_data(key).tolist()
    words = []
    for number in range(np.prod(shape)):
        word = mixed((number * 0x9E3779B9 + first) % 2**32)
        words.append(mixed(word ^ last))
    high, low = np.divmod(np.reshape(words, shape), 2**16)
    return high / 2**16, low / 2**16


@pytest.mark.parametrize("max_step", [10.0, 0.75])
def test_one_step_of_three_particles_by_hand(max_step):
    """Two groups with different leaders.

    The test fails if r1 and r2 are shared over dimensions, if the attractor is the best of another group or of another
    particle, if bests are taken before the move, or if the clamp comes before the sum.
    """
    # Rows are particles; in each row, the first pair belongs to group 0 and the second to group 1.
    position = as_particles([1, 2, 4, 0], [3, -1, 1, 1], [-2, 2, 0, 3])
    knobs = params(groups=2, inertia=0.5, cognitive=1.2, social=0.8, max_step=max_step)
    before = init(sphere, position, knobs)
    # Particle 0 leads group 0 (-5 against -10 and -8), and particle 1 leads group 1 (-2 against -16 and -9).
    gbest = np.array([[1, 2], [1, 1]])
    assert before.gbest_fitness.tolist() == [-5, -2]
    np.testing.assert_array_equal(before.gbest_position, gbest)

    velocity = as_particles([0.5, 0, 1, -1], [0, 1, -0.5, 0], [0.25, 0.25, 0, -2])
    pbest = as_particles([1, 2, 3, 0], [2, -1, 1, 1], [-2, 2, 0, 2])
    before = replace(before, velocity=velocity, pbest_position=pbest, pbest_fitness=sphere(pbest))
    key = jax.random.key(7)
    after = step(key, sphere, before, knobs)

    r1, r2 = random_factors(key, (3, 2, 2))
    to_own_best = 1.2 * r1 * (pbest - position)
    to_best_of_group = 0.8 * r2 * (gbest - position)
    pull = 0.5 * velocity + to_own_best + to_best_of_group
    expected_velocity = np.clip(pull, -max_step, max_step)
    expected_position = position + expected_velocity
    better = sphere(expected_position) > sphere(pbest)
    expected_pbest = np.where(better[..., None], expected_position, pbest)
    expected_fitness = sphere(expected_pbest)
    leader = expected_fitness.argmax(axis=0)
    # A few float32 operations on numbers below 5, with rounding errors of 6e-7 each.
    np.testing.assert_allclose(after.velocity, expected_velocity, atol=5e-6)
    np.testing.assert_allclose(after.position, expected_position, atol=5e-6)
    np.testing.assert_allclose(after.pbest_position, expected_pbest, atol=5e-6)
    np.testing.assert_allclose(after.pbest_fitness, expected_fitness, atol=5e-5)
    np.testing.assert_allclose(after.gbest_position, expected_pbest[leader, [0, 1]], atol=5e-6)
    np.testing.assert_allclose(after.gbest_fitness, expected_fitness[leader, [0, 1]], atol=5e-5)


def as_particles(*rows):
    """(particles, 2 groups, 2 dimensions), from one row of four numbers per particle."""
    return np.array(rows, np.float32).reshape(-1, 2, 2)


def ripples(position):
    """A function with many maxima, and NaN in stripes."""
    height = jnp.cos(3 * position).sum(axis=-1) - 0.1 * jnp.square(position).sum(axis=-1)
    return jnp.where(jnp.sin(7 * position[..., 0]) > 0.5, jnp.nan, height)


compiled_ripples = jax.jit(ripples)


@jax.jit
def path_of_bests(key, position, knobs):
    """The fields of the swarm after each of 25 iterations, by name."""

    def one(state, key):
        state = advance(key, ripples, state, knobs)
        return state, vars(state)

    start = evaluated_start(ripples, position, knobs)
    return jax.lax.scan(one, start, jax.random.split(key, 25))[1]


@given(st.integers(0, 2**30), st.floats(0, 1.2), st.floats(0, 3), st.floats(0, 3), st.floats(0.0625, 8))
def test_invariants_hold_for_any_settings(seed, inertia, cognitive, social, max_step):
    """Bests never become worse or NaN and are values of the function; particles keep to bounds and largest step."""
    weights = {"inertia": inertia, "cognitive": cognitive, "social": social}
    knobs = params(3, 2, max_step=max_step, low=-3.0, high=2.0, **weights)
    states = path_of_bests(jax.random.key(seed), random_positions(7, 3, 2, seed), knobs)
    states = SimpleNamespace(**jax.tree.map(np.asarray, states))
    for best in (states.pbest_fitness, states.gbest_fitness):
        assert not np.isnan(best).any()
        assert (best[1:] >= best[:-1]).all()
    np.testing.assert_array_equal(states.gbest_fitness, states.pbest_fitness.max(axis=1))
    defined = np.isfinite(states.pbest_fitness)
    evaluated = np.asarray(compiled_ripples(states.pbest_position))
    # The function is evaluated once inside the compiled loop and once outside.
    np.testing.assert_allclose(states.pbest_fitness[defined], evaluated[defined], atol=1e-5)
    assert (states.position >= -3).all()
    assert (states.position <= 2).all()
    assert (np.abs(states.velocity) <= np.float32(max_step)).all()
    moved = np.abs(np.diff(states.position, axis=0))
    assert (moved <= max_step * (1 + 1e-6) + 1e-6).all()


def test_where_nothing_is_defined_all_stays_finite():
    def undefined_everywhere(position):
        return jnp.full(position.shape[:2], jnp.nan, position.dtype)

    swarm = run(jax.random.key(0), undefined_everywhere, random_positions(3, 1, 2), params(), 10)
    assert np.isneginf(swarm.gbest_fitness).all()
    assert np.isneginf(swarm.pbest_fitness).all()
    assert np.isfinite(swarm.gbest_position).all()
    assert np.isfinite(swarm.position).all()


def test_a_particle_does_not_stick_to_a_bound():
    """A particle that has reached a bound keeps no velocity across the bound."""
    knobs = params(low=-1.0, high=1.0, inertia=1.0, cognitive=0.0, social=0.0)
    start = init(sphere, np.array([[[0.9, 0.0]]], np.float32), knobs)
    start = replace(start, velocity=np.array([[[5.0, 0.25]]], np.float32))
    after = step(jax.random.key(0), sphere, start, knobs)
    np.testing.assert_allclose(after.position[0, 0], [1, 0.25], atol=1e-6)
    np.testing.assert_allclose(after.velocity[0, 0], [0, 0.25], atol=1e-6)


def test_no_iterations_give_the_evaluated_start_and_only_the_key_is_random():
    position, knobs, key = random_positions(6, 2, 2), params(2), jax.random.key(0)
    assert_same(run(key, sphere, position, knobs, 0), init(sphere, position, knobs))
    once = run(key, sphere, position, knobs, 3)
    assert_same(run(key, sphere, position, knobs, 3), once)
    other = run(jax.random.key(1), sphere, position, knobs, 3)
    assert (other.position != once.position).any()
    # More iterations continue the same path.
    longer = run(key, sphere, position, knobs, 6)
    assert (longer.gbest_fitness >= once.gbest_fitness).all()


# --- the same search as one kernel, by Pallas' interpreter on the CPU

SIZE_M = np.array([[0.5, 0.5, 0.3], [0.6, 0.6, 0.35]], np.float32)
#: The drones hide each other from some cameras.
PLACE_M = np.array([[0.3, 0.0, 1.4], [-0.2, -0.5, 1.2]], np.float32)
EFFORT = {"particles": 6, "iterations": 5}


def search_case(name, *, coefficients=0, fisheye=None):
    """A search of two runs, and its arguments: the keys, and first positions beside the drones."""
    rig = ring_rig(3, coefficients=coefficients)
    images = draw_coverage(rig, PLACE_M, SIZE_M, 2)
    patches = jax.tree.map(jnp.asarray, cut_at(rig, images, PLACE_M, SIZE_M, reduction=2))
    cameras = float32(replace(rig.cameras, fisheye=fisheye))
    objective = DroneFitness(ScoreInputs(make_extents(cameras, SIZE_M), patches, SoftIoU()))
    region = SearchRegion(PLACE_M - 0.3, PLACE_M + 0.3, jnp.full(3, 0.1))
    search = find_search(SwarmSettings(search=name, **EFFORT))

    def one_run(key, first):
        return search(key, objective, first, region, jnp.int32(EFFORT["iterations"]))

    noise = np.random.default_rng(0).normal(0, 0.1, (2, EFFORT["particles"], *PLACE_M.shape))
    first = np.float32(PLACE_M + noise)
    keys = jax.random.split(jax.random.key(3), 2)
    return jax.jit(jax.vmap(one_run)), (keys, first)


@pytest.mark.nightly
def test_the_best_positions_are_those_of_the_swarm():
    """Three cameras and six particles: the kernel fills up both."""
    search, arguments = search_case("pso")
    of_swarm = np.asarray(search(*arguments))
    search, _ = search_case("pso-kernel")
    of_kernel = np.asarray(search(*arguments))
    _, first = arguments
    moved_m = np.abs(of_swarm[:, None] - first)
    assert (moved_m.max(axis=-1) > 1e-3).all()
    # Roundings of single operations on metres.
    np.testing.assert_allclose(of_kernel, of_swarm, atol=1e-5)


def test_a_fisheye_lens_is_refused(tmp_path):
    search, arguments = search_case("pso-kernel", fisheye=np.array([True, False, False]))
    words = "expected swarm.kind per-drone, score.kind soft and no fisheye lens, found a fisheye lens"
    assert_refused(lambda: search(*arguments), "swarm.search pso-kernel: ", words, unchanged=tmp_path)


def test_it_compiles_to_triton():
    """The program for a GPU, up to Triton's code: no GPU is needed."""
    search, arguments = search_case("pso-kernel", coefficients=5)
    text = search.trace(*arguments).lower(lowering_platforms=("cuda",)).as_text()
    assert text.count("custom_call @__gpu$xla.gpu.triton") == 1
    # The blocks of threads: those of two drones in two runs.
    assert "grid_x = 2 : i32, grid_y = 2 : i32, grid_z = 1 : i32" in text
