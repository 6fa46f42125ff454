"""Contribution of each part of the tracker: each part is left out in turn, on three flights of three sequences.

    python experiments/accuracy/ablation.py --data data

Simulates missing sequences, tracks all sequences, writes one row per run and a picture, and prints the means. The same
command continues an interrupted study.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import _runs
import pandas as pd

from psotrack.settings import TrackSettings
from psotrack.support import atomic_write

#: Name of a variant -> settings that leave a part out, or add a part that is off by default.
VARIANTS: dict[str, dict[str, Any]] = {
    "whole tracker, with smoothing": {"smooth": True},
    "whole tracker": {},
    "no paraboloid: the best position of the swarm": {"score.vertex": False},
    "one window": {"score.windows": (1.0,)},
    "no handling of occlusion": {"score.occlusion": False},
    "sizes are not learned after the first frames": {"drones.learn_sizes": False},
    "identity swaps are not resolved": {"identity.resolve_swaps": False},
    "measurement errors without correlation in time": {"motion.error_share": 0.0},
    "the paper's hard score": {"score.kind": "hard"},
}
WHOLE = "whole tracker"


def run(name: str, variant: str, seed: int, opened: tuple) -> dict[str, Any]:
    """Track one flight with one variant; returns the row of the result."""
    settings = TrackSettings(seed=seed).changed(_runs.EFFORT[name] | VARIANTS[variant])
    return {"sequence": name, "variant": variant, "seed": seed} | _runs.figures(*opened, settings)


def draw(table: pd.DataFrame, path: Path) -> None:
    """Draw the error of each variant on each sequence: a dot per seed, and a line at the error of the whole tracker."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(table["sequence"]))
    variants = [variant for variant in VARIANTS if variant in set(table["variant"])]
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, name in zip(figure.subplots(1, len(names), sharey=True, squeeze=False)[0], names, strict=True):
        part = table[table["sequence"] == name].set_index("variant")
        error_mm = 1e3 * part["offset_removed_mean_error_m"]
        for row, variant in enumerate(reversed(variants)):
            values = error_mm.loc[[variant]].to_numpy()
            axes.plot(values, [row] * len(values), "o", color="tab:blue", markersize=5, alpha=0.6)
            switches = part.loc[[variant], "id_switches"].sum()
            if switches:
                axes.annotate(
                    f"{switches:.0f} switches",
                    (values.max(), row),
                    xytext=(6, -3),
                    textcoords="offset points",
                )
        axes.axvline(error_mm.loc[[WHOLE]].mean(), color="tab:grey", linewidth=1)
        axes.set_xscale("log")
        axes.set_xlim(3, 40)
        axes.set_xticks([], minor=True)
        axes.set_xticks([3, 5, 10, 20, 40], ["3", "5", "10", "20", "40"])
        axes.set_title(name)
        axes.grid(visible=True, axis="x", which="both", alpha=0.3)
        axes.set_yticks(range(len(variants)), list(reversed(variants)))
    # One label for all panels: a label below each panel would touch its neighbours.
    figure.supxlabel("mean error, offset removed (mm)", fontsize="medium")
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=110)


def main() -> None:
    """Track all flights, write and draw the result, and print the means."""
    parser = _runs.parser(__doc__)
    parser.add_argument("--picture", type=Path, default=Path("experiments/pictures/ablation.png"))
    parser.add_argument("--sequence", choices=_runs.EFFORT, action="append", help="[default: all]")
    parser.add_argument("--variant", choices=VARIANTS, action="append", help="[default: all]")
    parser.add_argument("--seeds", type=int, default=3, help="seeds of flight and swarm: 0, 1, ...")
    options = parser.parse_args()

    started = _runs.start("ablation")
    # Seeds are the outer loop, so that an interrupted study has rows of every sequence and variant.
    rows = (
        (f"{name} {variant} {seed}", partial(run, name, variant, seed, opened))
        for seed in range(options.seeds)
        for name in options.sequence or _runs.EFFORT
        for opened in [_runs.open_sequence(name, options.data, seed)]
        for variant in options.variant or VARIANTS
    )
    table = _runs.save_rows(
        started,
        rows,
        options.data,
        options.out,
        draw=lambda table: draw(table, options.picture),
        files=[options.picture],
    )
    means = (
        table.drop(columns=["seed", "note"], errors="ignore")
        .groupby(["sequence", "variant"], sort=False)
        .mean()
    )
    print(means.to_string(float_format="{:.4f}".format))


if __name__ == "__main__":
    main()
