# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3 (ipykernel)
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Bring your own
#
# In every frame, a [search](how_the_swarm_moves.ipynb) finds the positions with the highest
# [score](video_to_score.ipynb). Both are parts that can be replaced without a change to the package. This notebook
# brings a score of twenty lines, and two searches of [evosax](https://github.com/RobertTLange/evosax): CMA-ES (Hansen
# and Ostermeier 2001) and differential evolution (Storn and Price 1997). A small sweep compares them with the package's
# particle swarm at equal numbers of evaluations of the score.
#
# evosax comes with `pip install '.[notebooks]'`.

# %%
import os
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
from evosax.algorithms import CMA_ES, DifferentialEvolution

import psotrack as pt
from psotrack.geometry import project_boxes
from psotrack.support import keep_compiled
from psotrack.sweeps import sweep
from psotrack.tracking.swarm import camera_weights, foreground_and_area

# %%
TINY = os.environ.get("PSOTRACK_NOTEBOOKS") == "tiny"  # a quick check that everything runs
SEQUENCE = "S02_D4_A"
NUM_FRAMES, SCALE = (20, 0.25) if TINY else (50, 0.5)
SILHOUETTES = {"reduction": 2, "working_reduction": 1}
if TINY:  # so few pixels per drone that noise counts
    SILHOUETTES = {"reduction": 1, "working_reduction": 1, "min_blob_px": 32}
SETTINGS = {f"silhouettes.{name}": value for name, value in SILHOUETTES.items()}
SETTINGS |= {"init": "truth", "swarm.particles": 12}
ITERATIONS = [1] if TINY else [1, 4, 16]  # per frame: the budgets of the sweep
SEEDS = 1 if TINY else 3
DATA = Path("data", "tiny" if TINY else "normal")
plt.rcParams.update({"figure.dpi": 80, "font.size": 9})
keep_compiled(Path("data", "compiled"))

folder = DATA / "own" / "Simulated_Data" / SEQUENCE
if not folder.exists():
    simulation = pt.SimulationSettings(num_frames=NUM_FRAMES, scale=SCALE, masks=False, onboard=False)
    pt.simulate(SEQUENCE, DATA / "own", simulation)
recording = pt.read_recording(folder)

# %% [markdown]
# ## A score
#
# A score gives each drone at each position a value from 0 to 1 in each camera. This one is
# the Dice coefficient of the drone's box and the foreground around it. It is a frozen dataclass with one method and the
# three attributes of `pt.Score`; `project_boxes`, `foreground_and_area` and `camera_weights` are public functions.


# %%
@dataclass(frozen=True)
class Dice:
    """Twice the foreground in the box, over the area of the box and the foreground around it."""

    ring: float = 1.5  # foreground in a box 1.5 times as large belongs to the drone
    whole_pixels: bool = False
    min_cameras: int = 2
    windows: tuple[float, ...] = (0.5, 1.0)  # the smaller box rewards a position in the middle

    def camera_scores(self, inputs, position_m):
        """Scores and weights (..., drones, cameras) of positions (..., drones, 3)."""
        boxes = project_boxes(inputs.extents, position_m)
        foreground, area = foreground_and_area(inputs, boxes, (*self.windows, self.ring))
        score = 2 * foreground[:-1] / (area[:-1] + foreground[-1] + 1e-6)
        return score.mean(axis=0).clip(0, 1), camera_weights(inputs, boxes)


tracked = pt.track(recording, SETTINGS, cache=DATA / "silhouettes", score=Dice())
error_m = pt.evaluate(tracked.trajectories, recording.truth).mean_error_m
print(tracked)
print(f"mean error with the score of this notebook: {1e3 * error_m:.1f} mm")

# %% [markdown]
# ## Two searches
#
# A search maps the first positions, (particles, groups, dims), to the best position of each group; here each drone is a
# group of three dimensions. It is called inside a compiled function, so its loop is `jax.lax.fori_loop`. The first
# positions lie about the tracker's prediction, which is position 0: a search that begins with them is warm-started, as
# the particle swarm is. All three searches evaluate the first positions once, and then as many positions again in every
# iteration. Positions outside the region are moved to its border before they are evaluated.
#
# evosax's algorithms treat one population; `jax.vmap` runs one for each group. They minimise, and a position that too
# few cameras see (NaN) costs infinitely much.


# %%
class EvosaxSearch:
    """A search by ask and tell, one population per group; subclasses say how the population starts."""

    def __call__(self, key, objective, first, region, num_iterations):
        """The best position of each group, (groups, dims)."""
        particles, groups, dims = first.shape
        algorithm = self.algorithm(
            population_size=particles, solution=jnp.zeros(dims), metrics_fn=lambda *_: {}
        )
        inside = jnp.clip(first, region.low, region.high).swapaxes(0, 1)  # (groups, particles, dims)
        tell = jax.vmap(algorithm.tell, in_axes=(0, 0, 0, 0, None))

        def cost(population):
            return jnp.nan_to_num(-objective(population.swapaxes(0, 1)).T, nan=jnp.inf, posinf=jnp.inf)

        def iterate(number, state):
            keys = jax.random.split(jax.random.fold_in(key, number), groups)
            asked, state = jax.vmap(algorithm.ask, in_axes=(0, 0, None))(keys, state, params)
            population = jnp.clip(asked, region.low[:, None], region.high[:, None])
            return tell(keys, population, cost(population), state, params)[0]

        keys = jax.random.split(key, groups)
        params = self.change(algorithm.default_params, first)
        state = jax.vmap(self.start, in_axes=(None, 0, 0, 0, None))(
            algorithm, keys, inside, cost(inside), params
        )
        return jax.lax.fori_loop(0, num_iterations, iterate, state).best_solution


@jax.tree_util.register_static
@dataclass(frozen=True)
class CmaEs(EvosaxSearch):
    """CMA-ES about the prediction; the first positions are its first generation."""

    algorithm = CMA_ES

    def change(self, params, first):
        """The first step size: the standard deviation of the first positions about the prediction."""
        return params.replace(std_init=jnp.sqrt(jnp.mean(jnp.square(first[2:] - first[0]))))

    def start(self, algorithm, key, population, cost, params):
        """The state after the first generation."""
        state = algorithm.init(key, population[0], params).replace(best_solution=population[0])
        return algorithm.tell(key, population, cost, state, params)[0]


@jax.tree_util.register_static
@dataclass(frozen=True)
class Differential(EvosaxSearch):
    """Differential evolution (best/1/bin) from the first positions."""

    algorithm = DifferentialEvolution

    def change(self, params, first):
        """The parameters as evosax sets them."""
        return params

    def start(self, algorithm, key, population, cost, params):
        """The state before the first iteration."""
        return algorithm.init(key, population, cost, params)


# %% [markdown]
# Before the sweep, a check that all searches call the score equally often, on an objective that counts its calls.

# %%
particles, groups = SETTINGS["swarm.particles"], recording.truth.num_drones
first = 0.05 * jax.random.normal(jax.random.key(0), (particles, groups, 3))
everywhere = pt.SearchRegion(jnp.full((groups, 3), -1.0), jnp.full((groups, 3), 1.0), jnp.full(3, 0.2))
searches = {"cma-es": CmaEs(), "de": Differential()}
calls = []
for name, search in searches.items():
    best = jax.jit(
        lambda key, search=search: search(
            key,
            lambda position: (
                jax.debug.callback(lambda: calls.append(1)),
                -jnp.square(position - 0.03).sum(axis=-1),
            )[1],
            first,
            everywhere,
            jnp.int32(8),
        )
    )(jax.random.key(1))
    jax.effects_barrier()
    distance_mm = 1e3 * float(jnp.linalg.norm(best - 0.03, axis=-1).max())
    print(
        f"{name}: {len(calls)} calls, {particles * len(calls)} positions, {distance_mm:.1f} mm from the optimum"
    )
    assert len(calls) == 8 + 1
    calls.clear()

# %% [markdown]
# ## A sweep
#
# `register_plugin` gives each search a name, which the grids of sweeps use like any other value of a setting. A plugin
# is a function of its part of the settings.
#
# The tracker usually takes the vertex of a paraboloid through the score about the position that the search finds
# (`score.vertex`). The sweep also has runs without it, in which the position of the search itself is the measurement.

# %%
for name, search in searches.items():
    pt.register_plugin("search", name, lambda settings, search=search: search)
grid = {
    "sequences": [SEQUENCE],
    "runs": SEEDS,
    "settings": SETTINGS,
    "grid": {
        "swarm.search": ["pso", *searches],
        "swarm.iterations": ITERATIONS,
        "score.vertex": [False, True],
    },
}
# Results are stored under the names of the plugins, not under their code: after a change they would be out of date.
with TemporaryDirectory() as results:
    rows = sweep(grid, results, data=DATA / "own", cache=DATA / "silhouettes").rows()

rows["evaluations"] = particles * (rows["settings.swarm.iterations"] + 1)
rows["error_mm"] = 1e3 * rows["mean_error_m"]
rows["vertex"] = rows["settings.score.vertex"].map({False: "search alone", True: "with vertex"})
table = rows.pivot_table(
    values="error_mm",
    index=["vertex", "settings.swarm.search"],
    columns="evaluations",
    aggfunc=["mean", "min", "max"],
)
table.round(2)

# %%
budgets = sorted(set(rows["evaluations"]))
colours = dict(zip(("pso", *searches), ("#0072b2", "#d55e00", "#009e73"), strict=True))
figure, both = plt.subplots(1, 2, figsize=(9, 3.8), sharey=True, layout="constrained")
for axes, (title, half) in zip(both, rows.groupby("vertex"), strict=True):
    for name, runs in half.groupby("settings.swarm.search"):
        error_mm = runs.groupby("evaluations")["error_mm"]
        axes.plot(error_mm.mean(), "o-", color=colours[name], label=name)
        axes.fill_between(budgets, error_mm.min(), error_mm.max(), color=colours[name], alpha=0.2)
    axes.set(xscale="log", xlabel="evaluations of the score per drone and frame", title=title)
    axes.set(ylabel="mean error (mm)", ylim=(0, None))
    axes.set_xticks(budgets, budgets)
    axes.minorticks_off()
    axes.grid(alpha=0.3)
both[0].legend(frameon=False, title=f"{SEEDS} seeds")
plt.show()

# %% [markdown]
# *What to see: the mean error of the tracks against the number of evaluations, for the particle swarm and the two
# searches of evosax; lines are means over the seeds, bands reach from the smallest to the largest error. Left, the
# search alone decides the position; right, the vertex corrects the position, and hides most of what distinguishes the
# searches. This is one recording, every search has its default parameters, and seeds change only the random numbers of
# the searches: where bands overlap, the order of the searches is not known. All searches begin at the prediction, so the
# comparison is about the last centimetres, not about finding a drone in the room.*
