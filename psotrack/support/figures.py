"""PNG figures, and one colour per drone.

Matplotlib is imported at the first figure. `pyplot` is not used, because it has global state.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from psotrack.errors import OutputError
from psotrack.support.files import atomic_write, refuse_to_overwrite

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Colours of the drones in their order. The first six are from Okabe and Ito (2008), for colour-blind readers.
COLOURS = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7a5195", "#8c8c00", "#7f4f24", "#4d4d4d",
)  # fmt: skip
_DPI = 150
#: Colours of text, of what is faint, and of lines.
INK, FAINT, LINE = "#2b313a", "#9aa3ad", "#e3e6ea"
#: How figures look, as Matplotlib's settings: for `matplotlib.rc_context`.
STYLE: dict[Any, Any] = {
    "figure.constrained_layout.use": True,
    "figure.dpi": _DPI,
    "font.family": "sans-serif",
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.titlelocation": "left",
    "axes.titlesize": 9,
    "axes.edgecolor": FAINT,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": LINE,
    "grid.linewidth": 0.6,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    # Text stays text, and the ids of elements are the same each time.
    "svg.fonttype": "none",
    "svg.hashsalt": "psotrack",
}


def drone_colour(drone: int) -> str:
    """Colour of a drone, as #rrggbb.

    Args:
        drone: index of the drone in the reference, from 0.
    """
    return COLOURS[drone % len(COLOURS)]


def save_figure(
    path: Path | str, size_inches: tuple[float, float], draw: Callable[[Figure], None], force: bool
) -> None:
    """Draw a figure without a window and save it as PNG.

    Args:
        path: path of the PNG file.
        size_inches: width and height, inches.
        draw: draws into the empty figure that it is given.
        force: replace an existing file.

    Raises:
        OutputError: the path does not end in .png, the file exists and `force` is not set, or it cannot be written.
    """
    if Path(path).suffix.lower() != ".png":
        raise OutputError(path, expected="a file that ends in .png", found=Path(path).name)
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    refuse_to_overwrite(path, force)
    with rc_context(STYLE), atomic_write(path) as temporary:
        figure = Figure(size_inches)
        FigureCanvasAgg(figure)
        draw(figure)
        figure.savefig(temporary, format="png")
