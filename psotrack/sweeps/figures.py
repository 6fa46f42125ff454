"""Figures of results: error against work, error over time, and errors per drone.

Each function returns a Matplotlib figure that is not registered with `pyplot`, which has global state. A notebook shows
the returned figure, and `save` writes it to a file.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from psotrack.errors import SettingsError
from psotrack.support import (
    COLOURS,
    FAINT,
    INK,
    LINE,
    STYLE,
    atomic_write,
    drone_colour,
    refuse_to_overwrite,
)
from psotrack.sweeps.tables import natural

_MARKERS = "osD^vP"
#: Width of all boxes of a drone, as a share of the distance between drones.
_BOXES = 0.8
#: A label of a point of the front that has nearly the height of the one before would cover it.
_HEIGHT = 0.99


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
        figure.savefig(temporary, format="png")


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
    sequences, colours = list(dict.fromkeys(cells["sequence"])), method_colours(cells["method"])
    figure = Figure((4.6 * len(sequences), 4.4))
    panels = figure.subplots(1, len(sequences), sharey=True, squeeze=False)[0]
    for axes, sequence in zip(panels, sequences, strict=True):
        here = cells[cells["sequence"] == sequence]
        if sequence in (published or {}):
            low, high = (1e3 * value for value in (published or {})[sequence])
            axes.axhspan(low, max(high, 1.02 * low), color=LINE, label="published", zorder=0)
        _draw_front(axes, here.iloc[pareto_front(here["work"].to_numpy(), here["error"].to_numpy())])
        for number, (method, colour) in enumerate(colours.items()):
            points = here.loc[here["method"] == method, ["work", "error", "std"]].to_numpy().T
            marker = _MARKERS[number % len(_MARKERS)]
            axes.errorbar(*points, fmt=marker, color=colour, markersize=5, linewidth=0.8, label=method)
        _make_logarithmic(axes, "xy")
        axes.set(title=sequence, xlabel="track stage (ms per frame)")
    panels[0].set_ylabel("mean error (mm)")
    return _with_legend(figure)


@rc_context(STYLE)
def error_over_time(errors: Mapping[str, pd.DataFrame], title: str = "") -> Figure:
    """A panel per method: each drone's error in the run of median error, and the identity switches of all runs.

    Args:
        errors: rows of `errors_over_time` with a column `seed`, by method.
        title: title of the figure.
    """
    figure = Figure((9.0, 0.8 + 2.1 * len(errors)))
    panels = figure.subplots(len(errors), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (method, rows) in zip(panels, errors.items(), strict=True):
        seed = _median_run(rows)
        run = rows[rows["seed"] == seed]
        for number, (drone, of) in enumerate(run.groupby("drone", observed=True)):
            colour, missed = drone_colour(number), of.loc[of["error_m"].isna(), "time_s"]
            axes.plot(of["time_s"], 1e3 * of["error_m"], color=colour, linewidth=1.0, label=drone)
            _mark(axes, missed, 0.97 - 0.03 * number, marker="_", color=colour, label="missed")
        own, others = (np.unique(of.loc[of["switch"], "time_s"]) for of in (run, rows[rows["seed"] != seed]))
        if len(own):
            heights = axes.get_xaxis_transform()
            axes.vlines(own, 0, 1, color=INK, linestyle=":", label="identity switch", transform=heights)
        _mark(axes, others, 0.02, marker="|", color=FAINT, label="switch in another run")
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
        axes.set(title=f"{method}: {which}", ylabel="error (mm)")
    panels[-1].set_xlabel("time (s)")
    figure.suptitle(title, fontsize=10)
    return _with_legend(figure)


@rc_context(STYLE)
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
    figure = Figure((9.0, 0.8 + 2.3 * len(errors)))
    panels = figure.subplots(len(errors), 1, squeeze=False)[:, 0]
    for axes, (sequence, runs) in zip(panels, errors.items(), strict=True):
        width = _BOXES / len(runs)
        for number, (method, rows) in enumerate(sorted(runs.items(), key=lambda each: natural(each[0]))):
            # Runs without any drone have no errors.
            if rows.empty:
                continue
            groups = {f"{name}": of["error_m"].dropna() for name, of in rows.groupby("drone", observed=True)}
            line, places = {"color": colours[method]}, np.arange(len(groups))
            axes.boxplot(
                [1e3 * values for values in groups.values()],
                positions=places + (number - (len(runs) - 1) / 2) * width,
                widths=0.85 * width,
                whis=(5, 95),
                showfliers=False,
                patch_artist=True,
                manage_ticks=False,
                label=method,
                medianprops={"color": "white", "linewidth": 1.4},
                boxprops={"facecolor": colours[method], "edgecolor": colours[method]},
                whiskerprops=line,
                capprops=line,
            )
            axes.set_xticks(places, list(groups))
        _make_logarithmic(axes, "y")
        axes.set(title=sequence, ylabel="error (mm)")
    return _with_legend(figure)


def _draw_front(axes: Axes, front: pd.DataFrame) -> None:
    """Draw the Pareto front as a line, with the particles and iterations of its points."""
    axes.plot(
        front["work"],
        front["error"],
        color=INK,
        linewidth=0.9,
        drawstyle="steps-post",
        label="Pareto front",
        zorder=1,
    )
    labelled = np.inf
    turned: dict[str, Any] = {"rotation": 40, "rotation_mode": "anchor", "verticalalignment": "bottom"}
    for work, error, *size in front[["work", "error", "particles", "iterations"]].to_numpy(float).tolist():
        if error <= _HEIGHT * labelled:
            labelled = error
            axes.annotate(
                "{:.0f} x {:.0f}".format(*size),
                (work, error),
                xytext=(3, 3),
                textcoords="offset points",
                fontsize=7,
                **turned,
            )


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


def _make_logarithmic(axes: Axes, names: str) -> None:
    """Make the axes x or y logarithmic where they have numbers above 0, with labels such as 20 and 50."""
    for name in names:
        if np.isfinite(getattr(axes.dataLim, f"minpos{name}")):
            getattr(axes, f"set_{name}scale")("log")
            axis = getattr(axes, f"{name}axis")
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axis.set_minor_formatter(NullFormatter())


def _with_legend(figure: Figure) -> Figure:
    """The figure with one legend for all panels, below them."""
    labelled = {
        label: handle
        for axes in figure.axes
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    columns = max(1, min(len(labelled), 7))
    figure.legend([*labelled.values()], [*labelled], loc="outside lower center", ncols=columns)
    return figure
