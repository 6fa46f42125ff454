"""Tracking of a calm flight and of the same flight in restless surroundings, with the defaults or another background.

    python experiments/accuracy/restless.py --data data
    python experiments/accuracy/restless.py --data data --seeds 1 2 --kinds calm restless --background mog2 living

Simulates each flight (8 cameras at half size, 4 drones, 200 frames) if it is missing, once without and once with
`psotrack simulate --restless`; the kinds lamp, exposure, screen, foliage and person have one change alone.
Each run is `psotrack track` in a process of its own, twice: the first run compiles, the second is measured, with its
silhouettes computed anew. Writes a row per run (CSV) and the record (JSON), and prints the table, where `time_ratio`
and `error_ratio` compare with the calm flight of the same seed and background.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from _runs import parser, save_rows, start

from psotrack.evaluation import evaluate
from psotrack.recordings.datasets import open_recording
from psotrack.simulation import RESTLESS, SimulationSettings, change_scenario, scenario, simulate
from psotrack.support import progress_bar
from psotrack.trajectories import Status, Trajectories, read_trajectories

SEQUENCE = "S02_D4_A"
#: The flights' frames, and the scale of the images.
FRAMES, SCALE = 200, 0.5
#: Changes of the scenario by the name of the kind.
KINDS: Mapping[str, Mapping[str, Any]] = {
    "calm": {},
    "restless": RESTLESS,
    **{
        part: {field: value for field, value in RESTLESS.items() if part in field}
        for part in ("exposure", "lamp", "screen", "foliage")
    },
    "person": {"surroundings.person": 0.5},
}
#: Largest distance of a track from its drone, metres; a track that is farther from every drone is false.
GATE_M = 0.5


def made(data: Path, kind: str, seed: int) -> Path:
    """The folder of a flight, which is simulated if it is missing."""
    recipe = change_scenario(scenario(SEQUENCE), KINDS[kind])
    root = data / "restless" / f"{kind}{seed}"
    folder = root / "Simulated_Data" / recipe.name
    if not folder.exists():
        print(f"simulating {folder}", flush=True)
        settings = SimulationSettings(num_frames=FRAMES, scale=SCALE, seed=seed, masks=False, onboard=False)
        simulate(recipe, root, settings, report=progress_bar)
    return folder


def row(data: Path, kind: str, seed: int, background: str) -> dict[str, Any]:
    """Track one flight; its errors, its time and its memory."""
    sequence = made(data, kind, seed)
    name = {"seed": seed, "surroundings": kind, "background": background}
    tracks = data / "restless" / f"{kind}{seed}_{background}.csv"
    for _ in range(2):
        cost = track(sequence, tracks, data / "restless" / "cache", background)
        if "note" in cost:
            return name | {"missed_rate": 1.0} | cost
    truth = open_recording(sequence).truth
    assert truth is not None
    found = read_trajectories(tracks)
    errors = evaluate(found, truth).to_dict()
    mean_m = errors["mean_error_m"]
    return {
        **name,
        "tracks": found.num_drones,
        "mean_error_mm": None if mean_m is None else 1e3 * mean_m,
        "missed_rate": errors["missed_rate"],
        "mota": errors["mota"],
        "hota": errors["hota"],
        "id_switches": errors["id_switches"],
        **false_tracks(found, truth),
        **cost,
    }


def track(sequence: Path, out: Path, cache: Path, background: str) -> dict[str, Any]:
    """Run `psotrack track` with its defaults; processor seconds, and memory of the largest of its processes."""
    for stored in cache.glob("*"):
        # Silhouettes are part of what is measured; compiled programs are not.
        if stored.name != "compiled":
            shutil.rmtree(stored)
    words = ["track", f"{sequence}", "--out", f"{out}", "--cache", f"{cache}", "--background", background]
    command = [sys.executable, "-m", "psotrack", *words, "--force", "--quiet"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    said = process.stderr.read()
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    # Linux states the largest resident memory in KiB, macOS in bytes.
    peak_mb = used.ru_maxrss / (1e6 if sys.platform == "darwin" else 1e6 / 1024)
    cost = {"processor_s": used.ru_utime + used.ru_stime, "peak_mb": peak_mb}
    return cost | {"note": said.strip().splitlines()[-1]} if process.returncode else cost


def false_tracks(found: Trajectories, truth: Trajectories, gate_m: float = GATE_M) -> dict[str, Any]:
    """Tracks that are mostly away from all drones, by the gate or more, and the time that tracks are away, seconds."""
    tracked = found.status == Status.TRACKED
    index = np.searchsorted(truth.frame, found.frame)
    seen = np.isin(found.frame, truth.frame)
    apart_m = found.position_m[seen][:, :, None] - truth.position_m[index[seen]][:, None]
    distance_m = np.nan_to_num(np.linalg.norm(apart_m, axis=-1), nan=np.inf).min(axis=-1)
    # The dataset's reference begins at frame 1: no distance is known before.
    false = (distance_m > gate_m) & np.isfinite(distance_m) & tracked[seen]
    mostly = false.sum(axis=0) > 0.5 * np.maximum(tracked[seen].sum(axis=0), 1)
    return {
        "false_tracks": int(mostly.sum()),
        "false_s": float(false.sum() * np.median(np.diff(found.time_s))),
    }


def with_ratios(table: pd.DataFrame) -> pd.DataFrame:
    """The table with the ratios to the calm flight of the same seed and background."""
    calm = table[table.surroundings == "calm"].set_index(["seed", "background"])
    if "mean_error_mm" not in table or calm.empty:
        return table
    of_calm = calm.reindex(pd.MultiIndex.from_frame(table[["seed", "background"]]))
    table["error_ratio"] = table["mean_error_mm"] / of_calm["mean_error_mm"].to_numpy()
    table["time_ratio"] = table["processor_s"] / of_calm["processor_s"].to_numpy()
    return table


def main() -> None:
    """Track all flights, write the result, and print the table."""
    options = parser(__doc__)
    options.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3], help="seeds of the flights")
    options.add_argument(
        "--kinds", nargs="+", choices=KINDS, default=["calm", "restless"], help="kinds of surroundings"
    )
    options.add_argument(
        "--background", nargs="+", default=["living"], metavar="NAME", help="names of background models"
    )
    chosen = options.parse_args()
    run = start("restless")
    rows = [
        (f"{kind} {seed} {name}", lambda kind=kind, seed=seed, name=name: row(chosen.data, kind, seed, name))
        for name in chosen.background
        for seed in chosen.seeds
        for kind in chosen.kinds
    ]
    table = with_ratios(save_rows(run, rows, chosen.data, chosen.out))
    print(table.to_string(index=False, float_format="{:.3f}".format, na_rep="-"))
    means = table.groupby(["background", "surroundings"], sort=False).mean(numeric_only=True)
    print(means.drop(columns="seed").to_string(float_format="{:.3f}".format, na_rep="-"))


if __name__ == "__main__":
    main()
