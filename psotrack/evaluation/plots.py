"""Pictures of an estimate beside its reference: paths in 3D, and the error over time.

The functions that draw take axes, so that other figures can use them; those that save make a PNG. Matplotlib
is imported when something is drawn, and `pyplot`, with its global state, not at all.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from psotrack.support import drone_colour, save_figure
from psotrack.trajectories import Trajectories
from psotrack.trajectories.association import (
    GATE_M,
    UNASSIGNED,
    AlignedPair,
    align,
    fixed_identity,
    identity_switches,
    matched_per_frame,
    of_partners,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

_DARK = "#2b313a"
_GREY = "#9aa3ad"
_SHADOW = "#dde1e6"
_DASHES = (0, (4, 2.5))
#: Where the bars of missed frames stand, in parts of the height of the axes.
_BARS_TOP = 0.975
_BARS_STEP = 0.025


def save_trajectories(
    path: Path, traj_est: Trajectories, traj_ref: Trajectories, *, force: bool = False
) -> None:
    """Save a PNG of the paths in 3D; see `draw_trajectories`.

    Raises:
        InputError: the estimate and the reference do not fit together.
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """

    def draw(figure: Figure) -> None:
        draw_trajectories(figure.add_subplot(projection="3d"), traj_est, traj_ref)

    save_figure(path, (7.5, 5.5), draw, force)


def save_errors(path: Path, traj_est: Trajectories, traj_ref: Trajectories, *, force: bool = False) -> None:
    """Save a PNG of the error over time; see `draw_errors`, and `save_trajectories` for what is raised."""

    def draw(figure: Figure) -> None:
        draw_errors(figure.add_subplot(), traj_est, traj_ref)

    save_figure(path, (9.0, 4.0), draw, force)


def save_overview(path: Path, traj_est: Trajectories, traj_ref: Trajectories, *, force: bool = False) -> None:
    """Save a PNG of the paths with the error over time below; see `save_trajectories` for what is raised."""

    def draw(figure: Figure) -> None:
        grid = figure.add_gridspec(2, 1, height_ratios=(1.6, 1.0))
        draw_trajectories(figure.add_subplot(grid[0], projection="3d"), traj_est, traj_ref)
        draw_errors(figure.add_subplot(grid[1]), traj_est, traj_ref)

    save_figure(path, (8.0, 8.5), draw, force)


def draw_trajectories(axes: Axes3D, traj_est: Trajectories, traj_ref: Trajectories) -> None:
    """Draw the true paths thin and dashed, the estimated ones solid, and the true ones' shadows on the floor.

    An estimate has the colour of the drone that it stands for (`association.fixed_identity`); false tracks
    are grey. A dot marks where a true path begins. All axes have one scale, in metres.
    """
    pair = align(traj_est, traj_ref)
    partner = fixed_identity(pair)
    floor_m = min(0.0, float(np.nanmin(pair.ref_m[..., 2])))
    surplus = np.setdiff1d(np.arange(len(pair.drones_est)), partner)
    for estimate in surplus:
        axes.plot(*_with_gaps(pair, pair.est_m[:, estimate]), color=_GREY, linewidth=1.0)
    for drone, name in enumerate(pair.drones):
        colour, truth_m = drone_colour(drone), _with_gaps(pair, pair.ref_m[:, drone])
        axes.plot(truth_m[0], truth_m[1], floor_m, color=colour, alpha=0.18, linewidth=1.2, zorder=1)
        if partner[drone] != UNASSIGNED:
            axes.plot(*_with_gaps(pair, pair.est_m[:, partner[drone]]), color=colour, linewidth=1.8)
        axes.plot(*truth_m, color=_DARK, linewidth=0.8, linestyle=_DASHES, zorder=4)
        start_m = truth_m[:, np.isfinite(truth_m).all(axis=0)][:, :1]
        axes.plot(*start_m, color=colour, marker="o", markersize=5, linewidth=1.8, label=name, zorder=5)
    axes.plot([], [], [], color=_DARK, linewidth=0.8, linestyle=_DASHES, label="truth")
    if len(surplus):
        axes.plot([], [], [], color=_GREY, linewidth=1.0, label="false track")
    _finish_3d(axes, floor_m)


def draw_errors(axes: Axes, traj_est: Trajectories, traj_ref: Trajectories) -> None:
    """Draw each drone's error over time, with gaps where it is missed.

    Bars at the top mark the frames in which a drone is missed, dotted lines the identity switches. The scale
    is logarithmic where an error exceeds the gate of 0.5 m, so that what came before stays readable.
    """
    pair = align(traj_est, traj_ref)
    error_m = np.linalg.norm(of_partners(pair.est_m, fixed_identity(pair)) - pair.ref_m, axis=-1)
    missed = pair.truth_known & np.isnan(error_m)
    switches = identity_switches(matched_per_frame(pair.distance_m, keep=True))
    time_s = _with_gaps(pair, pair.time_s)
    for drone, name in enumerate(pair.drones):
        colour = drone_colour(drone)
        axes.plot(time_s, 1e3 * _with_gaps(pair, error_m[:, drone]), color=colour, linewidth=1.1, label=name)
        bar = np.where(missed[:, drone], _BARS_TOP - _BARS_STEP * drone, np.nan)
        axes.plot(
            time_s, _with_gaps(pair, bar), color=colour, linewidth=3, transform=axes.get_xaxis_transform()
        )
    if missed.any():
        axes.plot([], [], color=_GREY, linewidth=3, label="missed")
    for number, switch_s in enumerate(pair.time_s[switches.any(axis=1)]):
        label = "identity switch" if number == 0 else None
        axes.axvline(switch_s, color=_DARK, linewidth=1.1, linestyle=":", label=label)
    _finish_errors(axes, error_m[np.isfinite(error_m)], num_bars=len(pair.drones) if missed.any() else 0)


def colours_of_estimates(traj_est: Trajectories, traj_ref: Trajectories) -> list[str]:
    """One colour per estimated drone: that of the true drone which it stands for, grey if it stands for none."""
    pair = align(traj_est, traj_ref)
    colours = [_GREY] * len(pair.drones_est)
    for drone, estimate in enumerate(fixed_identity(pair)):
        if estimate != UNASSIGNED:
            colours[estimate] = drone_colour(drone)
    return colours


def _with_gaps(
    pair: AlignedPair, values: Float[np.ndarray, "frames *rest"]
) -> Float[np.ndarray, "*rest_then_frames"]:
    """`values` with frames last, and NaN wherever frames are skipped, so that no line runs over a gap."""
    step = np.diff(pair.frame)
    after = np.flatnonzero(step > min(step, default=1)) + 1
    return np.insert(values.astype(float), after, np.nan, axis=0).T


def _finish_3d(axes: Axes3D, floor_m: float) -> None:
    from matplotlib.ticker import MaxNLocator, MultipleLocator

    axes.set_zlim(floor_m, axes.get_zlim()[1])
    extent_m = [high - low for low, high in (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())]
    axes.set_box_aspect(extent_m, zoom=1.1)
    for line in axes.lines:
        # The box stands over the edges of the axes at this zoom.
        line.set(clip_on=False, in_layout=False)
    # One distance between ticks, so that the one scale is seen.
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
    """Above the axes, in rows of six: beside them it would take its width from the picture."""
    axes.legend(
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=6,
        frameon=False,
        fontsize=8.5,
        labelcolor=_DARK,
        handlelength=1.6,
        columnspacing=1.4,
    )
