"""Shared parts of the studies of this folder: sequences, a run of the tracker, and rows that are kept after Ctrl-C."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pandas as pd

from psotrack.errors import PsotrackError
from psotrack.evaluation import evaluate
from psotrack.foreground.silhouettes import Silhouettes, compute
from psotrack.pipeline import track_runs
from psotrack.recordings import Recording
from psotrack.recordings.datasets import read_sequence
from psotrack.settings import TrackSettings
from psotrack.support import keep_compiled

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results
from _sequences import simulated

#: Figures of `evaluate` that a row has.
KEPT = ["offset_removed_mean_error_m", "mean_error_m", "max_error_m", "missed_rate", "id_switches", "hota"]
KEPT += ["offset_removed_inside_90_rate", "offset_removed_mean_nees"]

#: Size of the swarm on each sequence.
EFFORT: dict[str, dict[str, Any]] = {
    "S01_D2_A": {"swarm.kind": "joint", "swarm.particles": 50, "swarm.iterations": 50},
    "S02_D4_A": {"swarm.kind": "per-drone", "swarm.particles": 30, "swarm.iterations": 20},
    "S04_D10": {"swarm.kind": "per-drone", "swarm.particles": 50, "swarm.iterations": 30},
}


def parser(description: str | None) -> argparse.ArgumentParser:
    """Options of every study."""
    options = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--data", type=Path, default=Path("data"), help="the data's root folder")
    options.add_argument(
        "--out", type=Path, default=Path("experiments/accuracy/results"), help="folder of the result"
    )
    return options


def cache_folder(data: Path) -> Path:
    """Folder of silhouettes and compiled programs, beside the data."""
    return data / "silhouettes"


def open_sequence(name: str, data: Path, seed: int = 0) -> tuple[Recording, Silhouettes]:
    """Read a simulated sequence and its silhouettes; make both if they are missing."""
    keep_compiled(cache_folder(data) / "compiled")
    recording = read_sequence(simulated(name, data, seed)).usable()
    return recording, compute(recording, TrackSettings().silhouettes, cache=cache_folder(data))


def figures(recording: Recording, silhouettes: Silhouettes, settings: TrackSettings) -> dict[str, Any]:
    """Figures of one run. A run that finds no drones misses all drones."""
    assert recording.truth is not None
    try:
        (tracked,) = track_runs(recording, silhouettes, [settings])
    except PsotrackError as error:
        tracked = error
    if isinstance(tracked, PsotrackError):
        return {"missed_rate": 1.0, "note": f"{tracked}"}
    errors = evaluate(tracked.trajectories, recording.truth).to_dict()
    ms = 1e3 * tracked.record["seconds"]["track"] / recording.num_frames
    found = tracked.trajectories.num_drones
    return {key: errors[key] for key in KEPT} | {"drones_found": found, "track_ms_per_frame": ms}


def start(name: str) -> _results.Run:
    """Begin the run of a study; its record states the commit at this moment."""
    return _results.Run(name)


def save_rows(
    run: _results.Run,
    rows: Iterable[tuple[str, Callable[[], dict[str, Any]]]],
    data: Path,
    out: Path,
    *,
    draw: Callable[[pd.DataFrame], None] | None = None,
    files: Iterable[Path] = (),
) -> pd.DataFrame:
    """Compute rows one after the other, and save them with their record.

    Finished rows are kept in `data`/partial until all rows are finished, so that the same command continues an
    interrupted study, if the code has not changed.

    Args:
        run: the run of the experiment.
        rows: a unique name and a function that computes the row, for each row.
        data: root folder of the data.
        out: folder of the result.
        draw: draws the pictures of the result.
        files: the pictures that `draw` writes.
    """
    partial = data / "partial" / f"{run.name}.json"
    done = _read_partial(partial, run.code_state)
    for name, compute_row in rows:
        if name in done:
            continue
        done[name] = compute_row()
        words = (f"{value:.4f}" if isinstance(value, float) else f"{value}" for value in done[name].values())
        print(" ".join(words), flush=True)
        _write_partial(partial, run.code_state, done)
    table = pd.DataFrame(list(done.values()))
    if draw is not None:
        draw(table)
    run.save(out, rows=table, files=files)
    partial.unlink(missing_ok=True)
    return table


def _read_partial(path: Path, code_state: str) -> dict[str, dict[str, Any]]:
    """Read the rows that an interrupted run of the same code has finished."""
    if not path.exists():
        return {}
    kept = json.loads(path.read_text(encoding="utf-8"))
    return kept["rows"] if kept["code_state"] == code_state else {}


def _write_partial(path: Path, code_state: str, rows: dict[str, dict[str, Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".part")
    temporary.write_text(
        json.dumps({"code_state": code_state, "rows": rows}, default=float), encoding="utf-8"
    )
    temporary.replace(path)
