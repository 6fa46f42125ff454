"""Accuracy: one program, a subcommand for each study.

    python experiments/accuracy/accuracy.py reference --data data           # the table against which changes are judged
    python experiments/accuracy/accuracy.py real_flights --data data --real REAL
    python experiments/accuracy/accuracy.py covariances --data data
    python experiments/accuracy/accuracy.py localise --data data
    python experiments/accuracy/accuracy.py foreground --data data --real REAL

REAL is the folder of recordings that other people published, as OWNER/NAME. Each study simulates what is missing below
--data, writes a row per run and a record, and prints the table. The same command continues an interrupted study, if
the code has not changed. Headline figures (experiments/results.toml) are written to experiments/results, other studies
to DATA/results.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import covariances
import foreground
import localise
import pandas as pd
import real_flights
import reference

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results

STUDIES = {
    "reference": reference,
    "real_flights": real_flights,
    "covariances": covariances,
    "foreground": foreground,
    "localise": localise,
}


def save_rows(
    run: _results.Run, rows: Iterable[tuple[str, Callable[[], dict[str, Any]]]], partial: Path, out: Path
) -> pd.DataFrame:
    """Compute rows one after the other, and save them with their record.

    Finished rows are kept in a file until all rows are finished, so that the same command continues an interrupted
    study, if the code has not changed.

    Args:
        run: the run of the study.
        rows: a unique name and a function that computes the row, for each row.
        partial: the file of the finished rows.
        out: folder of the result.
    """
    state = {key: run.facts[key] for key in ("commit", "dirty", "command")}
    kept = json.loads(partial.read_text(encoding="utf-8")) if partial.exists() else {}
    done = kept["rows"] if kept.get("state") == state else {}
    partial.parent.mkdir(parents=True, exist_ok=True)
    for name, compute_row in rows:
        if name in done:
            continue
        done[name] = compute_row()
        words = (f"{value:.4f}" if isinstance(value, float) else f"{value}" for value in done[name].values())
        print(" ".join(words), flush=True)
        temporary = partial.with_suffix(".part")
        temporary.write_text(json.dumps({"state": state, "rows": done}, default=float), encoding="utf-8")
        temporary.replace(partial)
    table = pd.DataFrame(list(done.values()))
    run.save(out, rows=table)
    partial.unlink(missing_ok=True)
    return table


def main() -> None:
    """Read the command line, and run the study."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    studies = parser.add_subparsers(dest="study", required=True)
    for name, study in STUDIES.items():
        raw = argparse.RawDescriptionHelpFormatter
        options = studies.add_parser(name, description=study.__doc__, formatter_class=raw)
        options.add_argument("--data", type=Path, default=Path("data"), help="folder of what is simulated")
        options.add_argument("--real", type=Path, help="folder of the published recordings, as OWNER/NAME")
        options.add_argument("--out", type=Path, help="folder of the result")
        study.add_options(options)
    chosen = parser.parse_args()
    study, run = STUDIES[chosen.study], _results.Run(chosen.study)
    declared = chosen.study in _results.registry()
    out = chosen.out or (_results.FOLDER if declared else chosen.data / "results")
    table = save_rows(run, study.rows(chosen), chosen.data / "partial" / f"{run.name}.json", out)
    study.show(table, chosen)


if __name__ == "__main__":
    main()
