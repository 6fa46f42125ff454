"""The paper's Table 5 beside ours: mean errors over ten runs for each number of particles and iterations.

    python experiments/table5/table5.py            # 540 runs; the same command continues an interrupted call
    python experiments/table5/table5.py --quick    # the smallest and the largest swarms, two runs each
    python experiments/table5/table5.py --data FOLDER_OF_THE_DATASET

Without --data, missing sequences are simulated into data/. Writes table5.md and a picture to --out. Finished cells in
--out are not run again. With --results, rows (one per run) and record become the headline figure.
"""

from __future__ import annotations

import argparse
import sys
import tomllib
from pathlib import Path

import pandas as pd
from _pareto import error_against_work

from psotrack.errors import PsotrackError
from psotrack.sweeps import Grid, pivot, read_grid, render_table, sweep

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results
from _sequences import simulated_root

HERE = Path(__file__).parent
#: Title of a table -> column, its factor, and decimals.
TABLES = {
    "Mean error": ("mean_error_m", 1e3, 1),
    "Mean error, each drone's constant offset taken out": ("offset_removed_mean_error_m", 1e3, 1),
    "Identity switches": ("id_switches", 1.0, 1),
    "Missed, of all frames and drones": ("missed_rate", 1.0, 3),
    "Time of the track stage per frame": ("track_ms_per_frame", 1.0, 1),
}
#: Columns of the rows.
KEPT = ["sequence", "method", "settings.swarm.particles", "settings.swarm.iterations", "seed", "frames"]
KEPT += ["mean_error_m", "median_error_m", "p95_error_m", "max_error_m", "offset_removed_mean_error_m"]
KEPT += ["missed_rate", "id_switches", "mota", "idf1", "hota", "offset_removed_inside_90_rate"]
KEPT += ["track_ms_per_frame", "runs_in_batch", "commit"]


def main() -> None:
    """Simulate the missing sequences, track, and show the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="the smallest and the largest swarms")
    parser.add_argument("--grid", type=Path, help="[default: grid.toml or quick.toml, beside this file]")
    parser.add_argument(
        "--data", type=Path, help="root folder of the sequences [default: simulated into data/]"
    )
    parser.add_argument("--out", type=Path, help="[default: table5, or table5/quick]")
    parser.add_argument("--results", type=Path, help="write rows and record into this folder")
    options = parser.parse_args()
    run = _results.Run("table5")
    out = options.out or (Path("table5/quick") if options.quick else Path("table5"))
    try:
        grid = read_grid(options.grid or HERE / ("quick.toml" if options.quick else "grid.toml"))
        data = options.data or simulated_root(grid.sequences, Path("data"))
        rows = tracked(grid, out, data)
        show(rows, out)
        if options.results:
            run.save(options.results, rows=rows[[name for name in KEPT if name in rows]])
    except PsotrackError as error:
        sys.exit(f"table5: {error}")
    if rows.attrs["errors"]:
        sys.exit("\n".join(f"table5: {error}" for error in rows.attrs["errors"]))


def tracked(grid: Grid, out: Path, data: Path) -> pd.DataFrame:
    """One row per cell and run; cells that are finished in `out` are not run again."""
    from psotrack.support import keep_compiled

    keep_compiled(out / "cache" / "compiled")
    return sweep(grid, out, data=data, cache=out / "cache", progress=True).rows()


def show(rows: pd.DataFrame, out: Path) -> None:
    """Print the tables; write tables and the picture."""
    published = tomllib.loads((HERE / "published.toml").read_text())
    tables = {
        title: pivot(
            rows,
            rows_by=["sequence", "particles", "iterations"],
            columns_by=["method"],
            value=value,
            scale=scale,
        )
        for title, (value, scale, _) in TABLES.items()
    }
    print(render_table(tables["Mean error"]))
    said = [
        f"{name}: "
        + (f"{1e3 * low:.0f} to {1e3 * high:.0f} mm" if high > low else f"{1e3 * low:.0f} mm at best")
        for name, (low, high) in published.items()
        if name in set(rows["sequence"])
    ]
    print("Published mean errors:", ", ".join(said))
    figure = error_against_work(rows, published=published)
    figure.savefig(out / "error_against_work.png")
    parts = [
        f"## {title}\n\n{render_table(table, 'markdown', decimals=TABLES[title][2])}"
        for title, table in tables.items()
    ]
    (out / "table5.md").write_text("\n".join([*parts, f"Published mean errors: {', '.join(said)}.\n"]))
    print(f"{out}: {', '.join(sorted(path.name for path in out.glob('*.*')))}")


if __name__ == "__main__":
    main()
