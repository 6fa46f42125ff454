"""Plots of a camera's path: in its room, with its reference (the paper's figure 11), and errors over time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from psotrack.inside_out.camera_path import CameraPath
from psotrack.inside_out.comparison.comparing import PathComparison
from psotrack.inside_out.marker_map import MarkerMap
from psotrack.support import COLOURS, save_figure
from psotrack.trajectories import Status

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Colours of the paper's figure: the reconstructed path is red, the reference blue.
RECONSTRUCTED, REFERENCE = "#d62728", "#1f5fbf"
_GRID = "#dde1e6"
_MARKERS = "#4d4d4d"
#: Colours of poses from the frame's own markers, and of poses from the motion.
_TRACKED, _BRIDGED = COLOURS[0], COLOURS[1]
_AXES = "xyz"
#: Margin around the reference, as a share of its largest extent. Positions beyond the margin are counted, not drawn.
_MARGIN = 0.15


def save_paths(
    png: Path | str, path: CameraPath, comparison: PathComparison, *, caption: str = "", force: bool = False
) -> None:
    """Save a PNG of the path and its reference from above and from the side: the paper's figure 11.

    Both views have the same scale, in metres. The side view shows the horizontal axis of the larger extent, and height.

    Raises:
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    png = Path(png)
    position_m = np.where(path.seen[:, None], path.position_m, np.nan)
    low_m, high_m = (find(comparison.reference_m, axis=0) for find in (np.nanmin, np.nanmax))
    margin_m = _MARGIN * float((high_m - low_m).max())
    low_m, high_m = low_m - margin_m, high_m + margin_m
    along = int(np.argmax((high_m - low_m)[:2]))
    drawn = ((position_m >= low_m) & (position_m <= high_m)).all(axis=-1)
    beyond = int((path.seen & ~drawn).sum())
    position_m = np.where(drawn[:, None], position_m, np.nan)

    def draw(figure: Figure) -> None:
        extent_m = high_m - low_m
        views = ((along, 1 - along, "from above"), (along, 2, "from the side"))
        panels = figure.subplots(2, 1, height_ratios=[extent_m[up] for _, up, _ in views])
        for axes, (across, up, name) in zip(panels, views, strict=True):
            for points_m, colour, width, label in (
                (comparison.reference_m, REFERENCE, 2.4, "reference"),
                (position_m, RECONSTRUCTED, 1.0, "reconstructed"),
            ):
                axes.plot(points_m[:, across], points_m[:, up], color=colour, linewidth=width, label=label)
            axes.set(xlim=(low_m[across], high_m[across]), ylim=(low_m[up], high_m[up]), aspect="equal")
            axes.set_title(name, fontsize=9, loc="left")
            _finish(axes, f"{_AXES[across]} (m)", f"{_AXES[up]} (m)")
        panels[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False, fontsize=8.5)
        parts = [caption] * bool(caption) + [f"{beyond} positions lie beyond these views"] * (beyond > 0)
        if parts:
            figure.supxlabel("; ".join(parts), fontsize=9)

    save_figure(png, (7.0, 8.0), draw, force)


def save_flight(
    png: Path | str, path: CameraPath, marker_map: MarkerMap, *, caption: str = "", force: bool = False
) -> None:
    """Save a PNG of a path from above, with the markers of the room, and of its height over time.

    Frames with poses from the motion have a colour of their own. Where there is no pose, the line is interrupted, and
    the background of the height is grey.

    Raises:
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    png = Path(png)
    bridged = path.seen & (path.status == Status.COASTING)
    # Lines are drawn between frames, so that a bridged frame needs its neighbours.
    beside = path.seen & np.convolve(bridged, np.ones(3), mode="same").astype(bool)

    def draw(figure: Figure) -> None:
        above, over_time = figure.subplots(2, 1, height_ratios=[2.4, 1.0])
        for corners_m in marker_map.all_corners_m[:, [0, 1, 2, 3, 0], :2]:
            above.plot(*corners_m.T, color=_MARKERS, linewidth=2.5, solid_capstyle="butt")
        above.plot([], [], color=_MARKERS, linewidth=2.5, label="markers")
        for shown, colour, label in ((path.seen, _TRACKED, "tracked"), (beside, _BRIDGED, "bridged")):
            x_m, y_m, z_m = np.where(shown[:, None], path.position_m, np.nan).T
            for axes, across, up in ((above, x_m, y_m), (over_time, path.time_s, z_m)):
                axes.plot(across, up, color=colour, linewidth=1.4, label=label if shown.any() else None)
        for first, end in _runs(~path.seen):
            ends_s = path.time_s[max(first - 1, 0)], path.time_s[min(end, path.num_frames - 1)]
            over_time.axvspan(*ends_s, color=_GRID, linewidth=0)
        if path.seen.any():
            start = int(path.seen.argmax())
            above.plot(*path.position_m[start, :2], "o", color=_TRACKED, markersize=5, label="start")
            over_time.plot(path.time_s[start], path.position_m[start, 2], "o", color=_TRACKED, markersize=5)
        if not path.seen.all():
            above.plot([], [], color=_GRID, linewidth=6, label="no pose")
        above.set(aspect="equal")
        above.set_title("from above", fontsize=9, loc="left")
        _finish(above, "x (m)", "y (m)")
        _finish(over_time, "time (s)", "z (m)")
        above.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=5, frameon=False, fontsize=8.5)
        if caption:
            figure.supxlabel(caption, fontsize=9)

    save_figure(png, (7.0, 8.0), draw, force)


def _runs(marked: Bool[np.ndarray, "frames"]) -> list[tuple[int, int]]:
    """First frame and end (exclusive) of each run of marked frames."""
    steps = np.diff(np.concatenate([[False], marked, [False]]).astype(int))
    return list(zip(np.flatnonzero(steps > 0).tolist(), np.flatnonzero(steps < 0).tolist(), strict=True))


def save_path_errors(
    png: Path | str, comparisons: Mapping[str, PathComparison], *, force: bool = False
) -> None:
    """Save a PNG of the distance, and of the angle if there are orientations, over time, with a line per comparison.

    Raises:
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    png = Path(png)
    quantities = [("distance (mm)", {name: 1e3 * one.distance_m for name, one in comparisons.items()})]
    turned = {name: one.turning.angle_deg for name, one in comparisons.items() if one.turning}
    if turned:
        quantities.append(("angle (degrees)", turned))

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(quantities), 1, sharex=True, squeeze=False)[:, 0]
        for axes, (label, values) in zip(panels, quantities, strict=True):
            for number, (name, value) in enumerate(values.items()):
                colour = COLOURS[number % len(COLOURS)]
                axes.plot(comparisons[name].time_s, value, color=colour, linewidth=1.0, label=name)
            _scale(axes, np.concatenate(list(values.values())))
            _finish(axes, "", label)
        panels[-1].set_xlabel("time (s)")
        panels[0].legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, frameon=False, fontsize=8.5)

    save_figure(png, (9.0, 2.6 * len(quantities) + 0.6), draw, force)


def _scale(axes: Axes, values: Float[np.ndarray, "values"]) -> None:
    """Start the vertical axis at zero; make it logarithmic where the largest value is far above the median."""
    from matplotlib.ticker import StrMethodFormatter

    known = values[np.isfinite(values) & (values > 0)]
    if len(known) and known.max() > 30 * np.median(known):
        axes.set_yscale("log")
        axes.set_ylim(bottom=float(np.percentile(known, 1)))
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    else:
        axes.set_ylim(bottom=0)


def _finish(axes: Axes, across: str, up: str) -> None:
    axes.set_xlabel(across)
    axes.set_ylabel(up)
    axes.grid(color=_GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
