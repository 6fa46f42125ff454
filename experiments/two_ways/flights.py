"""Outside-in, inside-out and fused tracks of six simulated flights: errors, and how often fusion is at least as good.

    python experiments/two_ways/flights.py --data data

Simulates S01_D2_A and S02_D4_A with three seeds each, with the drones' own cameras, unless they exist. Tracks and
localises with commands that are printed, fuses, and compares. Existing files are not made
again, so delete DATA/two_ways after a change of the code. Writes one row per drone and range of 50 frames.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
from _comparison import METHODS, compare_drones, ranges

from psotrack.recordings.datasets import read_sequence

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results
from _sequences import simulated

NAMES, SEEDS, RANGE_FRAMES = ("S01_D2_A", "S02_D4_A"), (0, 1, 2), 50


def main() -> None:
    """Simulate, track, localise, fuse, and save."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("data"), help="root folder of the data")
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "results", help="folder of the result"
    )
    options = parser.parse_args()
    run = _results.Run("two_ways")
    flights = [flight(name, seed, options.data) for seed in SEEDS for name in NAMES]
    rows = pd.concat([rows for rows, _ in flights])
    drones = pd.DataFrame([drone for _, drones in flights for drone in drones])
    figures: dict[str, object] = {
        "drones": len(drones),
        "ranges": len(rows),
        "no_worse": int((rows["ratio"] <= 1).sum()),
        "mean_ratio": float(rows["ratio"].mean()),
        "worst_ratio": float(rows["ratio"].max()),
    }
    for method in METHODS:
        for statistic in ("median", "mean", "p99"):
            column = drones[f"{method}_{statistic}_m"]
            figures[f"{method}_{statistic}_m"] = {"min": float(column.min()), "max": float(column.max())}
    print(drones.to_string(index=False))
    run.save(options.out, rows=rows, figures=figures)


def flight(name: str, seed: int, data: Path) -> tuple[pd.DataFrame, list[dict[str, object]]]:
    """Rows per range of frames, and errors per drone, of one flight."""
    folder = simulated(name, data, seed, onboard=True)
    work = data / "two_ways" / f"{name}-{seed}"
    work.mkdir(parents=True, exist_ok=True)
    tracks = work / "tracks.csv"
    psotrack("track", folder, "--out", tracks, "--cache", data / "silhouettes", "--seed", seed)
    reference = read_sequence(folder).truth
    assert reference is not None, "the simulator writes a reference"
    paths = [work / f"{drone}.csv" for drone in reference.drones]
    for drone, path in zip(reference.drones, paths, strict=True):
        psotrack("onboard", "localise", folder, "--drone", drone, "--no-filter", "--out", path)
    compared = compare_drones(folder, paths, tracks)
    labels = {"sequence": name, "seed": seed}
    rows = pd.concat([ranges(one, RANGE_FRAMES).assign(**labels) for one in compared])
    errors = [labels | {"drone": one.drone} | statistics(one.error_m) for one in compared]
    return rows, errors


def statistics(error_m: dict[str, np.ndarray]) -> dict[str, object]:
    """Median, mean and 99th percentile of each method's error, metres."""
    found: dict[str, object] = {}
    for method, values in error_m.items():
        found[f"{method}_median_m"] = float(np.median(values))
        found[f"{method}_mean_m"] = float(values.mean())
        found[f"{method}_p99_m"] = float(np.quantile(values, 0.99))
    return found


def psotrack(command: str, *words: object) -> None:
    """Run one command of psotrack, unless the file of its --out exists."""
    out = Path(str(words[words.index("--out") + 1]))
    if out.exists():
        return
    print("$ psotrack", command, *words, flush=True)
    subprocess.run([sys.executable, "-m", "psotrack", command, *map(str, words), "--quiet"], check=True)


if __name__ == "__main__":
    main()
