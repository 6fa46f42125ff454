"""Pictures of tracks or paths and their reference: from above and from the side, and errors over time.

Matplotlib is imported only for drawing; `pyplot` is never imported, because it has global state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from psotrack.evaluation.path_comparison import PathComparison
from psotrack.evaluation.tables import drone_label
from psotrack.support import COLOURS, FAINT, INK, drone_colour, save_figure
from psotrack.trajectories import Trajectories
from psotrack.trajectories.association import (
    UNASSIGNED,
    align,
    fixed_identity,
    fixed_partner_values,
    identity_switches,
    partners_per_frame,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_AXES = "xyz"
#: Margin around the references, as a fraction of their largest extent, and its least size, metres.
_MARGIN, _LEAST_M = 0.15, 0.1
#: Ratio of the largest value to the median above which the scale of values is logarithmic.
_FAR_ABOVE = 30


@dataclass(frozen=True)
class _Line:
    """A track or a path: its name, colour, positions, and values over time by their name and unit."""

    name: str
    colour: str
    position_m: Float[np.ndarray, "frames 3"]
    values: Mapping[str, Float[np.ndarray, "frames"]] = field(default_factory=dict)


def save_overview(
    png: Path | str, traj_est: Trajectories, traj_ref: Trajectories, *, force: bool = False
) -> None:
    """Save a PNG of tracks and their reference, and of the error of each drone over time.

    A track has the colour of the drone that it follows (`association.fixed_identity`); false tracks are dark. An error
    has gaps where the drone is missed; dotted lines mark identity switches.

    Raises:
        InputError: the estimate and the reference do not fit together.
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    pair = align(traj_est, traj_ref)
    partner = fixed_identity(pair)
    est_m = fixed_partner_values(pair.est_m, partner)
    error_mm = 1e3 * np.linalg.norm(est_m - pair.ref_m, axis=-1)
    switches = identity_switches(partners_per_frame(pair.distance_m, keep=True)).any(axis=1)
    lines = []
    for drone, name in enumerate(pair.drones):
        track = None if partner[drone] == UNASSIGNED else pair.drones_est[partner[drone]]
        values = {"error (mm)": error_mm[:, drone]}
        lines.append(_Line(drone_label(name, track), drone_colour(drone), est_m[:, drone], values))
    for index in np.setdiff1d(np.arange(len(pair.drones_est)), partner):
        lines.append(_Line(f"false track {pair.drones_est[index]}", INK, pair.est_m[:, index]))
    _save(Path(png), pair.time_s, pair.ref_m, lines, force, marks_s=pair.time_s[switches].tolist())


def save_paths(
    png: Path | str, comparisons: Mapping[str, PathComparison], *, title: str = "", force: bool = False
) -> None:
    """Save a PNG of paths and their reference, and of distance and angle over time (the paper's figure 11).

    Args:
        png: path of the PNG file.
        comparisons: comparisons of paths with the same reference at the same frames, by the names of the paths.
        title: title of the picture.
        force: replace an existing file.

    Raises:
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    lines = []
    for (name, each), colour in zip(comparisons.items(), COLOURS, strict=False):
        values = {"distance (mm)": 1e3 * each.distance_m}
        if each.turning is not None:
            values["angle (degrees)"] = each.turning.angle_deg
        lines.append(_Line(name, colour, each.position_m, values))
    first = next(iter(comparisons.values()))
    _save(Path(png), first.time_s, first.reference_m[:, None], lines, force, title=title)


def _save(
    png: Path,
    time_s: Float[np.ndarray, "frames"],
    reference_m: Float[np.ndarray, "frames references 3"],
    lines: Sequence[_Line],
    force: bool,
    *,
    marks_s: Sequence[float] = (),
    title: str = "",
) -> None:
    """Draw both views at one scale, and a panel for each kind of value."""
    # A line has a gap where frames are skipped.
    step_s = np.diff(time_s)
    skipped = np.flatnonzero(step_s > 1.5 * min(step_s, default=1.0)) + 1

    def gapped(values: np.ndarray) -> np.ndarray:
        return np.insert(values.astype(float), skipped, np.nan, axis=0)

    low_m, high_m = (find(reference_m, axis=(0, 1)) for find in (np.nanmin, np.nanmax))
    margin_m = max(_LEAST_M, _MARGIN * float((high_m - low_m).max()))
    low_m, high_m = low_m - margin_m, high_m + margin_m
    along = int(np.argmax((high_m - low_m)[:2]))
    views = {"from above": [along, 1 - along], "from the side": [along, 2]}
    heights = 7.0 * (high_m - low_m)[[1 - along, 2]] / (high_m - low_m)[along]
    over_time = list(dict.fromkeys(name for line in lines for name in line.values))

    def draw(figure: Figure) -> None:
        panels = figure.subplots(2 + len(over_time), 1, height_ratios=[*heights, *[2.0] * len(over_time)])
        for axes, (view, two) in zip(panels, views.items(), strict=False):
            for number, each_m in enumerate(gapped(reference_m[..., two]).swapaxes(0, 1)):
                label = "_" if number else "reference"
                axes.plot(*each_m.T, color=FAINT, linewidth=2.4, label=label)
            for line in lines:
                drawn_m = gapped(line.position_m[:, two])
                axes.plot(*drawn_m.T, color=line.colour, linewidth=1.0, label=line.name)
            (x_low, y_low), (x_high, y_high) = low_m[two], high_m[two]
            across, up = (f"{_AXES[axis]} (m)" for axis in two)
            axes.set(xlim=(x_low, x_high), ylim=(y_low, y_high), aspect="equal")
            axes.set(title=view, xlabel=across, ylabel=up)
        for axes, name in zip(panels[2:], over_time, strict=True):
            shown = [line for line in lines if name in line.values]
            for line in shown:
                axes.plot(gapped(time_s), gapped(line.values[name]), color=line.colour, linewidth=1.0)
            for mark_s in marks_s:
                axes.axvline(mark_s, color=INK, linestyle=":")
            _scale(axes, np.concatenate([line.values[name] for line in shown]))
            axes.set(xlabel="time (s)", ylabel=name)
        panels[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4)
        figure.suptitle(title, fontsize=9)

    save_figure(png, (8.0, float(heights.sum()) + 2.4 * len(over_time) + 1.0), draw, force)


def _scale(axes: Axes, values: Float[np.ndarray, "values"]) -> None:
    """Start the vertical axis at zero; make it logarithmic where the largest value is far above the median."""
    known = values[np.isfinite(values) & (values > 0)]
    if len(known) and known.max() > _FAR_ABOVE * np.median(known):
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.8 * float(np.percentile(known, 1)))
    else:
        axes.set_ylim(bottom=0)
