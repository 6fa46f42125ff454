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
# # Quickstart
#
# Four drones fly in a hall, and eight cameras on its walls record them. From the videos alone: where is each drone, in
# 3D, in every frame?
#
# This notebook simulates such a recording, shows it, tracks the drones, compares the tracks with the ground truth, and
# writes a table. The second run is faster, because silhouettes and compiled programs are stored.

# %%
import os
from pathlib import Path

# The second run does not wait for the compiler.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", "data/compiled")
import matplotlib.pyplot as plt
import pandas as pd

import psotrack as pt

# %% [markdown]
# All sizes are set here. Images have half of their full size to save time; use `SCALE = 1.0` and no settings of
# silhouettes for the full size.

# %%
TINY = os.environ.get("PSOTRACK_NOTEBOOKS") == "tiny"  # a quick check that everything runs
NUM_FRAMES = 20 if TINY else 75
SCALE = 0.25 if TINY else 0.5
SETTINGS = {"seed": 1, "silhouettes.reduction": 2, "silhouettes.working_reduction": 1}
if TINY:  # so few pixels per drone that noise counts
    SETTINGS |= {"silhouettes.reduction": 1, "silhouettes.min_blob_px": 32}
DATA = Path("data", "tiny" if TINY else "normal")
plt.rcParams.update({"figure.dpi": 80, "font.size": 9})

# %% [markdown]
# ## A recording
#
# `simulate` writes the same folder that a real recording has: one video per camera and the cameras' calibration. A
# simulation also has the ground truth.

# %%
folder = DATA / "Simulated_Data" / "S02_D4_A"
if not folder.exists():
    simulation = pt.SimulationSettings(num_frames=NUM_FRAMES, scale=SCALE, masks=False, onboard=False)
    pt.simulate("S02_D4_A", DATA, simulation)
recording = pt.read_recording(folder)
recording

# %% [markdown]
# The tracker uses only the drones' silhouettes in the videos: no markers, no colours, no model of a drone's appearance.
# `pt.doctor(recording)` checks a calibration before tracking.

# %% [markdown]
# ## Track
#
# One call makes silhouettes from the videos (in several processes; they are kept in `cache`), finds the drones when they
# come, and follows them. The call does not say how many drones there are, where they start or how large they are.

# %%
tracked = pt.track(recording, SETTINGS, cache=DATA / "silhouettes")
tracked

# %% [markdown]
# `tracked.trajectories.position_m` is an array: frames, drones, x y z in metres.

# %%
pd.Series(tracked.record["seconds"], name="seconds").to_frame().T.round(1)

# %% [markdown]
# Seconds per stage: `decode` and `foreground` are summed over processes, and 0 when the silhouettes were in the cache;
# `compile` is short when the compiled program was on disk; `track` is the time of all frames.
#
# ## See it

# %%
picture = DATA / "quickstart.png"
pt.save_picture(picture, tracked, recording=recording, force=True)
figure, axes = plt.subplots(figsize=(13, 4.6), dpi=68, layout="constrained")
axes.imshow(plt.imread(picture))
axes.set_axis_off()
plt.show()

# %% [markdown]
# *What to see: five of the cameras half-way through the recording; each box is the tracked position with the learned
# size, projected into the camera, and sits on its drone. A colour is one drone in all pictures. Lines are the paths of
# the last two seconds. The map from above shows all cameras, and the drones with their heights.*
#
# The flight in 3D turns with the mouse and plays:

# %%
pt.view_3d(tracked, recording)

# %% [markdown]
# *What to see: the drones with their paths of the last two seconds, the whole paths (faint), the true paths (dashed), and
# the cameras. The slider is time. The view is in the saved notebook, too; it needs neither the recording nor a network.*
#
# ## How good is it?

# %%
evaluation = pt.evaluate(tracked.trajectories, recording.truth)
evaluation

# %%
errors = pt.errors_over_time(tracked.trajectories, recording.truth)
figure, axes = plt.subplots(figsize=(9, 3.4), layout="constrained")
for drone, rows in errors.groupby("drone"):
    axes.plot(rows["time_s"], 1e3 * rows["error_m"], label=drone)
axes.set(xlabel="time (s)", ylabel="error (mm)", ylim=(0, None))
axes.grid(alpha=0.3)
axes.legend(ncols=4, frameon=False)
plt.show()

# %% [markdown]
# *What to see: each drone's distance from the ground truth, frame by frame. Each curve keeps a constant height: the
# offset between the body's origin, which the ground truth describes, and the silhouette's middle, which cameras show.
# The offset is constant in each drone's body, and the setting `drones.body_offset_m` removes it; the column "centred" of
# the table is the error without it. Gaps would be frames in which a drone is missed.*
#
# ## Save the tracks
#
# `psotrack track SEQ --out tracks.parquet` writes the same file: one row per frame and drone.

# %%
tracks = DATA / "tracks.parquet"
pt.write_trajectories(tracks, tracked.trajectories, force=True)
frame = pd.read_parquet(tracks)
frame[["frame", "time_s", "drone", "x_m", "y_m", "z_m", "fitness", "num_cameras", "status"]].head(8).round(3)

# %%
figure, panels = plt.subplots(3, 1, figsize=(9, 4.6), sharex=True, layout="constrained")
for drone, rows in frame.groupby("drone"):
    for panel, axis in zip(panels, "xyz", strict=True):
        std_m = rows[f"cov_{axis}{axis}"] ** 0.5
        (line,) = panel.plot(rows["time_s"], rows[f"{axis}_m"], label=f"drone {drone}")
        panel.fill_between(
            rows["time_s"],
            rows[f"{axis}_m"] - 20 * std_m,
            rows[f"{axis}_m"] + 20 * std_m,
            color=line.get_color(),
            alpha=0.25,
            linewidth=0,
        )
for panel, axis in zip(panels, "xyz", strict=True):
    panel.set_ylabel(f"{axis} (m)")
    panel.grid(alpha=0.3)
panels[0].legend(ncols=4, frameon=False, loc="lower left", bbox_to_anchor=(0, 1))
panels[-1].set_xlabel("time (s)")
plt.show()

# %% [markdown]
# *What to see: the coordinates of each drone. The bands are the standard deviation that the
# tracker states, drawn twenty times as wide, because the true width would vanish in the line. The bands are wide in
# the first frames, because the velocities are not known yet. The numbers of the drones are the tracker's; the tracker
# does not know the names in the ground truth.*
#
# The same as a page, and as videos: `pt.report(tracked, "report.html", recording=recording)` and
# `pt.overlay(tracked, "videos", recording=recording)`. With videos of your own, `pt.run("my_lab", square_m=0.035)` does
# all of it, from the calibration to the page.
#
# Next: [how a score comes from a video](video_to_score.ipynb), [how the swarm moves](how_the_swarm_moves.ipynb),
# [your own cameras](your_own_cameras.ipynb), [error and time against the size of the swarm](table_5.ipynb).
