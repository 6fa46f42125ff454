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

import matplotlib.pyplot as plt
import pandas as pd

from psotrack.evaluation import evaluate, plots, tables
from psotrack.foreground.silhouettes import SilhouetteSettings
from psotrack.pipeline import track_recording
from psotrack.recordings import read_frames
from psotrack.recordings.datasets import read_sequence
from psotrack.settings import TrackSettings
from psotrack.show.flights import flight_of
from psotrack.show.overlay import save_picture
from psotrack.show.reports import view_3d
from psotrack.simulation import SimulationSettings, simulate
from psotrack.support import keep_compiled
from psotrack.trajectories import write_trajectories

# %% [markdown]
# All sizes are set here. Images have half of their full size to save time; use `SCALE = 1.0` and
# `SilhouetteSettings()` for the full size.

# %%
TINY = os.environ.get("PSOTRACK_NOTEBOOKS") == "tiny"  # a quick check that everything runs
NUM_FRAMES = 20 if TINY else 75
SCALE = 0.25 if TINY else 0.5
SILHOUETTES = SilhouetteSettings(reduction=2, working_reduction=1)
if TINY:  # so few pixels per drone that noise counts
    SILHOUETTES = SilhouetteSettings(reduction=1, working_reduction=1, min_blob_px=32)
DATA = Path("data", "tiny" if TINY else "normal")
plt.rcParams.update({"figure.dpi": 80, "font.size": 9})
keep_compiled(Path("data", "compiled"))  # the second run does not wait for the compiler

# %% [markdown]
# ## A recording
#
# `simulate` writes the same folder that a real recording has: one video per camera and the cameras' calibration. A
# simulation also has the ground truth.

# %%
folder = DATA / "Simulated_Data" / "S02_D4_A"
if not folder.exists():
    simulation = SimulationSettings(num_frames=NUM_FRAMES, scale=SCALE, masks=False, onboard=False)
    simulate("S02_D4_A", DATA, simulation)
recording = read_sequence(folder).usable()

print(f"{recording.num_frames} frames at {recording.fps:g} per second")
for name, video, centre_m in zip(
    recording.rig.names, recording.videos.values(), recording.rig.cameras.centre_world, strict=True
):
    width, height = video.image_size_wh
    x, y, z = centre_m
    print(f"{name}: {width} x {height} pixels, hangs at x = {x:5.2f}, y = {y:5.2f}, z = {z:4.2f} m")

# %%
name = recording.rig.names[0]
first_frame = next(read_frames(recording.videos[name]))
figure, axes = plt.subplots(figsize=(9, 5.2), dpi=56, layout="constrained")
axes.imshow(first_frame[:, :, ::-1])  # OpenCV has blue first
axes.set(xlabel="x (pixels)", ylabel="y (pixels)", title=f"camera {name}, frame 0")
plt.show()

# %% [markdown]
# *What to see: four small drones: two left of the middle, two in front of the far corner. The tracker uses only their
# silhouettes: no markers, no colours, no model of a drone's appearance.*

# %% [markdown]
# ## Track
#
# One call makes silhouettes from the videos (in several processes; they are kept in `cache`), finds the drones when they
# come, and follows them. The call does not say how many drones there are, where they start or how large they are.

# %%
tracked = track_recording(
    recording, TrackSettings(seed=1, silhouettes=SILHOUETTES), cache=DATA / "silhouettes"
)
tracked.trajectories.position_m.shape  # frames, drones, x y z in metres

# %%
pd.Series(tracked.record["seconds"], name="seconds").to_frame().T.round(1)

# %% [markdown]
# Seconds per stage: `decode` and `foreground` are summed over processes, and 0 when the silhouettes were in the cache;
# `compile` is short when the compiled program was on disk; `track` is the time of all frames.
#
# ## See it

# %%
picture = DATA / "quickstart.png"
save_picture(picture, flight_of(tracked, recording))
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
view_3d(tracked, recording)

# %% [markdown]
# *What to see: the drones with their paths of the last two seconds, the whole paths (faint), the true paths (dashed), and
# the cameras. The slider is time. The view is in the saved notebook, too; it needs neither the recording nor a network.*
#
# ## How good is it?

# %%
evaluation = evaluate(tracked.trajectories, recording.truth)
print(f"mean error {1e3 * evaluation.mean_error_m:.0f} mm")
print(
    f"mean error without each drone's constant offset {1e3 * evaluation.offset_removed_mean_error_m:.1f} mm"
)
print(f"identity switches {evaluation.id_switches}, missed {evaluation.missed_rate:.1%}")

columns = ["drone", "mean_error_m", "p95_error_m", "offset_removed_mean_error_m", "missed_rate"]
tables.to_frame(evaluation)[columns].round(4)

# %%
figure, axes = plt.subplots(figsize=(9, 3.4), layout="constrained")
plots.draw_errors(axes, tracked.trajectories, recording.truth)
plt.show()

# %% [markdown]
# *What to see: each drone's distance from the ground truth, frame by frame. Each curve keeps a constant height: the
# offset between the body's origin, which the ground truth describes, and the silhouette's middle, which cameras show.
# The offset is constant in each drone's body, and `--body-offset` removes it. The third column of the table is the
# error without the offset. Gaps and bars at the top would be frames in which a drone is missed; dotted lines would be
# identity swaps.*
#
# ## Save the tracks
#
# `psotrack track SEQ --out tracks.parquet` writes the same file: one row per frame and drone.

# %%
tracks = DATA / "tracks.parquet"
write_trajectories(tracks, tracked.trajectories, force=True)
frame = pd.read_parquet(tracks)
frame[["frame", "time_s", "drone", "x_m", "y_m", "z_m", "fitness", "num_cameras", "status"]].head(8).round(3)

# %%
figure, panels = plt.subplots(3, 1, figsize=(9, 4.6), sharex=True, layout="constrained")
colours = plots.colours_of_estimates(tracked.trajectories, recording.truth)
for colour, (drone, rows) in zip(colours, frame.groupby("drone"), strict=True):
    for panel, axis in zip(panels, "xyz", strict=True):
        std_m = rows[f"cov_{axis}{axis}"] ** 0.5
        panel.plot(rows["time_s"], rows[f"{axis}_m"], color=colour, label=f"drone {drone}")
        panel.fill_between(
            rows["time_s"],
            rows[f"{axis}_m"] - 20 * std_m,
            rows[f"{axis}_m"] + 20 * std_m,
            color=colour,
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
# *What to see: the coordinates of each drone, in colours as above. The bands are the standard deviation that the
# tracker states, drawn twenty times as wide, because the true width would vanish in the line. The bands are wide in
# the first frames, because the velocities are not known yet. The numbers of the drones are the tracker's; the tracker
# does not know the names in the ground truth.*
#
# Next: [how a score comes from a video](video_to_score.ipynb), [how the swarm moves](how_the_swarm_moves.ipynb),
# [your own cameras](your_own_cameras.ipynb), [error and time against the size of the swarm](table_5.ipynb).
