"""A picture of a camera's path in its room, and of its height over time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool

from psotrack.inside_out.camera_path import CameraPath
from psotrack.inside_out.marker_map import MarkerMap
from psotrack.support import COLOURS, save_figure
from psotrack.trajectories import Status

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_GRID = "#dde1e6"
_MARKERS = "#4d4d4d"
#: Colours of poses from the frame's own markers, and of poses from the motion.
_TRACKED, _BRIDGED = COLOURS[0], COLOURS[1]


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


def _finish(axes: Axes, across: str, up: str) -> None:
    axes.set_xlabel(across)
    axes.set_ylabel(up)
    axes.grid(color=_GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
