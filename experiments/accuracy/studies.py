"""Accuracy with fewer cameras, poor calibration, unequal clocks, noise, and coarser silhouettes.

    python experiments/accuracy/studies.py --data data

Five grids (`studies/*.toml`) over three flights of S02_D4_A, joint swarm of 100 x 70, drones found automatically.
`psotrack sweep` can run each grid alone, and the same command continues an interrupted study. Simulates missing
sequences, writes one row per run and a picture, and prints means and worst values.
"""

from __future__ import annotations

from pathlib import Path

import _runs
import numpy as np
import pandas as pd

from psotrack.support import atomic_write, keep_compiled
from psotrack.sweeps import read_grid, sweep

GRIDS = Path(__file__).parent / "studies"
#: Study -> column that varies, and label of its axis.
STUDIES = {
    "cameras": ("num_cameras", "cameras, of 8"),
    "calibration": ("perturbation.extrinsics_deg", "cameras turned by (degrees)"),
    "clocks": ("perturbation.clock_frames", "cameras late by 0 to (frames)"),
    "noise": ("perturbation.flipped", "share of the pixels flipped"),
    "resolution": ("settings.silhouettes.reduction", "side of a silhouette's cell (px)"),
}
ERROR = "offset_removed_mean_error_m"
KEPT = ["study", "level", "flight", "draw", *_runs.KEPT]


def run_study(study: str, data: Path) -> pd.DataFrame:
    """Run a study; returns one row per run."""
    grid = read_grid(GRIDS / f"{study}.toml")
    for sequence in grid.sequences:
        seed = int(Path(sequence).parts[0].removeprefix("seed"))
        _runs.simulated(Path(sequence).name, data, seed)
    keep_compiled(_runs.cache_folder(data) / "compiled")
    rows = sweep(
        grid, data / "studies" / study, data=data, cache=_runs.cache_folder(data), progress=True
    ).rows()
    flight = {key: number for number, key in enumerate(dict.fromkeys(rows["input"]))}
    return rows.assign(
        study=study,
        level=rows[STUDIES[study][0]].astype(float),
        flight=rows["input"].map(flight),
        draw=rows["perturbation.draw"],
    )[KEPT]


def draw(table: pd.DataFrame, path: Path) -> None:
    """Draw a panel per study: a dot per run, and a line through the means."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (study, runs) in zip(
        figure.subplots(1, table["study"].nunique(), sharey=True, squeeze=False)[0],
        table.groupby("study", sort=False),
        strict=True,
    ):
        levels = np.unique(runs["level"])
        place = np.searchsorted(levels, runs["level"])
        axes.plot(place, 1e3 * runs[ERROR], "o", color="tab:blue", markersize=4, alpha=0.4)
        means = runs.groupby("level")[[ERROR, "missed_rate", "id_switches"]].mean()
        axes.plot(range(len(levels)), 1e3 * means[ERROR], color="tab:blue", linewidth=1)
        for index, (missed, switches) in enumerate(means[["missed_rate", "id_switches"]].to_numpy()):
            labels = [f"{missed:.1%} missed"] * int(missed > 0) + [f"{switches:.1f} switches"] * int(
                switches > 0
            )
            axes.annotate("\n".join(labels), (index, 3.2), fontsize=7, ha="center")
        axes.set_yscale("log")
        axes.set_ylim(3, 300)
        axes.set_yticks([], minor=True)
        axes.set_yticks([5, 10, 20, 50, 100, 200], ["5", "10", "20", "50", "100", "200"])
        axes.set_xticks(range(len(levels)), [f"{level:g}" for level in levels])
        axes.margins(x=0.12)
        axes.set_xlabel(STUDIES[study][1])
        axes.grid(visible=True, axis="y", alpha=0.3)
    figure.axes[0].set_ylabel("mean error, offset removed (mm)")
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)


def main() -> None:
    """Run the studies, write and draw the result, and print the means."""
    parser = _runs.parser(__doc__)
    parser.add_argument("--picture", type=Path, default=Path("experiments/pictures/studies.png"))
    parser.add_argument("--study", choices=STUDIES, action="append", help="[default: all]")
    options = parser.parse_args()
    run = _runs.start("studies")
    table = pd.concat(
        [run_study(study, options.data) for study in options.study or STUDIES], ignore_index=True
    )
    draw(table, options.picture)
    run.save(options.out, rows=table, files=[options.picture])
    grouped = table.drop(columns=["flight", "draw"]).groupby(["study", "level"], sort=False)
    print("runs", grouped.size().to_string(), sep="\n")
    print("mean", grouped.mean().to_string(float_format="{:.4f}".format), sep="\n")
    print("worst", grouped.max().to_string(float_format="{:.4f}".format), sep="\n")


if __name__ == "__main__":
    main()
