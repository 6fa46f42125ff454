"""One run of the tracker, from stored silhouettes to figures: what the studies of this folder have in common."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pandas as pd

from psotrack.datasets.dpjait import read_sequence
from psotrack.errors import PsotrackError
from psotrack.evaluation import evaluate
from psotrack.pipeline import environment, track_from_silhouettes
from psotrack.recordings import Sequence
from psotrack.settings import TrackSettings
from psotrack.silhouettes import Silhouettes, compute
from psotrack.simulation import simulate
from psotrack.support import keep_compiled

KEPT = ["offset_removed_mean_error_m", "mean_error_m", "max_error_m", "missed_rate", "id_switches", "hota"]
KEPT += ["offset_removed_inside_90_rate", "offset_removed_mean_nees"]

#: Swarms of the figures to reach.
EFFORT: dict[str, dict[str, Any]] = {
    "S01_D2_A": {"swarm": "joint", "particles": 50, "iterations": 50},
    "S02_D4_A": {"swarm": "per-drone", "particles": 30, "iterations": 20},
    "S04_D10": {"swarm": "per-drone", "particles": 50, "iterations": 30},
}


def parser(description: str | None) -> argparse.ArgumentParser:
    """The options that all studies have."""
    options = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--data", type=Path, default=Path("data"), help="the data's root folder")
    options.add_argument("--out", type=Path, default=Path("experiments/accuracy/results"), help="of results")
    return options


def cache_of(data: Path) -> Path:
    """Silhouettes and compiled programs, beside the data."""
    return data / "silhouettes"


def folder_of(name: str, data: Path, seed: int) -> Path:
    """The folder of a simulated sequence, which is made if it is not there."""
    folder = data / f"seed{seed}" / "Simulated_Data" / name
    if not folder.exists():
        print(f"simulating {folder}", flush=True)
        simulate(name, folder.parents[1], seed=seed, masks=False, onboard=False)
    return folder


def opened(name: str, data: Path, seed: int = 0) -> tuple[Sequence, Silhouettes]:
    """A simulated sequence and its silhouettes; both are made if they are not there."""
    keep_compiled(cache_of(data) / "compiled")
    sequence = read_sequence(folder_of(name, data, seed)).usable()
    return sequence, compute(sequence, TrackSettings().silhouettes, cache=cache_of(data))


def figures(sequence: Sequence, silhouettes: Silhouettes, settings: TrackSettings) -> dict[str, Any]:
    """What evaluation says of one run. A run that finds no drones has missed all of them."""
    assert sequence.truth is not None
    try:
        tracked = track_from_silhouettes(sequence, silhouettes, settings)
    except PsotrackError as error:
        return {"missed_rate": 1.0, "note": f"{error}"}
    errors = evaluate(tracked.trajectories, sequence.truth).to_dict()
    ms = 1e3 * tracked.record["seconds"]["track"] / sequence.num_frames
    found = tracked.trajectories.num_drones
    return {key: errors[key] for key in KEPT} | {"drones_found": found, "track_ms_per_frame": ms}


def table(rows: Iterable[Callable[[], dict[str, Any]]], path: Path) -> pd.DataFrame:
    """One row per run, written after each, so that a study that was interrupted leaves what it has.

    Beside it, with the suffix .json, is what the results depend on: versions and the machine.
    """
    done: list[dict[str, Any]] = []
    path.parent.mkdir(parents=True, exist_ok=True)
    path.with_suffix(".json").write_text(json.dumps(environment(), indent=2) + "\n")
    for row in rows:
        done.append(row())
        print(
            " ".join(
                f"{value:.4f}" if isinstance(value, float) else f"{value}" for value in done[-1].values()
            ),
            flush=True,
        )
        pd.DataFrame(done).to_csv(path, index=False, float_format="%.6g")
    return pd.DataFrame(done)
