"""The report of a sweep: error against work, and a table of all cells that sorts."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
from markupsafe import Markup

from psotrack.errors import SettingsError
from psotrack.show.reports.charts import figure_svg
from psotrack.show.reports.page import check_page_path, render, write_page
from psotrack.show.reports.tables import PageColumn, PageTable, make_table, percent
from psotrack.sweeps import Store
from psotrack.sweeps.figures import error_against_work, error_per_drone, pareto_front

#: Figures of the table of cells.
_FIGURES = (
    PageColumn("mean (mm)", "mean_error_m", 1, 1e3),
    PageColumn("std (mm)", "std", 1, 1e3),
    PageColumn("95 % (mm)", "p95_error_m", 1, 1e3),
    PageColumn("without offset (mm)", "offset_removed_mean_error_m", 1, 1e3),
    PageColumn("HOTA", "hota", 3),
    PageColumn("ms per frame", "track_ms_per_frame", 1),
    percent("missed", "missed_rate"),
    PageColumn("runs", "runs", 0),
    PageColumn("front", "on_front"),
)
_NOTE = "Means over runs, best first; std over runs. Front: no cell of the sequence is better in error and in time."
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
    shown = _described(rows)
    cells = _cells(rows, shown)
    text = render(
        "sweep.html",
        None,
        title=f"Sweep {Path(folder).name}",
        figures=(
            (f"{len(cells)}", "finished cells"),
            (f"{len(rows)}", "runs"),
            (f"{store.status()['failed']}", "failed cells"),
            (f"{1e3 * cells['mean_error_m'].min():.1f} mm", "smallest mean error"),
        ),
        pareto=_pareto(rows),
        table=_table(cells, shown),
        boxes=_boxes(store, rows, cells),
        manifest=json.dumps(store.manifest(), indent=2),
    )
    write_page(path, text, force=force)


def _described(rows: pd.DataFrame) -> list[str]:
    """Columns in which cells differ, besides their seeds."""

    def differs(name: str) -> bool:
        is_setting = name == "cameras" or name.startswith(("settings.", "perturbation."))
        return is_setting and not name.endswith(("seed", "draw")) and rows[name].map(str).nunique() > 1

    return [name for name in rows.columns if name in ("sequence", "method") or differs(name)]


def _cells(rows: pd.DataFrame, shown: list[str]) -> pd.DataFrame:
    """One row per cell: what differs between cells, the means of the figures over runs, and the number of runs."""
    groups = rows.groupby("cell", sort=False)
    means = groups[[column.key for column in _FIGURES if column.key in rows.columns]].mean()
    table = groups[shown].first().join(means)
    table["std"] = groups["mean_error_m"].std()
    table["runs"] = groups.size()
    table["on_front"] = ""
    for _, own in table.groupby("sequence"):
        front = pareto_front(own["track_ms_per_frame"].to_numpy(), own["mean_error_m"].to_numpy())
        table.loc[own.index[front], "on_front"] = "yes"
    return table.reset_index().sort_values(["sequence", "mean_error_m"])


def _table(cells: pd.DataFrame, shown: list[str]) -> PageTable:
    settings = [
        PageColumn(name.removeprefix("settings.").removeprefix("perturbation."), name) for name in shown
    ]
    return make_table([*settings, *_FIGURES], cells.to_dict("records"), _NOTE)


def _pareto(rows: pd.DataFrame) -> Markup:
    try:
        return figure_svg(error_against_work(rows))
    except SettingsError:
        # Results of a grid without particles and iterations have no axis of work in common.
        return Markup("")


def _boxes(store: Store, rows: pd.DataFrame, cells: pd.DataFrame) -> Markup:
    """Errors per drone of the best cell of each method in each sequence."""
    best = cells.dropna(subset="mean_error_m").groupby(["sequence", "method"]).head(1)
    errors: dict[str, dict[str, pd.DataFrame]] = {}
    for cell in best.head(_MOST_BOXES).to_dict("records"):
        seeds = rows.loc[rows["cell"] == cell["cell"], "seed"].tolist()
        errors.setdefault(cell["sequence"], {})[cell["method"]] = store.errors(cell["cell"], seeds)
    return figure_svg(error_per_drone(errors, rows["method"])) if errors else Markup("")
