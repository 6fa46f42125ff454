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
# # How the swarm moves
#
# A [score](video_to_score.ipynb) says how well a drone at a point explains what the cameras see. In every frame, a
# particle swarm searches the point with the highest score. Each particle is a possible position of the drone. A
# particle stores the best position that it has visited (pbest), and the swarm stores the best position of all
# particles (gbest). In each iteration
#
# $$v \leftarrow w\,v + c_1 r_1\,(\mathrm{pbest} - x) + c_2 r_2\,(\mathrm{gbest} - x),\qquad x \leftarrow x + v,$$
#
# with random numbers $r_1, r_2$ in [0, 1) for every particle and axis (Kennedy and Eberhart 1995, Shi and Eberhart
# 1998). This notebook runs the package's own swarm in one frame, one step at a time.

# %%
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import Image
from matplotlib.animation import FuncAnimation, PillowWriter

from psotrack.foreground.silhouettes import SilhouetteSettings, compute, summed_area_table
from psotrack.recordings.datasets import read_sequence
from psotrack.settings import TrackSettings
from psotrack.simulation import SimulationSettings, simulate
from psotrack.support import keep_compiled
from psotrack.tracking.births import first_drones, room_bounds
from psotrack.tracking.swarm import SoftIoU, on_device, optimiser
from psotrack.tracking.swarm.fitness import drone_fitness, joint_fitness, score_inputs

# %%
TINY = os.environ.get("PSOTRACK_NOTEBOOKS") == "tiny"  # a quick check that everything runs
NUM_FRAMES = 20 if TINY else 75
SCALE = 0.25 if TINY else 0.5
SILHOUETTES = SilhouetteSettings(reduction=2, working_reduction=1)
if TINY:  # so few pixels per drone that noise counts
    SILHOUETTES = SilhouetteSettings(reduction=1, working_reduction=1, min_blob_px=32)
FRAME = 10  # the frame that is looked at
DRONE = 2  # the drone that is looked at, in the truth's order
PARTICLES = 30
SHOWN_ITERATIONS = 4 if TINY else 24  # in the animation
ITERATIONS, SEEDS = (5, 2) if TINY else (50, 20)  # in the comparison
SPREAD_M = 0.15  # of the particles at the start; the tracker's 0.05 would be hard to see
HALF_M, STEP_M = 0.45, 0.05 if TINY else 0.01  # half the side of the map, and its step
DATA = Path("data", "tiny" if TINY else "normal")
plt.rcParams.update({"figure.dpi": 80, "font.size": 9})
keep_compiled(Path("data", "compiled"))

# %% [markdown]
# ## One frame
#
# The drones are found in the first frames. Their positions in frame 10, extrapolated at constant velocity, are the
# prediction around which the particles start.

# %%
folder = DATA / "Simulated_Data" / "S02_D4_A"
if not folder.exists():  # the same recording as in the quickstart
    simulation = SimulationSettings(num_frames=NUM_FRAMES, scale=SCALE, masks=False, onboard=False)
    simulate("S02_D4_A", DATA, simulation)
recording = read_sequence(folder).usable()
settings = TrackSettings(silhouettes=SILHOUETTES)
silhouettes = compute(recording, SILHOUETTES, cache=DATA / "silhouettes")
start = first_drones(
    recording.rig,
    silhouettes,
    fps=recording.fps,
    bounds_m=room_bounds(recording.rig),
    max_speed_m_s=settings.motion.speed_limit_m_s,
    drones=settings.drones,
)
predicted_m = jnp.asarray(start.position_m + start.velocity_m_s * FRAME / recording.fps, jnp.float32)
truth_m = recording.truth.position_m[FRAME, DRONE]
shown = int(jnp.linalg.norm(predicted_m - truth_m, axis=1).argmin())
print(f"the prediction is {1e3 * np.linalg.norm(predicted_m[shown] - truth_m):.0f} mm off")

# %%
seen = score_inputs(
    on_device(recording.rig.cameras),
    jnp.asarray(start.size_m, jnp.float32),
    summed_area_table(jnp.asarray(silhouettes.read(FRAME, FRAME + 1)[0], jnp.int32)),
    SoftIoU(),
    reduction=SILHOUETTES.reduction,
)
# Particles have the axes (particles, drones, 3): each drone has its own swarm, and all swarms move at once.
spread = jax.random.normal(jax.random.key(1), (PARTICLES, *predicted_m.shape))
first_m = predicted_m + SPREAD_M * spread
params = optimiser.SwarmParams(
    inertia=jnp.float32(settings.swarm.inertia),
    cognitive=jnp.float32(settings.swarm.cognitive),
    social=jnp.float32(settings.swarm.social),
    max_step=jnp.full(3, settings.motion.speed_limit_m_s / recording.fps, jnp.float32),
    low=predicted_m - HALF_M,
    high=predicted_m + HALF_M,
)
fitness = jax.jit(lambda position_m: drone_fitness(seen, position_m))
step = jax.jit(optimiser.step, static_argnums=1)

states = [optimiser.init(first_m, params)]
for iteration in range(SHOWN_ITERATIONS):
    states.append(step(jax.random.key(iteration), fitness, states[-1], params))

# %% [markdown]
# `states` holds, after each iteration, the positions of the particles and their best positions.

# %%
position_m = np.stack([state.position[:, shown] for state in states])  # iterations, particles, 3
height = np.stack([fitness(state.position)[:, shown] for state in states])
best_m = np.stack([state.gbest_position[shown] for state in states[1:]])
best = np.array([state.gbest_fitness[shown] for state in states[1:]])

line_m = np.arange(-round(HALF_M / STEP_M), round(HALF_M / STEP_M) + 1) * STEP_M
middle_m = np.asarray(predicted_m[shown])
x_m, y_m = middle_m[0] + line_m, middle_m[1] + line_m
place_m = np.stack([*np.meshgrid(x_m, y_m), np.full((len(line_m),) * 2, best_m[-1, 2])], axis=-1)
# Each position is scored for all drones; only the score of the shown drone is used.
everywhere_m = jnp.asarray(np.repeat(place_m[:, :, None], len(predicted_m), axis=2), jnp.float32)
ground = np.asarray(fitness(everywhere_m))[..., shown]

figure, (left, right) = plt.subplots(1, 2, figsize=(9.6, 4.3), dpi=66, layout="constrained")
shown_ground = left.contourf(x_m, y_m, ground, levels=np.arange(0, ground.max() + 0.025, 0.025))
figure.colorbar(shown_ground, ax=left, label="fitness (0 to 1)", shrink=0.85)
left.plot(*truth_m[:2], "+", color="#2b313a", markersize=14, markeredgewidth=1.5)
trails = left.plot(*np.zeros((2, 2, PARTICLES)), color="white", linewidth=0.7, alpha=0.7)
(dots,) = left.plot(
    [], [], "o", color="white", markersize=4.5, markeredgecolor="#2b313a", markeredgewidth=0.8
)
(leader,) = left.plot([], [], "o", color="none", markeredgecolor="#ff4d4d", markersize=12, markeredgewidth=2)
left.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", xlim=x_m[[0, -1]], ylim=y_m[[0, -1]], title=" ")
(cloud,) = right.plot([], [], "o", color="#9aa3ad", markersize=3, label="each particle")
(curve,) = right.plot([], [], color="#d55e00", linewidth=2, label="best so far")
right.set(
    xlabel="iteration", ylabel="fitness (0 to 1)", xlim=(-0.5, SHOWN_ITERATIONS), ylim=(0, 1.1 * best[-1])
)
right.legend(frameon=False, loc="lower right")
right.grid(alpha=0.3)
figure.canvas.draw()
figure.set_layout_engine("none")  # the axes stay where they are now


def draw(iteration):
    """Show the swarm as it is evaluated in an iteration."""
    past = np.arange(iteration + 1)
    steps_m = position_m[[max(iteration - 1, 0), iteration]]
    for trail, (x, y, _) in zip(trails, steps_m.transpose(1, 2, 0), strict=True):
        trail.set_data(x, y)
    dots.set_data(*position_m[iteration, :, :2].T)
    leader.set_data(*best_m[iteration, :2, None])
    cloud.set_data(np.repeat(past, PARTICLES), height[past].ravel())
    curve.set_data(past, best[past])
    left.set_title(f"iteration {iteration}")


animation = FuncAnimation(figure, draw, SHOWN_ITERATIONS)
animation.save(DATA / "swarm.gif", writer=PillowWriter(fps=3))
plt.close(figure)
Image(filename=DATA / "swarm.gif")

# %% [markdown]
# *What to see. Left, from above: the score's landscape at the drone's height, thirty particles (white, with the last
# step as a line), the best position so far (ring), and the true position (dark cross). The particles
# begin as a wide cloud around the prediction, are pulled over the hill, swing to its other side, and settle on
# the top. Right: the score of every particle and the best score so far. The best score is nearly final after a few
# iterations; the remaining iterations improve the position by millimetres.*
#
# ## One swarm for each drone, or one swarm for all drones?
#
# The paper has one swarm in which a particle is a guess of *all* drones at once: 12 numbers for four drones. Its score
# is the mean over the drones, so a particle that is right about three drones and wrong about one has a mediocre score,
# and attracts no other particle. Separate swarms share only the images. Both kinds get the same numbers of particles
# and iterations, and so the same number of evaluations of the score:

# %%
joint = jax.jit(lambda position_m: joint_fitness(seen, position_m.reshape(PARTICLES, -1, 3))[:, None])
all_at_once = optimiser.SwarmParams(
    inertia=params.inertia,
    cognitive=params.cognitive,
    social=params.social,
    max_step=jnp.tile(params.max_step, len(predicted_m)),
    low=params.low.reshape(1, -1),
    high=params.high.reshape(1, -1),
)
# The top of each hill, from a swarm with many particles and iterations.
top_m = optimiser.run(jax.random.key(0), fitness, jnp.tile(first_m, (10, 1, 1)), params, 300).gbest_position

distance_mm = {"a swarm per drone": [], "one swarm for all": []}
for seed in range(SEEDS):
    key_spread, key_swarm = jax.random.split(jax.random.key(100 + seed))
    begin_m = predicted_m + SPREAD_M * jax.random.normal(key_spread, first_m.shape)
    own, together = (
        optimiser.init(begin_m, params),
        optimiser.init(begin_m.reshape(PARTICLES, 1, -1), all_at_once),
    )
    for iteration in range(ITERATIONS):
        key = jax.random.fold_in(key_swarm, iteration)
        own, together = step(key, fitness, own, params), step(key, joint, together, all_at_once)
        for name, found in (("a swarm per drone", own), ("one swarm for all", together)):
            off_m = found.gbest_position.reshape(-1, 3) - top_m
            distance_mm[name].append(1e3 * float(jnp.linalg.norm(off_m, axis=1).mean()))

figure, axes = plt.subplots(figsize=(9, 3.8), layout="constrained")
for (name, values), colour in zip(distance_mm.items(), ("#0072b2", "#d55e00"), strict=True):
    runs = np.array(values).reshape(SEEDS, ITERATIONS)
    axes.fill_between(
        np.arange(ITERATIONS), *np.percentile(runs, (10, 90), axis=0), color=colour, alpha=0.2, linewidth=0
    )
    axes.plot(np.median(runs, axis=0), color=colour, linewidth=2, label=name)
axes.set(xlabel="iteration", ylabel="best place to the top of the hill,\nmean over drones (mm)", yscale="log")
axes.legend(frameon=False, title=f"{PARTICLES} particles, {len(predicted_m)} drones, {SEEDS} seeds")
axes.grid(alpha=0.3, which="both")
plt.show()

# %% [markdown]
# *What to see: the distance of the best known position from the position with the highest score, over the iterations;
# median over the seeds, bands from the 10th to the 90th percentile; the scale is logarithmic. Separate swarms reduce
# the distance by a constant factor in every iteration; the joint swarm is slower, and slows down with the number of
# drones. In the tracker a paraboloid through the score about the best position removes most of the remaining distance,
# so the tracker needs far fewer iterations than this figure suggests.*
#
# Next: [what particles and iterations cost and buy](table_5.ipynb) over whole recordings.
