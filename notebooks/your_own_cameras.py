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
# # Your own cameras
#
# You have videos of several cameras that stood still, and a calibration from OpenCV, anipose or the like: for each
# camera `K`, `R`, `t` and the lens distortion. This notebook goes from there to tracks:
#
# 1. the calibration becomes a rig of psotrack, in metres, with z up and the floor at z = 0,
# 2. the rig is checked with points that you know,
# 3. rig and videos become a folder that every command of psotrack reads,
# 4. the drones are tracked,
# 5. if something is wrong, the cause is found.

# %%
import json
import os
import shutil
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.patches import Rectangle
from scipy.spatial.transform import Rotation

from psotrack.datasets.dpjait import CALIBRATION, read_sequence, write_calibration
from psotrack.evaluation import evaluate, plots
from psotrack.geometry import (
    Rig,
    make_camera,
    make_extents,
    make_rig,
    project,
    project_boxes,
    triangulate,
    undistort,
)
from psotrack.pipeline import track_runs
from psotrack.recordings import VideoWriter, describe_recording, probe, read_frames
from psotrack.settings import DroneSettings, TrackSettings
from psotrack.silhouettes import compute, summed_area_table
from psotrack.silhouettes.computation import SilhouetteSettings
from psotrack.simulation import SimulationSettings, simulate
from psotrack.support import keep_compiled
from psotrack.tracking import SoftIoU, on_device
from psotrack.tracking.fitness import camera_scores, score_inputs

# %%
TINY = os.environ.get("PSOTRACK_NOTEBOOKS") == "tiny"  # a quick check that everything runs
NUM_FRAMES = 20 if TINY else 75
SCALE = 0.25 if TINY else 0.5
SILHOUETTES = SilhouetteSettings(reduction=2, working_reduction=1)
if TINY:  # so few pixels per drone that noise counts
    SILHOUETTES = SilhouetteSettings(reduction=1, working_reduction=1, min_blob_px=32, var_threshold=16.0)
FRAME = 10  # the frame that is shown
TURN_DEG = 0.5 if TINY else 1.5  # angle by which a camera is turned in the last section
DATA = Path("data", "tiny" if TINY else "normal")
FOREIGN = DATA / "foreign"  # what stands for your files
FOLDER = DATA / "my_recording"  # the folder that psotrack reads
plt.rcParams.update({"figure.dpi": 80, "font.size": 9})
keep_compiled(Path("data", "compiled"))

# %% [markdown]
# ## Files of this example
#
# Skip these two cells if you have your own files. The cells change a simulated recording into a recording of another
# program: with other names, lens distortion (the videos are resampled), millimetres, and the first camera's frame as
# the world, as after stereo calibration. Besides videos and calibration there are *marks*: six points whose positions
# in the room you know (tape on the floor, a pole), with the pixels where you clicked on them in each picture.

# %%
folder = DATA / "Simulated_Data" / "S02_D4_A"
if not folder.exists():
    simulation = SimulationSettings(num_frames=NUM_FRAMES, scale=SCALE, masks=False, onboard=False)
    simulate("S02_D4_A", DATA, simulation)
simulated = read_sequence(folder).usable()
FOREIGN.mkdir(exist_ok=True)
calibration = {}
T_first_world = simulated.rig.cameras.T_cam_world[0]
for number, video in enumerate(simulated.videos.values()):
    ideal = simulated.rig.cameras[number]
    T_cam_first = ideal.T_cam_world @ np.linalg.inv(T_first_world)
    K = ideal.K * np.array([[1.06, 1, 1], [1, 1.06, 1], [1, 1, 1]])
    calibration[f"gopro{number + 1}"] = {
        "size": list(video.image_size_wh),
        "matrix": K.tolist(),
        "distortions": [-0.09, 0.02, 0.0005, -0.0003, 0.0],
        "rotation": Rotation.from_matrix(T_cam_first[:3, :3]).as_rotvec().tolist(),
        "translation": (1000 * T_cam_first[:3, 3]).tolist(),
    }
(FOREIGN / "calibration.json").write_text(json.dumps(calibration, indent=1))

bent = make_rig(
    {
        name: make_camera(
            R=np.array(simulated.rig.cameras.T_cam_world[number, :3, :3]),
            t_m=np.array(simulated.rig.cameras.T_cam_world[number, :3, 3]),
            K=np.array(one["matrix"]),
            dist=one["distortions"],
            image_size_wh=tuple(one["size"]),
        )
        for number, (name, one) in enumerate(calibration.items())
    }
)
marks_m = np.array(
    [
        [1.5, 1.5, 0.0],
        [-1.5, 1.5, 0.0],
        [-1.5, -1.5, 0.0],
        [1.5, -1.5, 0.0],
        [0.0, 0.0, 0.0],
        [0.0, 0.0, 1.2],
    ]
)
clicked_px, depth_m = project(bent.cameras, marks_m[:, None])
inside = (depth_m > 0) & ((clicked_px >= 0) & (clicked_px < bent.cameras.image_size_wh)).all(axis=-1)
# Marks that are clicked by hand have an error of about half a pixel.
clicked_px = np.where(inside[..., None], np.round(2 * clicked_px) / 2, np.nan)
np.savez(FOREIGN / "marks.npz", marks_m=marks_m, clicked_px=clicked_px)

# %%
for number, (name, video) in enumerate(zip(bent.names, simulated.videos.values(), strict=True)):
    path = FOREIGN / f"{name}.avi"
    if path.exists():
        continue
    width, height = video.image_size_wh
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(float)
    straight = undistort(bent.cameras[number], pixels)
    K = simulated.rig.cameras.K[number]
    source = (straight * K[[0, 1], [0, 1]] + K[:2, 2]).astype(np.float32)
    with VideoWriter(path, video.fps, video.image_size_wh) as writer:
        for image in read_frames(video):
            writer.write(cv2.remap(image, source, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
print(*sorted(path.name for path in FOREIGN.iterdir()), sep=", ")

# %% [markdown]
# ## 1. The calibration becomes a rig
#
# `make_camera` takes what OpenCV's `calibrateCamera` and `stereoCalibrate` give: `R` and `t` from the world to the
# camera ($x_{cam} = R\,x_{world} + t$; if you have the camera's position $C$ instead, $t = -R\,C$), `K` in pixels,
# and 0, 4, 5 or 8 distortion coefficients in OpenCV's order. SciPy converts rotation vectors to matrices. Lengths are
# converted to metres here.

# %%
calibration = json.loads((FOREIGN / "calibration.json").read_text())
first_rig = make_rig(
    {
        name: make_camera(
            R=Rotation.from_rotvec(one["rotation"]).as_matrix(),
            t_m=np.array(one["translation"]) / 1000,
            K=np.array(one["matrix"]),
            dist=one["distortions"],
            image_size_wh=tuple(one["size"]),
        )
        for name, one in calibration.items()
    }
)

# %% [markdown]
# The world of this rig is its first camera. psotrack wants z up and the floor at z = 0: it looks for drones in a room,
# and for shadows on its floor. The marks give the transformation between the two worlds: triangulate the marks in the
# world of the calibration, and fit the result to the positions that you measured.

# %%
marks = np.load(FOREIGN / "marks.npz")
marks_m, clicked_px = (
    marks["marks_m"],
    marks["clicked_px"],
)  # (marks, 3); (marks, cameras, 2), NaN where not seen
in_first_m = triangulate(first_rig.cameras, clicked_px)

middle_m, first_middle_m = marks_m.mean(axis=0), in_first_m.mean(axis=0)
turn, _ = Rotation.align_vectors(in_first_m - first_middle_m, marks_m - middle_m)
T_first_room = np.eye(4)
T_first_room[:3, :3] = turn.as_matrix()
T_first_room[:3, 3] = first_middle_m - turn.apply(middle_m)

moved = replace(first_rig.cameras, T_cam_world=first_rig.cameras.T_cam_world @ T_first_room)
rig = Rig(first_rig.names, moved)

scale = np.linalg.norm(in_first_m - first_middle_m) / np.linalg.norm(marks_m - middle_m)
left_m = np.linalg.norm(triangulate(rig.cameras, clicked_px) - marks_m, axis=1)
print(f"the calibration's lengths are {scale:.4f} times the tape measure's")
print(
    f"after turning, marks are {1e3 * left_m.mean():.1f} mm off on average, {1e3 * left_m.max():.1f} at most"
)

# %% [markdown]
# The first number, the scale, should be 1.000. A scale of 1000 means that millimetres were read as metres. A scale
# that is a few per cent off means that the calibration board's squares have another size than was stated. The second
# number, the residual, should be a few millimetres.
#
# ## 2. Check the rig
#
# Project the known points and compare them with the pictures. This finds nearly every mistake: a transposed `R`,
# the centre in place of `t`, exchanged names of cameras, a video of another size than the calibration's.

# %%
projected_px, depth_m = project(rig.cameras, marks_m[:, None])
off_px = np.linalg.norm(projected_px - clicked_px, axis=-1)
pd.DataFrame(
    {
        "marks seen": np.isfinite(off_px).sum(axis=0),
        "mean (pixels)": np.nanmean(off_px, axis=0),
        "largest (pixels)": np.nanmax(off_px, axis=0),
        "height of the camera (m)": rig.cameras.centre_world[:, 2],
    },
    index=pd.Index(rig.names, name="camera"),
).round(2)

# %%
figure, panels = plt.subplots(1, 2, figsize=(13, 3.9), dpi=64, layout="constrained")
for panel, number in zip(panels, (0, 2), strict=True):
    name = rig.names[number]
    image = next(read_frames(probe(FOREIGN / f"{name}.avi")))
    panel.imshow(image[:, :, ::-1])
    for axis, colour in zip(np.eye(3), ("#d55e00", "#009e73", "#0072b2"), strict=True):
        line_px, _ = project(rig.cameras[number], np.linspace(0, 1, 20)[:, None] * axis)
        panel.plot(*line_px.T, color=colour, linewidth=2.5)
    panel.plot(*projected_px[:, number].T, "o", color="none", markeredgecolor="#ffd400", markersize=11)
    panel.plot(*clicked_px[:, number].T, "+", color="white", markersize=8)
    panel.set(title=name, xlabel="x (pixels)", ylabel="y (pixels)")
plt.show()

# %% [markdown]
# *What to see: in each picture the six clicked marks (crosses) and their projections by the rig (rings): every cross is
# in the middle of its ring. The axes of the room, one metre each, begin at the mark in the middle of the floor: x
# orange, y green, z blue. z points up, and ends near the top of the pole, at 1.2 m.*
#
# ## 3. A folder that psotrack reads
#
# One calibration file, and one video per camera, named like the camera (`.avi` or `.mp4`). The file's layout is the
# DPJAIT dataset's: one focal length per camera, no skew, k1, k2, p1, p2. With OpenCV, calibrate with
# `CALIB_FIX_ASPECT_RATIO` and `CALIB_FIX_K3`. If your calibration has two focal lengths or more
# coefficients, `write_calibration` raises an error. Then use Python: the rest of this notebook needs only
# `psotrack.recordings.Recording(name, folder, rig, videos)`, with `videos` from `psotrack.recordings.probe`.

# %%
FOLDER.mkdir(exist_ok=True)
write_calibration(FOLDER / CALIBRATION, rig)
for name in rig.names:
    shutil.copy(FOREIGN / f"{name}.avi", FOLDER)

recording = read_sequence(FOLDER).usable()  # says what does not fit: sizes, rates, lengths, names
pd.DataFrame(describe_recording(recording)["cameras"]).T.drop(columns=["video", "detections"])

# %% [markdown]
# `psotrack info my_recording` prints the same as a table. Videos must begin at the same moment; a camera
# that is 20 ms late shows a drone at 2 m/s up to 40 mm from its true position.
#
# ## 4. Track
#
# From here on, `psotrack track my_recording --drones 4 --out tracks.csv` does the same. The number of drones is
# optional. With `--drones`, other moving things start no tracks.

# %%
settings = TrackSettings(silhouettes=SILHOUETTES, drones=DroneSettings(count=4))
silhouettes = compute(recording, SILHOUETTES, cache=DATA / "silhouettes")
(tracked,) = track_runs(recording, silhouettes, [settings])
tracks = tracked.trajectories
print(f"{tracks.num_drones} drones, {np.mean(tracks.seen):.0%} of all frames tracked")
pd.DataFrame(tracked.size_m, columns=["size x (m)", "size y (m)", "size z (m)"]).round(2)

# %% [markdown]
# Your own recordings usually have no ground truth. Check three things instead: the boxes are on the drones, in every
# camera; the fitness is steady; all cameras agree.

# %%
cameras = on_device(rig.cameras)
seen = make_extents(cameras, jnp.asarray(tracked.size_m, jnp.float32))
xyxy_px = np.asarray(project_boxes(seen, jnp.asarray(tracks.position_m[FRAME], jnp.float32)).xyxy)
figure, panels = plt.subplots(2, 4, figsize=(13, 4.2), dpi=64, layout="constrained")
for number, (panel, name) in enumerate(zip(panels.flat, rig.names, strict=True)):
    image = next(islice(read_frames(recording.videos[name]), FRAME, None))
    panel.imshow(image[:, :, ::-1])
    for drone, (left, top, right, bottom) in enumerate(xyxy_px[:, number] - 0.5):
        edge = plots.drone_colour(drone)
        panel.add_patch(
            Rectangle((left, top), right - left, bottom - top, fill=False, edgecolor=edge, linewidth=1.5)
        )
    panel.set(title=f"{name}, frame {FRAME}", xticks=[], yticks=[])
plt.show()

# %% [markdown]
# *What to see: one frame in all eight cameras, 960 x 540 pixels each, with the tracked boxes; a colour is a drone.
# Every box is around a drone, which may be hidden behind a pillar or another drone.*

# %%
figure, (top, bottom) = plt.subplots(2, 1, figsize=(9, 4.2), sharex=True, layout="constrained")
for drone in range(tracks.num_drones):
    colour = plots.drone_colour(drone)
    top.plot(tracks.time_s, tracks.fitness[:, drone], color=colour, label=f"drone {drone}")
    bottom.plot(tracks.time_s, tracks.num_cameras[:, drone], color=colour, drawstyle="steps-mid")
top.axhline(settings.status.min_fitness, color="#2b313a", linestyle=":", label="not found below this")
top.set(ylabel="fitness (0 to 1)", ylim=(0, None))
bottom.set(xlabel="time (s)", ylabel="cameras with foreground\nat the drone", ylim=(0, len(rig) + 0.5))
top.legend(frameon=False, ncols=5, loc="lower left", bbox_to_anchor=(0, 1))
top.grid(alpha=0.3)
bottom.grid(alpha=0.3)
plt.show()

# %% [markdown]
# *What to see: a steady fitness, far above the dotted line, and nearly all cameras at nearly all times. This is a good
# result. If one curve drops, a drone is hidden or leaves; if all curves drop, the light changes.*
#
# This recording has a ground truth, because it is simulated:

# %%
evaluation = evaluate(tracks, simulated.truth)
print(f"mean error {1e3 * evaluation.mean_error_m:.0f} mm, identity switches {evaluation.id_switches}")

# %% [markdown]
# ## 5. Find the camera that is wrong
#
# A tripod was moved after the calibration: `gopro3` looks a little to the side. The tracker still works, a little
# less accurately, because seven cameras are right. Each camera's own score at the tracked positions shows which
# camera is wrong.

# %%
knocked = rig.names.index("gopro3")
T_cam_world = rig.cameras.T_cam_world.copy()
T_turn = np.eye(4)
T_turn[:3, :3] = Rotation.from_euler("y", TURN_DEG, degrees=True).as_matrix()
T_cam_world[knocked] = T_turn @ T_cam_world[knocked]
turned_rig = Rig(rig.names, replace(rig.cameras, T_cam_world=T_cam_world))
(turned,) = track_runs(replace(recording, rig=turned_rig), silhouettes, [settings])

frames = range(0, recording.num_frames, 5)
rigs = {"as calibrated": (rig, tracked), f"gopro3 turned by {TURN_DEG} deg": (turned_rig, turned)}
mean_score = {}
soft = SoftIoU()
scores = jax.jit(
    lambda rig, size_m, tables, at_m: camera_scores(
        score_inputs(rig, size_m, tables, soft, reduction=SILHOUETTES.reduction), at_m
    )
)
for label, (of_rig, of_tracks) in rigs.items():
    cameras, size_m = on_device(of_rig.cameras), jnp.asarray(of_tracks.size_m, jnp.float32)
    each = []
    for index in frames:
        tables = summed_area_table(jnp.asarray(silhouettes.read(index, index + 1)[0], jnp.int32))
        at_m = jnp.asarray(of_tracks.trajectories.position_m[index], jnp.float32)
        score, weight = scores(cameras, size_m, tables, at_m)
        each.append(np.where(weight > 0.5, score, np.nan))  # where the camera sees most of the drone
    mean_score[label] = np.nanmean(each, axis=(0, 1))

figure, axes = plt.subplots(figsize=(9, 3.2), layout="constrained")
number = np.arange(len(rig))
for shift, (label, score), colour in zip(
    (-0.2, 0.2), mean_score.items(), ("#9aa3ad", "#d55e00"), strict=True
):
    axes.bar(number + shift, score, 0.4, label=label, color=colour)
axes.set_xticks(number, rig.names)
axes.set(xlabel="camera", ylabel="soft IoU (0 to 1),\nmean over frames and drones")
axes.legend(frameon=False, ncols=2, loc="lower left", bbox_to_anchor=(0, 1))
plt.show()
print(
    f"mean error with the turned camera {1e3 * evaluate(turned.trajectories, simulated.truth).mean_error_m:.0f} mm"
)

# %% [markdown]
# *What to see: with the correct rig all cameras have similar scores. If one camera is turned, its bar falls far below
# the bars of the other cameras, which fall a little. Leave the camera out (`--cameras`, or
# `recording.usable(cameras=[...])`) or calibrate it again.*
#
# | What you see | Look at | Likely cause |
# |---|---|---|
# | no drones found | silhouettes: `compute(...).read(0, 10)`, camera by camera | the drones stand still for most of the video; `silhouettes.var_threshold` too high for dark drones before a dark wall |
# | false drones | silhouettes, as above | shadows, people, moving curtains: `silhouettes.shadows = "drop"`, `bounds_m` |
# | marks are off by 10 pixels or more in one camera | the picture of this camera with the marks | the camera was moved, or the video has another size or crop than the calibration |
# | marks are off in all cameras | scale and axes in step 1 | millimetres, transposed `R`, centres taken for `t` |
# | boxes beside the drones that swing with their speed | one camera's score against the speed | videos do not begin at the same moment |
# | boxes right, but too large or small | `tracked.size_m` | shadows in the silhouettes; state the size with `drones.size_m` |
# | two drones change names | `tracked.identities.encounters` | they passed each other; look at their distance and at the number of viewpoints |
