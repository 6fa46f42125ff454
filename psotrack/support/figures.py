"""Figures on disk: one colour per drone, and PNG files that are written whole.

Matplotlib is imported when something is drawn, and `pyplot`, with its global state, not at all.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from psotrack.support.files import refuse_to_overwrite, written_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: One colour per drone, in turn; first those of Okabe and Ito (2008), which colour-blind people tell apart.
COLOURS = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#cc79a7",
    "#e69f00",
    "#56b4e9",
    "#7a5195",
    "#8c8c00",
    "#7f4f24",
    "#4d4d4d",
)
_DPI = 150


def colour_of(drone: int) -> str:
    """The colour of the drone at this place of the reference's order, as #rrggbb."""
    return COLOURS[drone % len(COLOURS)]


def save_figure(
    path: Path, size_inches: tuple[float, float], draw: Callable[[Figure], None], force: bool
) -> None:
    """Save a PNG of what `draw` draws, without a window; see `save_trajectories` for what is raised."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    refuse_to_overwrite(path, force)
    figure = Figure(size_inches, dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    draw(figure)
    with written_whole(path) as temporary:
        figure.savefig(temporary, format="png")
