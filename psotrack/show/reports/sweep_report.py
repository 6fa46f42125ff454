"""The report of a sweep: error against work, and a table of all cells that sorts."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
from markupsafe import Markup

from psotrack.errors import SettingsError
from psotrack.show.reports.charts import figure_svg
from psotrack.show.reports.page import check_page_path, render, write_page
from psotrack.show.reports.tables import PageCell, PageTable, number, percent
from psotrack.sweep import Store
from psotrack.sweep.figures import error_against_work, error_per_drone, pareto_front

#: Columns of figures of the table of cells: the column of the results, heading, decimals and factor.
_FIGURES = (
    ("mean_error_m", "mean (mm)", 1, 1e3),
    ("p95_error_m", "95 % (mm)", 1, 1e3),
    ("offset_removed_mean_error_m", "without offset (mm)", 1, 1e3),
    ("hota", "HOTA", 3, 1.0),
    ("track_ms_per_frame", "ms per frame", 1, 1.0),
)
#: Largest number of cells whose errors per drone are drawn.
_MOST_BOXES = 6


def write_sweep_report(path: Path | str, folder: Path | str, *, force: bool = False) -> None:
    """Write the report of the results of a sweep.

    Args:
        path: file that ends in .html.
        folder: folder of the results.
        force: replace an existing file.

    Raises:
        InputError: the folder has no results.
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    check_page_path(path, force)
    store = Store(folder)
    rows = store.rows()
    cells = _cells(rows)
    status = store.status()
    text = render(
        "sweep.html",
        scenes={},
        title=f"Sweep {Path(folder).name}",
        name=f"Sweep {Path(folder).name}",
        figures=(
            (f"{len(cells)}", "finished cells"),
            (f"{len(rows)}", "runs"),
            (f"{status['failed']}", "failed cells"),
            (f"{1e3 * cells['mean_error_m'].min():.1f} mm", "smallest mean error"),
        ),
        pareto=_pareto(rows),
        table=_table(cells),
        boxes=_boxes(store, rows, cells),
        manifest=json.dumps(store.manifest(), indent=2),
    )
    write_page(path, text, force=force)


def _cells(rows: pd.DataFrame) -> pd.DataFrame:
    """One row per cell: what differs between cells, the means of the figures over runs, and the number of runs."""
    described = [
        name
        for name in rows.columns
        if name in ("sequence", "method", "cameras") or name.startswith(("settings.", "perturbation."))
    ]
    shown = [
        name
        for name in described
        if name in ("sequence", "method")
        or (not name.endswith(("seed", "draw")) and rows[name].map(lambda value: f"{value}").nunique() > 1)
    ]
    groups = rows.groupby("cell", sort=False)
    first = groups[shown].first().map(lambda value: _word(value))
    means = groups[[name for name, *_ in _FIGURES] + ["missed_rate"]].mean()
    table = first.join(means)
    table["std"] = groups["mean_error_m"].std()
    table["runs"] = groups.size()
    table["on_front"] = False
    for _, own in table.groupby("sequence"):
        front = pareto_front(own["track_ms_per_frame"].to_numpy(), own["mean_error_m"].to_numpy())
        table.loc[own.index[front], "on_front"] = True
    return table.reset_index()


def _word(value: object) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    return " ".join(f"{part}" for part in value) if isinstance(value, list | tuple) else f"{value}"


def _table(cells: pd.DataFrame) -> PageTable:
    figures = {name for name, *_ in _FIGURES} | {"missed_rate", "std", "runs", "on_front", "cell"}
    shown = [name for name in cells.columns if name not in figures]
    rows = []
    for _, cell in cells.iterrows():
        labels = [_label(cell[name]) for name in shown]
        values = [number(cell[name], decimals, factor=factor) for name, _, decimals, factor in _FIGURES]
        values.insert(1, number(cell["std"], 1, factor=1e3))
        rows.append(
            (
                *labels,
                *values,
                percent(cell["missed_rate"]),
                number(cell["runs"]),
                PageCell("yes" if cell["on_front"] else "", float(not cell["on_front"])),
            )
        )
    headings = [heading for _, heading, *_ in _FIGURES]
    headings.insert(1, "std (mm)")
    names = [name.removeprefix("settings.").removeprefix("perturbation.") for name in shown]
    note = (
        "Means over runs; std over runs. Front: no other cell of the sequence is better in error and in time."
    )
    return PageTable((*names, *headings, "missed", "runs", "front"), tuple(rows), note)


def _label(word: str) -> PageCell:
    try:
        return PageCell(word, float(word))
    except ValueError:
        return PageCell(word)


def _pareto(rows: pd.DataFrame) -> Markup:
    try:
        return figure_svg(error_against_work(rows))
    except SettingsError:
        # Results of a grid without particles and iterations have no axis of work in common.
        return Markup("")


def _boxes(store: Store, rows: pd.DataFrame, cells: pd.DataFrame) -> Markup:
    """Errors per drone of the best cell of each method in each sequence."""
    best = (
        cells.dropna(subset="mean_error_m")
        .sort_values("mean_error_m")
        .groupby(["sequence", "method"])
        .head(1)
    )
    errors: dict[str, dict[str, pd.DataFrame]] = {}
    for _, cell in best.head(_MOST_BOXES).iterrows():
        seeds = rows.loc[rows["cell"] == cell["cell"], "seed"].tolist()
        errors.setdefault(cell["sequence"], {})[cell["method"]] = store.errors(cell["cell"], seeds)
    return figure_svg(error_per_drone(errors, rows["method"])) if errors else Markup("")
