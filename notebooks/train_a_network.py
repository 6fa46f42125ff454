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
# # Train a network
#
# A small convolutional network learns from simulated flights, whose masks are known, which pixels show drones. This
# notebook trains one for two minutes, looks at what it learns from and at what it finds, and tracks with it. The network
# that comes with the package (`--background network`) learned for an hour, from more rooms and drones.

# %%
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import psotrack as pt
from psotrack.foreground.learning import TrainSettings, train_on_sequences
from psotrack.foreground.learning.samples import Samples, batches
from psotrack.foreground.network import findings
from psotrack.support import keep_compiled

# %%
TINY = os.environ.get("PSOTRACK_NOTEBOOKS") == "tiny"  # a quick check that everything runs
NUM_FRAMES = 20 if TINY else 75
SCALE = 0.25
TRAINING = TrainSettings(
    epochs=2 if TINY else 10,
    steps=3 if TINY else 100,
    batch=4 if TINY else 8,
    part_px=64 if TINY else 128,
    per_camera=5 if TINY else 20,
    learning_rate=4e-3,
)
SILHOUETTES = {"silhouettes.reduction": 1, "silhouettes.working_reduction": 1}
DATA = Path("data", "train_tiny" if TINY else "train")
plt.rcParams.update({"figure.dpi": 80, "font.size": 9})
keep_compiled(Path("data", "compiled"))

# %% [markdown]
# ## What the network learns from
#
# Two sequences for training, and one for validation. A sample is a frame, the background that was learned from the
# video, and the drones' masks. Each time, a part of a frame is changed at random: another scene, more drones, other paint,
# objects that are no drones, light, blur, noise, compression. Drones have a red box; the last picture of each row is the
# mask.

# %%
NAMES = ("S01_D2_A", "S04_D10", "S02_D4_A")
folders = [DATA / "Simulated_Data" / name for name in NAMES]
for folder in folders:
    if not folder.exists():
        pt.simulate(
            folder.name, DATA, pt.SimulationSettings(num_frames=NUM_FRAMES, scale=SCALE, onboard=False)
        )
model_path = DATA / "tiny.model"
model = train_on_sequences(folders, model_path, TRAINING, cache=DATA / "cache", say=print)

# %%
stored = [
    each for folder in sorted((DATA / "cache" / "samples").iterdir()) for each in Samples.load_all(folder)
]
batch = next(batches(stored, TRAINING.part_px, 6, np.random.default_rng(1)))
figure, axes = plt.subplots(2, 9, figsize=(11, 2.6), layout="constrained")
for index, (shown, background, mask) in enumerate(zip(*[iter(axes.flat)] * 3, strict=True)):
    shown.imshow(batch.image[index][..., ::-1])
    background.imshow(batch.background[index][..., ::-1])
    mask.imshow(batch.covered[index], cmap="gray", vmin=0, vmax=255)
    for x0, y0, x1, y1 in batch.box_px[index]:
        shown.plot([x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0], color="red", linewidth=0.8)
for axis in axes.flat:
    axis.set_axis_off()

# %% [markdown]
# ## What the network finds
#
# After each epoch, `train` writes this picture of frames that are not in training: boxes above, each pixel's
# probability below.

# %%
figure = plt.figure(figsize=(11, 2.75), dpi=110)
figure.add_axes((0, 0, 1, 1), frameon=False, xticks=[], yticks=[]).imshow(
    plt.imread(model_path.with_suffix(".png"))
)

# %%
pd.DataFrame(model.card["epochs"]).round(3)

# %% [markdown]
# The probability does not depend on movement alone. Without the background, the network has only the picture:

# %%
sample = stored[-1]
frame = np.asarray(sample.image[len(sample) // 2])
figure, axes = plt.subplots(1, 3, figsize=(11, 2.4), layout="constrained")
axes[0].imshow(frame[..., ::-1])
for axis, background, title in (
    (axes[1], np.asarray(sample.background), "with the background"),
    (axes[2], None, "without"),
):
    axis.imshow(findings(model.network, frame, background)[0], cmap="gray", vmin=0, vmax=1)
    axis.set_title(title)
for axis in axes:
    axis.set_axis_off()

# %% [markdown]
# ## Use it
#
# `psotrack track SEQ --background tiny.model` and `psotrack detect SEQ --detector tiny.model` use the file. Beside the
# usual background model, on the sequence that was for validation:

# %%
recording = pt.read_recording(folders[-1])
rows = {}
for name in ("living", str(model_path)):
    settings = {**SILHOUETTES, "silhouettes.background": name}
    tracked = pt.track(recording, settings, cache=DATA / "silhouettes")
    rows[Path(name).name] = pt.evaluate(tracked.trajectories, recording.truth).to_dict()
pd.DataFrame(rows).T[["mean_error_m", "missed_rate", "id_switches"]].astype(float).round(4)
