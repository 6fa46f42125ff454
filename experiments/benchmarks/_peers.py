"""The same tracking with the swarms of other libraries, written for speed.

Each frame is searched as in psotrack's tracker: the same number of particles and iterations, the same spread around the
same prediction, the same bounds, inertia and pulls. Other work of psotrack (evidence, coasting, loss of drones) is left
out, which makes the other libraries faster.
"""

from __future__ import annotations

import atexit
import os
import tempfile
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _numpy_fitness import NumpyFitness

from psotrack.foreground.silhouettes import summed_area_table
from psotrack.geometry import Rig
from psotrack.settings import TrackSettings
from psotrack.tracking.births import InitialState
from psotrack.tracking.swarm import fitness, on_device
from psotrack.tracking.swarm.parameters import find_score

#: Gains of the alpha-beta filter, the motion model of the other libraries; its time is negligible beside the swarm.
POSITION_GAIN, VELOCITY_GAIN = 0.8, 0.3


@dataclass(frozen=True)
class Problem:
    """Data and settings of the tracking.

    Attributes:
        rig: the cameras.
        reduction: image pixels per silhouette pixel, along each side.
        start: initial state of the drones.
        settings: settings of psotrack; the other libraries use the swarm's part.
        fps: frames per second.
        bounds_m: (2, 3), corners of the room, metres.
    """

    rig: Rig
    reduction: int
    start: InitialState
    settings: TrackSettings
    fps: float
    bounds_m: np.ndarray

    @property
    def score(self) -> fitness.Score:
        """The score of positions."""
        return find_score(self.settings.score)

    @property
    def reach_m(self) -> float:
        """Largest distance that a drone flies in one frame, metres."""
        return self.settings.motion.speed_limit_m_s / self.fps

    def predict(self, position_m: Any, velocity_m_s: Any) -> tuple[Any, Any, Any]:
        """Predicted positions in the next frame, and the lowest and highest coordinates within reach."""
        low, high = self.bounds_m.astype(np.float32)
        lowest = (position_m - self.reach_m).clip(low, high)
        highest = (position_m + self.reach_m).clip(low, high)
        return (position_m + velocity_m_s / self.fps).clip(lowest, highest), lowest, highest

    def correct(self, found_m: Any, predicted_m: Any, velocity_m_s: Any) -> tuple[Any, Any]:
        """Position and velocity by the alpha-beta filter."""
        innovation = found_m - predicted_m
        velocity = velocity_m_s + VELOCITY_GAIN * self.fps * innovation
        speed = (velocity * velocity).sum(axis=-1, keepdims=True) ** 0.5
        velocity = velocity / (speed / self.settings.motion.speed_limit_m_s).clip(1.0)
        return predicted_m + POSITION_GAIN * innovation, velocity

    def first(self) -> tuple[np.ndarray, np.ndarray]:
        """Position and velocity before the first frame, so that the first prediction is the initial state."""
        velocity = self.start.velocity_m_s.astype(np.float32)
        return (self.start.position_m - velocity / self.fps).astype(np.float32), velocity


class Evosax:
    """evosax's PSO on psotrack's own fitness: ask and tell in a loop, in a scan over frames, in one jit."""

    def __init__(self, problem: Problem) -> None:
        from evosax.algorithms import PSO

        self._problem = problem
        self._cameras = on_device(problem.rig.cameras)
        self._algorithm = PSO(
            population_size=problem.settings.swarm.particles,
            solution=jnp.zeros(problem.start.position_m.size),
            metrics_fn=lambda *_: {},
        )
        self._params = self._algorithm.default_params.replace(
            inertia_coeff=problem.settings.swarm.inertia,
            cognitive_coeff=problem.settings.swarm.cognitive,
            social_coeff=problem.settings.swarm.social,
        )
        self._track = jax.jit(self._scan)

    def __call__(self, coverage: np.ndarray) -> np.ndarray:
        """Positions (frames, drones, 3)."""
        key = jax.random.key(self._problem.settings.seed)
        return np.asarray(jax.block_until_ready(self._track(key, *self._problem.first(), coverage)))

    def _scan(self, key: jax.Array, position: jax.Array, velocity: jax.Array, coverage: Any) -> jax.Array:
        def frame(carry: Any, silhouettes: jax.Array) -> tuple[Any, jax.Array]:
            key, position, velocity = carry
            key_next, key_frame = jax.random.split(key)
            predicted, low, high = self._problem.predict(position, velocity)
            found = self._search(key_frame, silhouettes, position, predicted, low, high)
            position, velocity = self._problem.correct(found, predicted, velocity)
            return (key_next, position, velocity), position

        return jax.lax.scan(frame, (key, position, velocity), coverage)[1]

    def _search(
        self,
        key: jax.Array,
        silhouettes: jax.Array,
        position: jax.Array,
        predicted: jax.Array,
        low: jax.Array,
        high: jax.Array,
    ) -> jax.Array:
        settings, algorithm, params = self._problem.settings, self._algorithm, self._params
        size_m = jnp.asarray(self._problem.start.size_m, jnp.float32)
        view = fitness.score_inputs(
            self._cameras,
            size_m,
            summed_area_table(silhouettes),
            self._problem.score,
            reduction=self._problem.reduction,
        )
        shape = (settings.swarm.particles, *predicted.shape)

        def cost(population: jax.Array) -> jax.Array:
            return -fitness.joint_fitness(view, population.reshape(shape))

        key_spread, key_swarm = jax.random.split(key)
        spread = settings.swarm.spread_m * jax.random.normal(key_spread, shape)
        particles = (predicted + spread).at[0].set(predicted).at[1].set(position)
        population = particles.clip(low, high).reshape(settings.swarm.particles, -1)

        def iterate(iteration: jax.Array, state: Any) -> Any:
            key = jax.random.fold_in(key_swarm, iteration)
            population, state = algorithm.ask(key, state, params)
            population = population.clip(low.reshape(-1), high.reshape(-1))
            return algorithm.tell(key, population, cost(population), state, params)[0]

        state = algorithm.init(key_swarm, population, cost(population), params)
        state = jax.lax.fori_loop(0, settings.swarm.iterations, iterate, state)
        return state.best_solution.reshape(predicted.shape)


class PySwarms:
    """pyswarms' global-best PSO on a NumPy fitness, frame by frame."""

    def __init__(self, problem: Problem, fitness: NumpyFitness) -> None:
        _silence_pyswarms()
        from pyswarms.single import GlobalBestPSO

        self._problem = problem
        self._fitness = fitness
        settings, dims = problem.settings, problem.start.position_m.size
        # One optimiser for all frames, because the constructor sets up logging four times, which is slower than a
        # search.
        self._optimiser = GlobalBestPSO(
            n_particles=settings.swarm.particles,
            dimensions=dims,
            options={
                "w": settings.swarm.inertia,
                "c1": settings.swarm.cognitive,
                "c2": settings.swarm.social,
            },
            bounds=(np.full(dims, -np.inf), np.full(dims, np.inf)),
            bh_strategy="nearest",
            velocity_clamp=(-problem.reach_m, problem.reach_m),
            init_pos=np.zeros((settings.swarm.particles, dims)),
        )

    def __call__(self, coverage: np.ndarray) -> np.ndarray:
        """Positions (frames, drones, 3)."""
        # pyswarms uses only NumPy's global generator.
        np.random.seed(self._problem.settings.seed)  # noqa: NPY002
        generator = np.random.default_rng(self._problem.settings.seed)
        position, velocity = self._problem.first()
        found = np.empty((len(coverage), *position.shape), np.float32)
        for frame, silhouettes in enumerate(coverage):
            predicted, low, high = self._problem.predict(position, velocity)
            best = self._search(generator, silhouettes, position, predicted, low, high)
            position, velocity = self._problem.correct(best, predicted, velocity)
            found[frame] = position
        return found

    def _search(
        self,
        generator: np.random.Generator,
        silhouettes: np.ndarray,
        position: np.ndarray,
        predicted: np.ndarray,
        low: np.ndarray,
        high: np.ndarray,
    ) -> np.ndarray:
        settings = self._problem.settings
        tables = self._fitness.tables(silhouettes)
        shape = (settings.swarm.particles, *predicted.shape)
        spread = settings.swarm.spread_m * generator.standard_normal(shape, np.float32)
        particles = predicted + spread
        particles[:2] = predicted, position

        def cost(population: np.ndarray) -> np.ndarray:
            return -self._fitness(tables, population.reshape(shape))

        optimiser = self._optimiser
        optimiser.bounds = low.reshape(-1), high.reshape(-1)
        optimiser.init_pos = particles.clip(low, high).reshape(settings.swarm.particles, -1)
        optimiser.reset()
        _, best = optimiser.optimize(cost, settings.swarm.iterations, verbose=False)
        return best.reshape(predicted.shape).astype(np.float32)


def _silence_pyswarms() -> None:
    """Prevent pyswarms from writing `report.log` into the working directory when it is imported."""
    with tempfile.NamedTemporaryFile("w", suffix=".yaml", delete=False) as file:
        file.write("version: 1\ndisable_existing_loggers: false\n")
    atexit.register(os.unlink, file.name)
    os.environ["LOG_CFG"] = file.name
