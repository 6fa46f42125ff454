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
# # Table 5: error and time against the size of the swarm
#
# The paper's Table 5 tracks three sequences with 20, 50 and 100 particles and 20, 50 and 70 iterations, several times
# each, because a swarm is random. `make table5` does the same with the paper's method (one swarm for all drones, one
# hard box as score) and with psotrack's defaults, ten runs each. This notebook reads the results in
# `experiments/history`, of November 2026; it tracks nothing itself.

# %%
import tomllib
from pathlib import Path

import matplotlib.pyplot as plt
import pandas as pd
from IPython.display import Image, Markdown

from psotrack.support import COLOURS
from psotrack.sweeps import pivot, render_table

# %%
TABLE_5 = Path("../experiments/table5")
RESULTS = Path("../experiments/history")
DPI = 80
# %matplotlib inline
plt.rcParams.update({"figure.dpi": DPI, "font.size": 9})

# %%
rows = pd.read_csv(RESULTS / "table5.csv")  # a row per run
published_m = tomllib.loads((TABLE_5 / "published.toml").read_text())  # lowest and highest mean error, metres
columns = [
    "sequence",
    "method",
    "settings.swarm.particles",
    "settings.swarm.iterations",
    "seed",
    "mean_error_m",
    "id_switches",
]
rows[columns].sample(5, random_state=0).sort_index()

# %% [markdown]
# ## The table

# %%
table = pivot(
    rows,
    rows_by=["sequence", "particles", "iterations"],
    columns_by=["method"],
    value="mean_error_m",
    scale=1000,
)
Markdown(render_table(table, "markdown", decimals=1))

# %% [markdown]
# Millimetres, mean ± standard deviation over the runs; measured from the drones' origins, so each drone's constant
# offset between origin and silhouette's middle, which no image shows, is included. The same without the offset:

# %%
table = pivot(
    rows,
    rows_by=["sequence", "particles", "iterations"],
    columns_by=["method"],
    value="offset_removed_mean_error_m",
    scale=1000,
)
Markdown(render_table(table, "markdown", decimals=1))

# %% [markdown]
# The paper's own errors, on its own videos. Videos, silhouettes, sizes, initial states and motion model differ from
# ours: compare the two methods above with each other, not with these figures.

# %%
pd.DataFrame(published_m, index=["lowest mean error (mm)", "highest mean error (mm)"]).T * 1000

# %% [markdown]
# ## The Pareto front

# %%
Image(RESULTS / "error_against_work.png", width=900)

# %% [markdown]
# *What to see: a point is one number of particles and iterations with one method; to the right is more time per frame,
# up is a larger mean error, both on logarithmic scales; bars are the standard deviation over the runs. The dark line
# is the Pareto front: no other point is both faster and more accurate than a point on it. Where the front is flat,
# more work does not lower the error. The band is the range that the paper published.*

# %% [markdown]
# ## Run by run

# %%
sequences, methods = (list(dict.fromkeys(rows[name])) for name in ("sequence", "method"))
sizes = rows[["settings.swarm.particles", "settings.swarm.iterations"]].drop_duplicates()
sizes = sizes.iloc[sizes.prod(axis=1).argsort(kind="stable")]
place = {size: number for number, size in enumerate(sizes.itertuples(index=False, name=None))}
where = pd.Series(
    [
        place[size]
        for size in zip(rows["settings.swarm.particles"], rows["settings.swarm.iterations"], strict=True)
    ]
)
error_mm, switched = 1e3 * rows["offset_removed_mean_error_m"], rows["id_switches"] > 0

figure, panels = plt.subplots(
    1, len(sequences), figsize=(13, 3.8), sharey=True, layout="constrained", squeeze=False
)
for panel, sequence in zip(panels[0], sequences, strict=True):
    for number, method in enumerate(methods):
        runs = (rows["sequence"] == sequence) & (rows["method"] == method)
        shift = 0.3 * (number - (len(methods) - 1) / 2)
        panel.plot(
            where[runs] + shift,
            error_mm[runs],
            "o",
            color=COLOURS[number],
            markersize=3.5,
            alpha=0.6,
            label=method,
        )
    runs = (rows["sequence"] == sequence) & switched
    shift = 0.3 * (rows["method"].map(methods.index) - (len(methods) - 1) / 2)
    panel.plot(
        (where + shift)[runs],
        error_mm[runs],
        "o",
        color="none",
        markeredgecolor="#2b313a",
        markersize=7,
        label="with identity switches",
    )
    panel.set_xticks(list(place.values()), [f"{particles} x {iterations}" for particles, iterations in place])
    panel.tick_params(axis="x", labelrotation=45)
    panel.set(title=sequence, xlabel="particles x iterations", yscale="log")
    panel.grid(alpha=0.3, which="both")
panels[0, 0].set_ylabel("mean error of a run,\noffset removed (mm)")
panels[0, 0].legend(frameon=False)
plt.show()

# %% [markdown]
# *What to see: every single run. A short column is a method whose runs agree; a long column is a method whose
# result depends on the seed. Rings are runs with identity swaps: their errors are far above the errors of other runs, and a
# mean over runs mixes both kinds.*
#
# ## Origin of the results

# %%
rows["commit"].unique()
