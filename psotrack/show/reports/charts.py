"""Plots for pages: SVG whose text and axes have the colour of the page, so that light and dark pages can show them."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Colour that stands for the colour of the page's text.
_INK = "#2b313a"
#: Colours of figures, and the colours of a page that replace them: text, faint text and lines.
_OF_PAGE = {_INK: "currentColor", "#9aa3ad": "var(--faint)", "#e3e6ea": "var(--line)"}
#: Largest number of points of a drawn line. A plot is about 1,100 pixels wide.
_MOST_POINTS = 2400


def svg(size_inches: tuple[float, float], draw: Callable[[Figure], None]) -> Markup:
    """An SVG element of a figure.

    Args:
        size_inches: width and height, inches.
        draw: draws into the empty figure that it is given.
    """
    from matplotlib.figure import Figure

    figure = Figure(size_inches, layout="constrained")
    draw(figure)
    return figure_svg(figure)


def figure_svg(figure: Figure) -> Markup:
    """An SVG element of a figure whose dark text and lines get the colour of the page's text."""
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    FigureCanvasSVG(figure)
    figure.patch.set_alpha(0)
    for axes in figure.axes:
        axes.patch.set_alpha(0)
    text = io.StringIO()
    # Text stays text, and the ids of elements are the same each time.
    with matplotlib.rc_context(
        {"svg.fonttype": "none", "svg.hashsalt": "psotrack", "font.family": "sans-serif"}
    ):
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    content = text.getvalue()
    content = content[content.index("<svg") :]
    for colour, of_page in _OF_PAGE.items():
        content = content.replace(colour, of_page)
    return Markup(content)


def style(axes: Axes, *, x: str, y: str) -> None:
    """Give axes the style of pages, with labels of both axes."""
    axes.set_facecolor("none")
    axes.grid(color=_INK, alpha=0.15, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.margins(x=0.01)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_INK)
    axes.tick_params(colors=_INK, labelsize=8)
    axes.set_xlabel(x, color=_INK, fontsize=9)
    axes.set_ylabel(y, color=_INK, fontsize=9)


def lines_over_time(
    time_s: Float[np.ndarray, "frames"],
    values: Float[np.ndarray, "frames lines"],
    names: Sequence[str],
    colours: Sequence[str],
    label: str,
) -> Markup:
    """A plot of one line per drone over time; gaps where a value is not known.

    Args:
        time_s: (frames,), times, seconds.
        values: (frames, lines), values; NaN where not known.
        names: name of each line.
        colours: colour of each line.
        label: what is plotted, with its unit.
    """

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        for line, (name, colour) in enumerate(zip(names, colours, strict=True)):
            at_s, shown = thinned(time_s, values[:, line])
            axes.plot(at_s, shown, color=colour, linewidth=1.2, label=name)
        style(axes, x="time (s)", y=label)
        known = values[np.isfinite(values)]
        if len(known) and known.min() >= 0:
            axes.set_ylim(bottom=0)
        if len(names) > 1:
            axes.legend(
                loc="lower left",
                bbox_to_anchor=(0, 1),
                ncols=5,
                frameon=False,
                fontsize=8.5,
                labelcolor=_INK,
                handlelength=1.4,
            )

    return svg((9.5, 2.6), draw)


def thinned(
    time_s: Float[np.ndarray, "frames"], values: Float[np.ndarray, "frames"]
) -> tuple[Float[np.ndarray, "points"], Float[np.ndarray, "points"]]:
    """A line with few points that looks the same: of each group of frames the lowest and the highest value.

    A group without a known value stays a gap.
    """
    size = -(-2 * len(values) // _MOST_POINTS)
    if size <= 2:
        return np.asarray(time_s, np.float64), np.asarray(values, np.float64)
    count = -(-len(values) // size)
    padded = np.full(count * size, np.nan)
    padded[: len(values)] = values
    groups = padded.reshape(count, size)
    known = np.isfinite(groups).any(axis=1)
    lowest, highest = (
        np.where(known, function(np.where(np.isfinite(groups), groups, fill), axis=1), 0)
        for function, fill in ((np.argmin, np.inf), (np.argmax, -np.inf))
    )
    rows = np.sort(np.stack([lowest, highest], axis=1), axis=1) + size * np.arange(count)[:, None]
    rows = np.minimum(rows, len(values) - 1).ravel()
    shown = np.asarray(values, np.float64)[rows]
    shown[~np.repeat(known, 2)] = np.nan
    return np.asarray(time_s, np.float64)[rows], shown
