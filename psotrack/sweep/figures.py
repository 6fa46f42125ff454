"""Figures of results: error against work, error over time, and errors per drone.

Each function returns a Matplotlib figure that is not registered with `pyplot`, which has global state. A notebook shows
the returned figure, and `save` writes it to a file.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Int

from psotrack.errors import SettingsError
from psotrack.support import COLOURS, atomic_write, drone_colour, refuse_to_overwrite
from psotrack.sweep.tables import natural

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DARK, _GREY, _LIGHT = "#2b313a", "#9aa3ad", "#e3e6ea"
_DPI = 150
_MARKERS = "osD^vP"
#: Width of all boxes of a drone, as a share of the distance between drones.
_BOXES = 0.8


def method_colours(methods: Iterable[str]) -> dict[str, str]:
    """A colour for each method, which does not depend on the order in which the methods come."""
    names = sorted(set(methods), key=natural)
    return {name: COLOURS[number % len(COLOURS)] for number, name in enumerate(names)}


def save(path: Path | str, figure: Figure, *, force: bool = False) -> None:
    """Save a figure as PNG.

    Raises:
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    path = Path(path)
    refuse_to_overwrite(path, force)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=_DPI)


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
    sequences, colours = list(dict.fromkeys(cells["sequence"])), method_colours(cells["method"])
    figure = _figure(4.6 * len(sequences), 4.4)
    panels = figure.subplots(1, len(sequences), sharey=True, squeeze=False)[0]
    for axes, sequence in zip(panels, sequences, strict=True):
        here = cells[cells["sequence"] == sequence]
        if sequence in (published or {}):
            low, high = (1e3 * value for value in (published or {})[sequence])
            axes.axhspan(low, max(high, 1.02 * low), color=_LIGHT, label="published", zorder=0)
        front = here.iloc[pareto_front(here["work"].to_numpy(), here["error"].to_numpy())]
        axes.plot(
            front["work"],
            front["error"],
            color=_DARK,
            linewidth=0.9,
            zorder=1,
            label="Pareto front",
            drawstyle="steps-post",
        )
        for number, (method, colour) in enumerate(colours.items()):
            of = here[here["method"] == method]
            axes.errorbar(
                of["work"],
                of["error"],
                of["std"],
                fmt=_MARKERS[number % len(_MARKERS)],
                color=colour,
                markersize=5,
                linewidth=0.8,
                label=method,
            )
        labelled = np.inf
        for _, point in front.iterrows():
            if point["error"] > 0.99 * labelled:
                continue  # the label would cover the previous point's label
            labelled = point["error"]
            axes.annotate(
                f"{point['particles']:.0f} x {point['iterations']:.0f}",
                (point["work"], point["error"]),
                xytext=(3, 3),
                textcoords="offset points",
                fontsize=7,
                rotation=40,
                rotation_mode="anchor",
                verticalalignment="bottom",
                color=_DARK,
            )
        _make_logarithmic(axes, "xy")
        _finish(axes, "track stage (ms per frame)", "mean error (mm)" if axes is panels[0] else "", sequence)
    _legend(figure, panels)
    return figure


def error_over_time(errors: Mapping[str, pd.DataFrame], title: str = "") -> Figure:
    """A panel per method: each drone's error in the run of median error, and the identity switches of all runs.

    Args:
        errors: rows of `errors_over_time` with a column `seed`, by method.
        title: title of the figure.
    """
    figure = _figure(9.0, 0.8 + 2.1 * len(errors))
    panels = figure.subplots(len(errors), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (method, rows) in zip(panels, errors.items(), strict=True):
        seed = _median_run(rows)
        run = rows[rows["seed"] == seed]
        for number, (drone, of) in enumerate(run.groupby("drone", observed=True)):
            axes.plot(
                of["time_s"], 1e3 * of["error_m"], color=drone_colour(number), linewidth=1.0, label=drone
            )
            missed = of[of["error_m"].isna()]
            _mark(
                axes,
                missed["time_s"],
                0.97 - 0.03 * number,
                marker="_",
                color=drone_colour(number),
                label="missed",
            )
        own, others = (np.unique(of.loc[of["switch"], "time_s"]) for of in (run, rows[rows["seed"] != seed]))
        if len(own):
            heights = axes.get_xaxis_transform()
            axes.vlines(own, 0, 1, color=_DARK, linestyle=":", label="identity switch", transform=heights)
        _mark(axes, others, 0.02, marker="|", color=_GREY, label="switch in another run")
        error_mm = 1e3 * run["error_m"].dropna()
        # A few very small errors would take half of the logarithmic scale.
        smallest_mm = error_mm.quantile(0.02)
        if error_mm.max() > 10 * error_mm.median() and smallest_mm > 0:
            _make_logarithmic(axes, "y")
            axes.set_ylim(bottom=smallest_mm)
        else:
            axes.set_ylim(bottom=0.0)
        runs = rows["seed"].nunique()
        which = f"run {seed}, the median of {runs}" if runs > 1 else f"run {seed}"
        _finish(axes, "time (s)" if axes is panels[-1] else "", "error (mm)", f"{method}: {which}")
    figure.suptitle(title, fontsize=10, color=_DARK)
    _legend(figure, panels)
    return figure


def error_per_drone(
    errors: Mapping[str, Mapping[str, pd.DataFrame]], methods: Iterable[str] | None = None
) -> Figure:
    """A panel per sequence, a box per drone and method: the errors of all frames and runs.

    A box holds the middle half of the errors, its line is the median, and the whiskers hold 90 % of the errors.

    Args:
        errors: rows of `errors_over_time`, by sequence and method.
        methods: all methods of the results, for their colours, where `errors` has only some of them.
    """
    shown = [name for each in errors.values() for name in each]
    colours = method_colours(shown if methods is None else methods)
    figure = _figure(9.0, 0.8 + 2.3 * len(errors))
    panels = figure.subplots(len(errors), 1, squeeze=False)[:, 0]
    for axes, (sequence, runs) in zip(panels, errors.items(), strict=True):
        width = _BOXES / len(runs)
        for number, (method, rows) in enumerate(sorted(runs.items(), key=lambda each: natural(each[0]))):
            # Runs without any drone have no errors.
            if rows.empty:
                continue
            colour = colours[method]
            groups = [
                (str(name), of["error_m"].dropna()) for name, of in rows.groupby("drone", observed=True)
            ]
            places = np.arange(len(groups)) + (number - (len(runs) - 1) / 2) * width
            boxes = axes.boxplot(
                [1e3 * values for _, values in groups],
                positions=places,
                widths=0.85 * width,
                whis=(5, 95),
                showfliers=False,
                patch_artist=True,
                manage_ticks=False,
                medianprops={"color": "white", "linewidth": 1.4},
                boxprops={"facecolor": colour, "edgecolor": colour},
                whiskerprops={"color": colour},
                capprops={"color": colour},
            )
            boxes["boxes"][0].set_label(method)
            axes.set_xticks(np.arange(len(groups)), [name for name, _ in groups])
        _make_logarithmic(axes, "y")
        _finish(axes, "", "error (mm)", sequence)
    _legend(figure, panels)
    return figure


def _mark(axes: Axes, time_s: Any, height: float, **style: Any) -> None:
    """Mark moments at a height, as a share of the panel's height."""
    if len(time_s):
        heights = np.full(len(time_s), height)
        axes.plot(time_s, heights, linestyle="", markersize=3, transform=axes.get_xaxis_transform(), **style)


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


def _median_run(rows: pd.DataFrame) -> Any:
    """Seed of the run with the median mean error; of two runs in the middle, the run with the smaller error."""
    means = rows.groupby("seed")["error_m"].mean().sort_values()
    return means.index[(len(means) - 1) // 2]


def _figure(width_in: float, height_in: float) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((width_in, height_in), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _finish(axes: Axes, x: str, y: str, title: str) -> None:
    axes.set_title(title, fontsize=9, color=_DARK, loc="left")
    axes.set_xlabel(x, color=_DARK)
    axes.set_ylabel(y, color=_DARK)
    axes.grid(color=_LIGHT, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors=_DARK, labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_GREY)


def _make_logarithmic(axes: Axes, names: str) -> None:
    """Make the axes x or y logarithmic where they have numbers above 0, with labels such as 20 and 50."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    for name in names:
        if np.isfinite(getattr(axes.dataLim, f"minpos{name}")):
            getattr(axes, f"set_{name}scale")("log")
            axis = getattr(axes, f"{name}axis")
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axis.set_minor_formatter(NullFormatter())


def _legend(figure: Figure, panels: Iterable[Axes]) -> None:
    """Add one legend for all panels, below the panels."""
    labelled = {
        label: handle
        for axes in panels
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        list(labelled.values()),
        list(labelled),
        loc="outside lower center",
        ncols=max(1, min(len(labelled), 7)),
        frameon=False,
        fontsize=8.5,
        labelcolor=_DARK,
    )
