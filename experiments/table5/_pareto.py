"""The figure of error against work."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from psotrack.errors import SettingsError
from psotrack.support import COLOURS, INK, LINE, STYLE
from psotrack.sweeps.tables import natural

_MARKERS = "osD^vP"
#: A label of a point of the front that has nearly the height of the one before would cover it.
_HEIGHT = 0.99


def pareto_front(
    work: Float[np.ndarray, "cells"], error: Float[np.ndarray, "cells"]
) -> Int[np.ndarray, "front"]:
    """(front,), indices of the Pareto front, by ascending work: cells that no other cell dominates.

    A cell dominates another if it is better in work or error and at least as good in the other. NaN is never on the
    front; of equal cells only the first is.
    """
    order = np.lexsort((error, work))
    order = order[np.isfinite(work[order]) & np.isfinite(error[order])]
    best = np.minimum.accumulate(np.append(np.inf, error[order]))[:-1]
    return order[error[order] < best]


@rc_context(STYLE)
def error_against_work(
    rows: pd.DataFrame,
    *,
    error: str = "mean_error_m",
    published: Mapping[str, tuple[float, float]] | None = None,
) -> Figure:
    """Figure of error against work: a panel per sequence, a point per cell, the Pareto front of all methods as a line.

    Points on the front are labelled with particles x iterations. Bars are the standard deviation over runs.

    Args:
        rows: results, one row per cell and run, from `sweep`.
        error: name of the column of errors, metres.
        published: lowest and highest published error of a sequence, metres, drawn as a band.
    """
    cells = _cells(rows, error)
    sequences, methods = list(dict.fromkeys(cells["sequence"])), sorted(set(cells["method"]), key=natural)
    figure = Figure((4.6 * len(sequences), 4.4))
    panels = figure.subplots(1, len(sequences), sharey=True, squeeze=False)[0]
    for axes, sequence in zip(panels, sequences, strict=True):
        here = cells[cells["sequence"] == sequence]
        if sequence in (published or {}):
            low, high = (1e3 * value for value in (published or {})[sequence])
            axes.axhspan(low, max(high, 1.02 * low), color=LINE, label="published", zorder=0)
        _draw_front(axes, here.iloc[pareto_front(here["work"].to_numpy(), here["error"].to_numpy())])
        for number, method in enumerate(methods):
            points = here.loc[here["method"] == method, ["work", "error", "std"]].to_numpy().T
            style = {"color": COLOURS[number % len(COLOURS)], "fmt": _MARKERS[number % len(_MARKERS)]}
            axes.errorbar(*points, markersize=5, linewidth=0.8, label=method, **style)
        axes.set(title=sequence, xlabel="track stage (ms per frame)", xscale="log", yscale="log")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axis.set_minor_formatter(NullFormatter())
    panels[0].set_ylabel("mean error (mm)")
    labelled = {
        label: handle
        for axes in panels
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend([*labelled.values()], [*labelled], loc="outside lower center", ncols=min(len(labelled), 7))
    return figure


def _draw_front(axes: Axes, front: pd.DataFrame) -> None:
    """Draw the Pareto front as a line, with the particles and iterations of its points."""
    style: dict[str, Any] = {"drawstyle": "steps-post", "zorder": 1}
    axes.plot(front["work"], front["error"], color=INK, linewidth=0.9, label="Pareto front", **style)
    style = {"rotation": 40, "rotation_mode": "anchor", "verticalalignment": "bottom", "fontsize": 7}
    labelled = np.inf
    for work, error, *size in front[["work", "error", "particles", "iterations"]].to_numpy(float).tolist():
        if error <= _HEIGHT * labelled:
            labelled, words = error, "{:.0f} x {:.0f}".format(*size)
            axes.annotate(words, (work, error), xytext=(3, 3), textcoords="offset points", **style)


def _cells(rows: pd.DataFrame, error: str) -> pd.DataFrame:
    """One row per cell: sequence, method, particles, iterations, work (ms per frame), error and its spread (mm)."""
    settings = [f"settings.swarm.{name}" for name in ("particles", "iterations")]
    for name in ("sequence", "method", *settings, "track_ms_per_frame", error):
        if name not in rows:
            raise SettingsError("rows", expected=f"a column {name}", found="none")
    runs = rows.assign(error=1e3 * rows[error], work=rows["track_ms_per_frame"])
    cells = runs.groupby(["sequence", "method", *settings], sort=False)
    table = cells[["work", "error"]].mean().assign(std=cells["error"].std().fillna(0.0)).reset_index()
    return table.rename(columns={name: name.rpartition(".")[2] for name in settings})
