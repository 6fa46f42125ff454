"""Plots of paths and their reference (the paper's figure 11), with distances and angles over time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from psotrack.evaluation.path_comparison import PathComparison
from psotrack.support import COLOURS, LINE, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Colours of the paper's figure: the reference is blue, the first path over it red.
REFERENCE, PATHS = "#1f5fbf", ("#d62728", *COLOURS[1:])
_AXES = "xyz"
#: Margin around the reference, as a fraction of its largest extent. Positions beyond the margin are counted, not drawn.
_MARGIN = 0.15


def save_paths(
    png: Path | str, comparisons: Mapping[str, PathComparison], *, title: str = "", force: bool = False
) -> None:
    """Save a PNG of paths and their reference from above and from the side, and of distance and angle over time.

    Both views have one scale, in metres. The side view shows the horizontal axis of the larger extent, and height.

    Args:
        png: path of the PNG file.
        comparisons: comparisons of paths with the same reference, by the names of the paths.
        title: title of the picture.
        force: replace an existing file.

    Raises:
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    reference_m = next(iter(comparisons.values())).reference_m
    low_m, high_m = (find(reference_m, axis=0) for find in (np.nanmin, np.nanmax))
    margin_m = _MARGIN * float((high_m - low_m).max())
    low_m, high_m = low_m - margin_m, high_m + margin_m
    along = int(np.argmax((high_m - low_m)[:2]))
    views = ((along, 1 - along, "from above"), (along, 2, "from the side"))
    over_time = {"distance (mm)": {name: 1e3 * one.distance_m for name, one in comparisons.items()}}
    angles = {name: one.turning.angle_deg for name, one in comparisons.items() if one.turning}
    over_time |= {"angle (degrees)": angles} if angles else {}
    heights = 7.0 * (high_m - low_m)[[1 - along, 2]] / (high_m - low_m)[along]

    def draw(figure: Figure) -> None:
        panels = figure.subplots(2 + len(over_time), 1, height_ratios=[*heights, *[2.0] * len(over_time)])
        beyond = 0
        for axes, (across, up, name) in zip(panels, views, strict=False):
            axes.plot(reference_m[:, across], reference_m[:, up], REFERENCE, linewidth=2.4, label="reference")
            for (label, one), colour in zip(comparisons.items(), PATHS, strict=False):
                drawn = ((one.position_m >= low_m) & (one.position_m <= high_m)).all(axis=-1)
                beyond += int((np.isfinite(one.position_m).all(axis=-1) & ~drawn).sum())
                shown_m = np.where(drawn[:, None], one.position_m, np.nan)
                axes.plot(shown_m[:, across], shown_m[:, up], colour, linewidth=1.0, label=label)
            axes.set(xlim=(low_m[across], high_m[across]), ylim=(low_m[up], high_m[up]), aspect="equal")
            _finish(axes, name, f"{_AXES[across]} (m)", f"{_AXES[up]} (m)")
        for axes, (label, values) in zip(panels[2:], over_time.items(), strict=True):
            for (name, value), colour in zip(values.items(), PATHS, strict=False):
                axes.plot(comparisons[name].time_s, value, colour, linewidth=1.0)
            _scale(axes, np.concatenate(list(values.values())))
            _finish(axes, "", "time (s)", label)
        panels[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=5, frameon=False, fontsize=8.5)
        parts = [title] * bool(title) + [f"{beyond // 2} positions lie beyond these views"] * (beyond > 0)
        figure.suptitle("; ".join(parts), fontsize=9)

    save_figure(Path(png), (8.0, float(heights.sum()) + 2.4 * len(over_time) + 1.0), draw, force)


def _scale(axes: Axes, values: Float[np.ndarray, "values"]) -> None:
    """Start the vertical axis at zero; make it logarithmic where the largest value is far above the median."""
    known = values[np.isfinite(values) & (values > 0)]
    if len(known) and known.max() > 30 * np.median(known):
        axes.set_yscale("log")
        axes.set_ylim(bottom=float(np.percentile(known, 1)))
    else:
        axes.set_ylim(bottom=0)


def _finish(axes: Axes, name: str, across: str, up: str) -> None:
    axes.set_title(name, fontsize=9, loc="left")
    axes.set_xlabel(across)
    axes.set_ylabel(up)
    axes.grid(color=LINE, linewidth=0.6)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
