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
# # From a video to a score
#
# For very many points per frame, the tracker computes how well a drone at the point explains the cameras' images. The
# result is a number in [0, 1], the soft IoU. This notebook computes it step by step:
#
# frame → foreground → silhouette → box of a drone at a point → overlap of the two
#
# and then draws the soft IoU over space: the swarm searches this landscape for its highest point.

# %%
import os
from functools import partial
from itertools import islice
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Rectangle

from psotrack.foreground.silhouettes import (
    Living,
    SilhouetteSettings,
    compute,
    coverage,
    look_first,
    scaled_settings,
    summed_area_table,
)
from psotrack.geometry import make_extents, project_boxes
from psotrack.recordings import read_frames
from psotrack.recordings.datasets import read_sequence
from psotrack.settings import DroneSettings
from psotrack.simulation import SimulationSettings, simulate
from psotrack.support import keep_compiled
from psotrack.tracking.births import first_drones, room_bounds
from psotrack.tracking.swarm import SoftIoU, on_device
from psotrack.tracking.swarm.fitness import PAPER_SCORE, camera_scores, drone_fitness, score_inputs

# %%
TINY = os.environ.get("PSOTRACK_NOTEBOOKS") == "tiny"  # a quick check that everything runs
NUM_FRAMES = 20 if TINY else 75
SCALE = 0.25 if TINY else 0.5
SILHOUETTES = SilhouetteSettings(reduction=2, working_reduction=1)
if TINY:  # so few pixels per drone that noise counts
    SILHOUETTES = SilhouetteSettings(reduction=1, working_reduction=1, min_blob_px=32)
FRAME = 10  # the frame that is looked at
DRONE, CAMERAS = 2, (2, 0)  # the drone and the cameras that are looked at
HALF_M, STEP_M = 0.4, 0.04 if TINY else 0.01  # half the side of a slice of the landscape, and its step
ROOM_STEP_M = 0.2 if TINY else 0.04  # step of the map of the whole room
DATA = Path("data", "tiny" if TINY else "normal")
plt.rcParams.update({"figure.dpi": 80, "font.size": 9})
keep_compiled(Path("data", "compiled"))

# %%
folder = DATA / "Simulated_Data" / "S02_D4_A"
if not folder.exists():  # the same recording as in the quickstart
    simulation = SimulationSettings(num_frames=NUM_FRAMES, scale=SCALE, masks=False, onboard=False)
    simulate("S02_D4_A", DATA, simulation)
recording = read_sequence(folder).usable()
truth_m = recording.truth.position_m[FRAME]
names = recording.rig.names

# %% [markdown]
# ## Frame → foreground → silhouette
#
# The cameras stand still, so a pixel shows the background most of the time. A background model learns what each pixel
# usually shows from a first look at the whole video, and goes on learning from frame to frame; what differs from the model and
# ends in sharp edges is foreground. The tracker reads a coarser picture: each value of a *silhouette* is the share of a
# small square of pixels that is foreground, 0 to 255. `psotrack.foreground.silhouettes.compute` does the same for all cameras and
# frames, and keeps the result.

# %%
scaled = scaled_settings(SILHOUETTES, recording)
images, masks = [], []
for camera in CAMERAS:
    video = recording.videos[names[camera]]
    first_look, frames = look_first(video, read_frames(video), scaled)
    foreground = Living(scaled).masks(first_look, frames)
    images.append(next(islice(read_frames(video), FRAME, None)))
    masks.append(next(islice(foreground, FRAME, None)))

silhouettes = compute(recording, SILHOUETTES, cache=DATA / "silhouettes")
seen = silhouettes.read(FRAME, FRAME + 1)[0]  # cameras, height, width
for camera, mask in zip(CAMERAS, masks, strict=True):  # just so they are made
    assert np.array_equal(coverage(mask, scaled.reduction // scaled.working_reduction), seen[camera])

# %% [markdown]
# ## A point → a box in every camera
#
# The sizes of the drones are those of their blobs in the first frames. An ellipsoid of that size at a point has a box in each
# camera. The score compares three concentric boxes, its *windows*, with the silhouette; a larger *ring* shows
# foreground beside the windows.

# %%
start = first_drones(
    recording.rig,
    silhouettes,
    fps=recording.fps,
    bounds_m=room_bounds(recording.rig),
    max_speed_m_s=6.0,
    drones=DroneSettings(),
)
# Of the found drones, the drone nearest to the initial position of the shown drone is used.
path_m = recording.truth.position_m[1:10, DRONE].mean(axis=0)
found = np.linalg.norm(start.position_m - path_m, axis=1).argmin()
size_m = jnp.asarray(start.size_m[found : found + 1], jnp.float32)
print("size of the drone, x y z:", np.round(start.size_m[found], 2), "m")

cameras = on_device(recording.rig.cameras)
place_m = jnp.asarray(truth_m[DRONE], jnp.float32)
boxes = project_boxes(make_extents(cameras, size_m), place_m[None])
xyxy_px = np.asarray(boxes.xyxy)[0]  # cameras, 4

# %%
soft = SoftIoU()
hard = PAPER_SCORE

windows = [(scale, "#56b4e9", "-") for scale in soft.windows] + [(soft.ring, "#e69f00", "--")]
# Edges of the pictures in pixels of the image, whose first pixel's centre is (0, 0).
extent = (
    -0.5,
    SILHOUETTES.reduction * seen.shape[2] - 0.5,
    SILHOUETTES.reduction * seen.shape[1] - 0.5,
    -0.5,
)

figure, panels = plt.subplots(
    len(CAMERAS), 4, figsize=(13, 6.6), layout="constrained", sharex="row", sharey="row"
)
for row, camera, image, mask in zip(panels, CAMERAS, images, masks, strict=True):
    low_px, high_px = xyxy_px[camera].reshape(2, 2) - 0.5
    middle_px, half_px = (low_px + high_px) / 2, (high_px - low_px) / 2
    row[0].imshow(image[:, :, ::-1])
    row[1].imshow(mask, cmap="gray", extent=extent)
    row[2].imshow(seen[camera], cmap="gray", extent=extent)
    row[3].imshow(seen[camera], cmap="gray", extent=extent)
    for scale, colour, line in windows:
        corner, sides = middle_px - scale * half_px, 2 * scale * half_px
        row[3].add_patch(
            Rectangle(corner, *sides, fill=False, edgecolor=colour, linestyle=line, linewidth=1.5)
        )
    for panel, title in zip(row, ("frame", "foreground", "silhouette", "windows and ring"), strict=True):
        panel.set(title=f"{names[camera]}: {title}", xlabel="x (pixels)")
    shown_px = 3.2 * half_px.max()
    row[0].set_ylabel("y (pixels)")
    row[0].set_xlim(middle_px[0] - shown_px, middle_px[0] + shown_px)
    row[0].set_ylim(middle_px[1] + shown_px, middle_px[1] - shown_px)
plt.show()

# %% [markdown]
# *What to see, from left to right: one drone, cut out of the frame; the foreground, drone and rotors; the foreground
# at the tracker's resolution; and the three windows (solid, 0.4, 0.7 and 1 times the drone's box) and the ring
# (dashed, 1.5 times) of a drone at the true position. Above, a camera that sees the drone alone: the windows are on
# the silhouette. Below, a camera in which a second drone is directly behind: two drones, one silhouette.*
#
# ## Box and silhouette → soft IoU
#
# For a window of scale $s$, with foreground $F_s$ in it, area $A_s$, and foreground $F_{ring}$ in the ring:
#
# $$\mathrm{IoU}_s = \frac{F_s}{A_s + F_{ring} - F_s},\qquad \mathrm{score} = \text{mean over the windows.}$$
#
# The score never reaches 1, because drones do not fill their boxes. Edges of boxes lie between pixels, and the
# foreground in them is summed exactly, by area, so the score changes smoothly as the point moves. A drone's fitness is
# the mean over the cameras that see it.

# %%
tables = summed_area_table(jnp.asarray(seen, jnp.int32))
score, weight = camera_scores(
    score_inputs(cameras, size_m, tables, soft, reduction=SILHOUETTES.reduction), place_m[None]
)
moved, _ = camera_scores(
    score_inputs(cameras, size_m, tables, soft, reduction=SILHOUETTES.reduction),
    place_m[None] + jnp.array([0.15, 0.0, 0.0]),
)

figure, axes = plt.subplots(figsize=(9, 2.8), layout="constrained")
number = np.arange(len(recording.rig))
axes.bar(number - 0.2, score[0], 0.4, label="at the true position", color="#0072b2")
axes.bar(number + 0.2, moved[0], 0.4, label="0.15 m beside it, along x", color="#9aa3ad")
axes.set_xticks(number, names)
axes.set(xlabel="camera", ylabel="soft IoU (0 to 1)")
axes.legend(frameon=False, ncols=2, loc="lower left", bbox_to_anchor=(0, 1))
plt.show()

# %% [markdown]
# *What to see: nearly every camera prefers the true position. A camera that looks along x hardly notices a step along
# x. `cam1`, in which two drones are one silhouette, prefers the wrong position. No single camera determines the
# position; the mean over all cameras does. (The tracker also leaves out the part of an image that another drone is
# expected to cover; see `psotrack.tracking.swarm.occlusion`.)*
#
# ## The landscape around a drone
#
# The score as a function of the point: slices through the true position. Beside it the score of the paper: one
# window, with edges rounded to whole pixels.

# %%
line_m = np.arange(-round(HALF_M / STEP_M), round(HALF_M / STEP_M) + 1) * STEP_M
across_m, up_m = np.meshgrid(line_m, line_m)
edge_m = HALF_M + STEP_M / 2
slices = {"x": "y", "y": "z"}  # what is to the right, what is up
scores = {"soft score": soft, "the paper's hard score": hard}

figure, panels = plt.subplots(2, 3, figsize=(13, 7.4), layout="constrained")
for row, (label, compared) in zip(panels, scores.items(), strict=True):
    fitness_at = jax.jit(
        partial(
            drone_fitness, score_inputs(cameras, size_m, tables, compared, reduction=SILHOUETTES.reduction)
        )
    )
    for panel, (right, up) in zip(row, slices.items(), strict=False):
        offset_m = np.zeros((*across_m.shape, 3))
        offset_m[..., "xyz".index(right)], offset_m[..., "xyz".index(up)] = across_m, up_m
        height = np.asarray(fitness_at(place_m + jnp.asarray(offset_m[..., None, :], jnp.float32)))[..., 0]
        shown = panel.imshow(
            height, origin="lower", extent=(-edge_m, edge_m, -edge_m, edge_m), vmin=0, vmax=0.4
        )
        panel.contour(line_m, line_m, height, levels=np.arange(0.05, 1, 0.05), colors="white", linewidths=0.5)
        best = np.unravel_index(height.argmax(), height.shape)
        panel.plot(0, 0, "+", color="white", markersize=12, markeredgewidth=1.5, label="truth")
        panel.plot(
            line_m[best[1]],
            line_m[best[0]],
            "o",
            color="none",
            markeredgecolor="#ff4d4d",
            markersize=9,
            markeredgewidth=1.5,
            label="maximum",
        )
        panel.set(
            xlabel=f"{right} from the truth (m)",
            ylabel=f"{up} from the truth (m)",
            title=f"{label}, {right}-{up} slice",
        )
    row[0].legend(loc="upper right", facecolor="#2b313a", labelcolor="white", framealpha=0.6)
    figure.colorbar(shown, ax=row[1], shrink=0.8, label="fitness (0 to 1)")
    fine_m = np.linspace(-0.1, 0.1, 401)
    for axis, colour in zip("xyz", ("#0072b2", "#d55e00", "#009e73"), strict=True):
        offset_m = fine_m[:, None] * np.eye(3)["xyz".index(axis)]
        height = fitness_at(place_m + jnp.asarray(offset_m[:, None, :], jnp.float32))[:, 0]
        row[2].plot(1e3 * fine_m, height, color=colour, label=f"along {axis}")
    row[2].axvline(0, color="#2b313a", linewidth=0.8)
    row[2].set(
        xlabel="distance from the truth (mm)", ylabel="fitness (0 to 1)", title=f"{label}, near the top"
    )
    row[2].grid(alpha=0.3)
    row[2].legend(frameon=False)
plt.show()

# %% [markdown]
# *What to see. Heat maps: brighter is a better explanation; a contour every 0.05. Both scores have one hill, and the
# true position (cross) is near its top. Right, the top of the hill, 0.1 m to either side: the soft score is smooth, so
# a parabola through it gives the position of the top to millimetres. The hard score changes in steps, because a box
# changes only when an edge reaches the next pixel: neighbouring positions have the same score, and the choice between
# them is random. The top is a little beside the true position, because the ground truth describes the body's
# origin, and the score describes the silhouette's middle.*
#
# ## The landscape of the room
#
# The same score over the whole hall, at the height of this drone.

# %%
low_m, high_m = room_bounds(recording.rig)
x_m, y_m = np.arange(low_m[0], high_m[0], ROOM_STEP_M), np.arange(low_m[1], high_m[1], ROOM_STEP_M)
room_m = np.stack([*np.meshgrid(x_m, y_m), np.full((len(y_m), len(x_m)), truth_m[DRONE, 2])], axis=-1)
view = score_inputs(cameras, size_m, tables, soft, reduction=SILHOUETTES.reduction)
height = np.asarray(drone_fitness(view, jnp.asarray(room_m[..., None, :], jnp.float32)))[..., 0]

figure, axes = plt.subplots(figsize=(9, 6.4), layout="constrained")
shown = axes.pcolormesh(x_m, y_m, height, vmin=0, shading="nearest", rasterized=True)
figure.colorbar(shown, label="fitness (0 to 1)")
x, y, _ = recording.rig.cameras.centre_world.T
axes.plot(x, y, "^", color="#9aa3ad", markersize=8, label="camera")
axes.plot(*truth_m[DRONE, :2], "+", color="white", markersize=14, label="this drone")
others_m = np.delete(truth_m, DRONE, axis=0)
axes.plot(*others_m[:, :2].T, "x", color="#e69f00", markersize=8, linestyle="none", label="other drones")
for x, y, z in others_m:
    axes.annotate(f"z = {z:.2f} m", (x, y), (6, 4), textcoords="offset points", color="#e69f00", fontsize=8)
axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
axes.set_title(f"z = {truth_m[DRONE, 2]:.2f} m", loc="right")
axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, facecolor="#2b313a", labelcolor="white")
plt.show()

# %% [markdown]
# *What to see: one narrow bright hill in a dark plain. The drone is at this hill. At the faint patches, foreground in
# a few cameras agrees by chance: rays from cameras to the other drones, which are higher or lower, cross there. In
# most of the room the score has no slope towards the hill. A swarm finds the hill because it starts at the position
# that the motion model predicts. New drones are found in another way, from blobs that agree between cameras for several
# frames (`psotrack.tracking.births.births`).*
#
# Next: [how the swarm moves](how_the_swarm_moves.ipynb) in this landscape.
