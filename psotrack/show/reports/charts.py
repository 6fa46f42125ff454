"""Plots for pages: SVG whose text and axes have the colour of the page, so that light and dark pages can show them."""

from __future__ import annotations

import io

import numpy as np
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.figure import Figure

from psotrack.show.flights import QUANTITIES, Quantity
from psotrack.support import FAINT, INK, LINE, STYLE

#: Colours of figures, and the colours of a page that replace them.
_OF_PAGE = {INK: "currentColor", FAINT: "var(--faint)", LINE: "var(--line)"}


@rc_context(STYLE)
def quantity_svg(quantity: Quantity) -> Markup:
    """A plot of a quantity over time as an SVG element: a line per drone, and gaps where a value is not known.

    Matplotlib leaves out points that do not change how a line looks, so that long flights have small plots.
    """
    figure = Figure((9.5, 2.6), facecolor="none")
    axes = figure.add_subplot(xlabel="time (s)", ylabel=QUANTITIES[quantity.key][0], facecolor="none")
    for name, colour, values in zip(quantity.names, quantity.colours, quantity.values.T, strict=True):
        axes.plot(quantity.time_s, values, color=colour, linewidth=1.2, label=name)
    axes.margins(x=0.01)
    if np.nan_to_num(quantity.values).min(initial=0) >= 0:
        axes.set_ylim(bottom=0)
    if len(quantity.names) > 1:
        figure.legend(loc="outside upper left", ncols=5, handlelength=1.4)
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    content = text.getvalue()
    content = content[content.index("<svg") :]
    for colour, of_page in _OF_PAGE.items():
        content = content.replace(colour, of_page)
    return Markup(content)
