"""Plots for pages: SVG whose text and axes have the colour of the page, so that light and dark pages can show them."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup

from psotrack.show.flights import QUANTITIES, Quantity

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Colour that stands for the colour of the page's text.
_INK = "#2b313a"
#: Colours of figures, and the colours of a page that replace them: text, faint text and lines.
_OF_PAGE = {_INK: "currentColor", "#9aa3ad": "var(--faint)", "#e3e6ea": "var(--line)"}


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


def quantity_svg(quantity: Quantity) -> Markup:
    """A plot of a quantity over time with a line per drone, and gaps where a value is not known.

    Matplotlib leaves out points that do not change how a line looks, so that long flights have small plots.
    """
    from matplotlib.figure import Figure

    figure = Figure((9.5, 2.6), layout="constrained")
    axes = figure.add_subplot()
    for name, colour, values in zip(quantity.names, quantity.colours, quantity.values.T, strict=True):
        axes.plot(quantity.time_s, values, color=colour, linewidth=1.2, label=name)
    axes.grid(color=_INK, alpha=0.15, linewidth=0.6)
    axes.margins(x=0.01)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_INK)
    axes.tick_params(colors=_INK, labelsize=8)
    axes.set_xlabel("time (s)", color=_INK, fontsize=9)
    axes.set_ylabel(QUANTITIES[quantity.key][0], color=_INK, fontsize=9)
    if np.nan_to_num(quantity.values).min(initial=0) >= 0:
        axes.set_ylim(bottom=0)
    if len(quantity.names) > 1:
        axes.legend(
            loc="lower left",
            bbox_to_anchor=(0, 1),
            ncols=5,
            frameon=False,
            fontsize=8.5,
            labelcolor=_INK,
            handlelength=1.4,
        )
    return figure_svg(figure)
