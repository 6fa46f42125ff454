"""Plots of an estimate and its reference: paths in 3D, and the error over time.

Functions `draw_*` draw into given axes, so that other figures can use them; `save_overview` writes a PNG. Matplotlib
is imported only for drawing; `pyplot` is never imported, because it has global state.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from psotrack.evaluation.tables import drone_label
from psotrack.support import drone_colour, save_figure
from psotrack.trajectories import Trajectories
from psotrack.trajectories.association import (
    GATE_M,
    UNASSIGNED,
    AlignedPair,
    align,
    fixed_identity,
    fixed_partner_values,
    identity_switches,
    partners_per_frame,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

_DARK = "#2b313a"
_GREY = "#9aa3ad"
_SHADOW = "#dde1e6"
_DASHES = (0, (4, 2.5))
#: Height of the first bar of missed frames, and distance between bars, as shares of the axes' height.
_BARS_TOP = 0.975
_BARS_STEP = 0.025


def save_overview(
    path: Path | str, traj_est: Trajectories, traj_ref: Trajectories, *, force: bool = False
) -> None:
    """Save a PNG of the paths in 3D and the error over time.

    Raises:
        InputError: the estimate and the reference do not fit together.
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """

    def draw(figure: Figure) -> None:
        grid = figure.add_gridspec(2, 1, height_ratios=(1.6, 1.0))
        draw_trajectories(figure.add_subplot(grid[0], projection="3d"), traj_est, traj_ref)
        draw_errors(figure.add_subplot(grid[1]), traj_est, traj_ref)

    save_figure(Path(path), (8.0, 8.5), draw, force)


def draw_trajectories(axes: Axes3D, traj_est: Trajectories, traj_ref: Trajectories) -> None:
    """Draw the reference paths thin and dashed, the tracks solid, and the reference's shadows on the floor.

    A track has the colour of the drone that it follows (`association.fixed_identity`); false tracks are grey. A dot
    marks the first position of a reference path. All axes have the same scale, in metres.
    """
    pair = align(traj_est, traj_ref)
    partner = fixed_identity(pair)
    floor_m = min(0.0, float(np.nanmin(pair.ref_m[..., 2])))
    false_tracks = np.setdiff1d(np.arange(len(pair.drones_est)), partner)
    for estimate in false_tracks:
        axes.plot(*_with_gaps(pair, pair.est_m[:, estimate]), color=_GREY, linewidth=1.0)
    for drone, label in enumerate(_labels(pair, partner)):
        colour, truth_m = drone_colour(drone), _with_gaps(pair, pair.ref_m[:, drone])
        axes.plot(truth_m[0], truth_m[1], floor_m, color=colour, alpha=0.18, linewidth=1.2, zorder=1)
        if partner[drone] != UNASSIGNED:
            axes.plot(*_with_gaps(pair, pair.est_m[:, partner[drone]]), color=colour, linewidth=1.8)
        axes.plot(*truth_m, color=_DARK, linewidth=0.8, linestyle=_DASHES, zorder=4)
        start_m = truth_m[:, np.isfinite(truth_m).all(axis=0)][:, :1]
        axes.plot(*start_m, color=colour, marker="o", markersize=5, linewidth=1.8, label=label, zorder=5)
    axes.plot([], [], [], color=_DARK, linewidth=0.8, linestyle=_DASHES, label="truth")
    if len(false_tracks):
        axes.plot([], [], [], color=_GREY, linewidth=1.0, label="false track")
    _finish_3d(axes, floor_m)


def draw_errors(axes: Axes, traj_est: Trajectories, traj_ref: Trajectories) -> None:
    """Draw each drone's error over time, with gaps where it is missed.

    Bars at the top mark the frames in which a drone is missed, dotted lines the identity switches. The scale is
    logarithmic if an error exceeds the gate of 0.5 m, so that small errors stay readable.
    """
    pair = align(traj_est, traj_ref)
    partner = fixed_identity(pair)
    error_m = np.linalg.norm(fixed_partner_values(pair.est_m, partner) - pair.ref_m, axis=-1)
    missed = pair.truth_known & np.isnan(error_m)
    switches = identity_switches(partners_per_frame(pair.distance_m, keep=True))
    time_s = _with_gaps(pair, pair.time_s)
    for drone, label in enumerate(_labels(pair, partner)):
        colour = drone_colour(drone)
        axes.plot(time_s, 1e3 * _with_gaps(pair, error_m[:, drone]), color=colour, linewidth=1.1, label=label)
        bar = np.where(missed[:, drone], _BARS_TOP - _BARS_STEP * drone, np.nan)
        axes.plot(
            time_s, _with_gaps(pair, bar), color=colour, linewidth=3, transform=axes.get_xaxis_transform()
        )
    if missed.any():
        axes.plot([], [], color=_GREY, linewidth=3, label="missed")
    for number, switch_s in enumerate(pair.time_s[switches.any(axis=1)]):
        first = "identity switch" if number == 0 else None
        axes.axvline(switch_s, color=_DARK, linewidth=1.1, linestyle=":", label=first)
    _finish_errors(axes, error_m[np.isfinite(error_m)], num_bars=len(pair.drones) if missed.any() else 0)


def colours_of_estimates(traj_est: Trajectories, traj_ref: Trajectories) -> list[str]:
    """One colour per track: the colour of the drone that the track follows; grey for a false track."""
    pair = align(traj_est, traj_ref)
    colours = [_GREY] * len(pair.drones_est)
    for drone, estimate in enumerate(fixed_identity(pair)):
        if estimate != UNASSIGNED:
            colours[estimate] = drone_colour(drone)
    return colours


def _labels(pair: AlignedPair, partner: Int[np.ndarray, "drones"]) -> list[str]:
    tracks = [None if track == UNASSIGNED else pair.drones_est[track] for track in partner]
    return [drone_label(drone, track) for drone, track in zip(pair.drones, tracks, strict=True)]


def _with_gaps(
    pair: AlignedPair, values: Float[np.ndarray, "frames *rest"]
) -> Float[np.ndarray, "*rest_then_frames"]:
    """`values` with the frames on the last axis, and NaN where frames are skipped, so that lines have gaps there."""
    step = np.diff(pair.frame)
    after = np.flatnonzero(step > min(step, default=1)) + 1
    return np.insert(values.astype(float), after, np.nan, axis=0).T


def _finish_3d(axes: Axes3D, floor_m: float) -> None:
    from matplotlib.ticker import MaxNLocator, MultipleLocator

    axes.set_zlim(floor_m, axes.get_zlim()[1])
    extent_m = [high - low for low, high in (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())]
    axes.set_box_aspect(extent_m, zoom=1.1)
    for line in axes.lines:
        # At this zoom, the box reaches beyond the edges of the axes.
        line.set(clip_on=False, in_layout=False)
    # The same distance between ticks on all axes shows that the scales are equal.
    step_m = np.diff(MaxNLocator(6).tick_values(0.0, max(extent_m)))[0]
    axes.view_init(elev=24, azim=-58)
    for axis, name in ((axes.xaxis, "x"), (axes.yaxis, "y"), (axes.zaxis, "z")):
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.line.set_color(_GREY)
        axis.set_label_text(f"{name} (m)", color=_DARK)
        axis.set_tick_params(colors=_DARK, labelsize=8)
        axis.set_major_locator(MultipleLocator(step_m))
        axis._axinfo["grid"].update(color=_SHADOW, linewidth=0.6)
    _legend(axes)


def _finish_errors(axes: Axes, error_m: Float[np.ndarray, "seen"], num_bars: int) -> None:
    from matplotlib.ticker import StrMethodFormatter

    largest_mm = 1e3 * float(error_m.max(initial=1e-3))
    headroom = 1.0 + _BARS_STEP * (num_bars + 3)
    if largest_mm > 1e3 * GATE_M:
        smallest_mm = max(1.0, 1e3 * float(np.percentile(error_m, 1)))
        axes.set_yscale("log")
        axes.set_ylim(smallest_mm, smallest_mm * (largest_mm / smallest_mm) ** headroom)
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    else:
        axes.set_ylim(0.0, largest_mm * headroom)
    axes.set_xlabel("time (s)", color=_DARK)
    axes.set_ylabel("error (mm)", color=_DARK)
    axes.margins(x=0.01)
    axes.grid(color=_SHADOW, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors=_DARK, labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_GREY)
    _legend(axes)


def _legend(axes: Axes) -> None:
    """Add a legend above the axes, because beside the axes it would make the plot narrower."""
    axes.legend(
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=4,
        frameon=False,
        fontsize=8.5,
        labelcolor=_DARK,
        handlelength=1.6,
        columnspacing=1.4,
    )
