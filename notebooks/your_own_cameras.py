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
# You have a folder with the videos of several cameras that stood still, and videos of a printed board that you moved
# before the same cameras. Five commands lead from there to tracks and a picture:
#
# 1. `psotrack calibrate rig` finds the lenses and the places of the cameras from the board,
# 2. `psotrack init` writes down which video belongs to which camera,
# 3. `psotrack doctor` looks for a camera that was moved, exchanged or is late,
# 4. `psotrack track` tracks the drones,
# 5. `psotrack evaluate` compares the tracks with a reference, if there is one, and draws them.

# %%
import json
import os
import sys
from itertools import islice
from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from IPython.display import Image
from matplotlib.patches import Rectangle

import psotrack as pt
from psotrack.evaluation import plots
from psotrack.geometry import make_extents, project_boxes
from psotrack.recordings import read_frames
from psotrack.tracking.swarm import on_device

# %%
TINY = os.environ.get("PSOTRACK_NOTEBOOKS") == "tiny"  # a quick check that everything runs
NUM_FRAMES = 20 if TINY else 100
DATA = Path("data", "tiny_laboratory" if TINY else "laboratory")
FRAME = 10  # the frame of each video that is shown
SMALL = {"dpi": 80} if not TINY else {"dpi": 40}
# The commands below are those of the environment in which this notebook runs; what they keep lies in `data`.
os.environ["PATH"] = str(Path(sys.executable).parent) + os.pathsep + os.environ["PATH"]
os.environ["PSOTRACK_CACHE"] = str(Path("data", "cache").resolve())
os.environ |= {"COLUMNS": "110", "TTY_COMPATIBLE": "0", "PSOTRACK_PROGRESS": "none"}  # plain text
plt.rcParams.update({"figure.dpi": SMALL["dpi"], "font.size": 9})

# %% [markdown]
# ## The folder of this example
#
# Skip this cell if you have videos of your own. The simulator makes what a laboratory would have: four cameras with
# names as people give them, two image sizes, three frame rates, lenses that distort, and clocks that differ by up to
# one and a half frames; the differences are not known. The board is a ChArUco board of 4 x 5 squares of 25 cm.

# %%
# !test -d {DATA} || psotrack simulate S02_D4_A --as-own-cameras --scale 0.5 --frames {NUM_FRAMES} --out {DATA} --quiet
pd.DataFrame(
    [
        {"file": f"{path.relative_to(DATA)}", "size (kB)": path.stat().st_size // 1024}
        for path in sorted(DATA.glob("**/*.avi"))
    ]
)

# %% [markdown]
# ## 1. Calibrate the rig
#
# The board's sizes are those of the print, measured with a ruler. `--floor 0` says that the board lies on the floor in
# frame 0: there is the origin of the world, and z points up.

# %%
# !psotrack calibrate rig {DATA}/board/*.avi --squares 4x5 --square 0.25 --marker 0.19 --dictionary 5x5_50 --floor 0 \
#     --out {DATA}/rig.toml --plot --force
Image(f"{DATA}/rig.png", width=1000)

# %% [markdown]
# *What to see: the corners of the board that each camera saw, coloured by their residuals. They cover the part of the
# image in which the drones will fly, and no part of an image is lighter than all others.*
#
# The table says how far the corners are from where the rig expects them (a few tenths of a pixel are usual), and how
# well each camera's place is known.
#
# ## 2. Which video belongs to which camera?
#
# `init` compares the names of files and cameras: `gopro3_clip.avi` belongs to `GoPro 3`. If a name says nothing, it asks
# for `--match CAMERA=FILE`. The result is a text file that you may edit.

# %%
# !psotrack init {DATA} --calibration {DATA}/rig.toml --force
print((DATA / "recording.toml").read_text())

# %% [markdown]
# ## 3. Is a camera wrong?
#
# The doctor compares what the cameras see in the flight itself. Here the drones are not detected by a network; the
# blobs of moving foreground serve.

# %%
# !psotrack doctor {DATA} --detections blobs

# %% [markdown]
# One camera began to film at another moment than `recording.toml` says: each of its frames shows a later scene than the
# same frame of the other cameras. If the time is known, it belongs into `recording.toml` (`time_offset_s`). If it is
# not, the next command finds it.
#
# ## 4. Track
#
# `--clocks auto` estimates the clock of each camera from the tracks. The cameras' frames are used at their own times: a
# track has a row for each instant of the fastest camera.

# %%
# !psotrack track {DATA} --clocks auto --out {DATA}/tracks.csv --force

# %%
tracks = pt.read_trajectories(DATA / "tracks.csv")
record = json.loads((DATA / "tracks.json").read_text())
clocks = pd.DataFrame(record["camera_clocks"]).T
start_s = pd.read_csv(DATA / "truth" / "clocks.csv").set_index("camera").start_s.rename(index=str)
clocks["true_s"] = start_s - start_s[clocks.index].median()
clocks[["offset_s", "offset_std_s", "true_s"]].round(4)

# %% [markdown]
# Only differences between the clocks can be seen, so that the median of the offsets is zero. The last column is what
# only the simulator knows.
#
# ## 5. Look
#
# With a reference (a motion capture system's C3D, a TUM file, or another track) `evaluate` states errors. In this
# folder lie `dron1.tum` and so on, which `init` has found.

# %%
# !psotrack evaluate {DATA}/tracks.csv {DATA} --plot --force
Image(f"{DATA}/tracks.png", width=620)

# %% [markdown]
# *What to see: above, the tracks (coloured) on the true paths (dashed), and their shadows on the floor. Below, the
# error over time.*
#
# A recording without a reference is checked by eye: the boxes must be on the drones in every camera.

# %%
recording = pt.read_recording(DATA)
sizes_m = jnp.asarray([drone["size_m"] for drone in record["drones"]], jnp.float32)
figure, panels = plt.subplots(1, 4, figsize=(13, 2.7), layout="constrained")
for number, (panel, name) in enumerate(zip(panels, recording.rig.names, strict=True)):
    time_s = recording.by_name[name].times.time_s[FRAME] + clocks.offset_s[name]
    position_m = np.stack(
        [
            [np.interp(time_s, tracks.time_s, axis) for axis in drone.T]
            for drone in tracks.position_m.swapaxes(0, 1)
        ]
    )
    seen = make_extents(on_device(recording.rig.cameras), sizes_m)
    xyxy_px = np.asarray(project_boxes(seen, jnp.asarray(position_m, jnp.float32)).xyxy)
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
# *What to see: frame 10 of each video, at four different times, with the boxes where the tracks say that the drones were
# at the time of that frame; a colour is a drone.*
#
# | What you see | Look at | Likely cause |
# |---|---|---|
# | `calibrate rig`: the board is not the one that is stated | the line says what it sees | another dictionary; columns and rows exchanged |
# | no drones found | `psotrack detect --silhouettes`, camera by camera | the drones stand still for most of the video; dark drones before a dark wall: `--background mog2` with a lower `--var-threshold` |
# | false drones | silhouettes, as above | people, vehicles, small things that move: an `ignore` image, `bounds_m`, `--drone-px` |
# | boxes beside the drones in one camera | `psotrack doctor` | the camera was moved after the calibration, or the video has another size or crop |
# | boxes beside the drones that swing with their speed | `psotrack track --clocks auto` | the videos do not begin at the same moment |
# | boxes right, but too large or small | `size_m` in `tracks.json` | shadows in the silhouettes; state the size with `--drone-size` |
# | two drones change names | `tracks.ambiguity.csv` | they passed each other; look at their distance and at the number of viewpoints |
