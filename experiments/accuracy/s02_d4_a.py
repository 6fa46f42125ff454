"""The accuracy that the README states: simulated S02_D4_A, full size, 250 frames, silhouettes from the videos.

    python experiments/accuracy/s02_d4_a.py --data data --out experiments/accuracy/results

Simulates the sequence into --data if it is not there, tracks it with three seeds of the swarm for each method, each by
the very command that it prints, and writes one row per run (CSV), with the machine's description beside it (JSON).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import pandas as pd

from psotrack.pipeline import environment

NAME = "S02_D4_A"
METHODS = {
    "joint 100 x 70": ["--swarm", "joint", "--particles", "100", "--iterations", "70"],
    "joint 100 x 70, the paper's hard one-box score": [
        *("--swarm", "joint", "--particles", "100", "--iterations", "70", "--score", "hard")
    ],
    "per drone 30 x 30 (the defaults)": [],
}
KEPT = ["mean_error_m", "median_error_m", "p95_error_m", "max_error_m", "offset_removed_mean_error_m"]
KEPT += ["missed_rate", "id_switches", "mota", "idf1"]


def psotrack(*words: str) -> str:
    """Run the command line as a user would; show the command and return what it printed."""
    print("$ psotrack", *words, flush=True)
    return subprocess.run(
        [sys.executable, "-m", "psotrack", *words], check=True, stdout=subprocess.PIPE, text=True
    ).stdout


def main() -> None:
    """Simulate, track, evaluate, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("data"), help="the data's root folder")
    parser.add_argument(
        "--out", type=Path, default=Path("experiments/accuracy/results"), help="folder of results"
    )
    parser.add_argument("--data-seed", type=int, default=0, help="of the simulated flights")
    parser.add_argument("--seeds", type=int, default=3, help="seeds of the swarm: 0, 1, ...")
    options = parser.parse_args()

    sequence = options.data / f"seed{options.data_seed}" / "Simulated_Data" / NAME
    if not sequence.exists():
        root = str(sequence.parents[1])
        psotrack("simulate", NAME, "--out", root, "--seed", str(options.data_seed))
    work = options.data / "tracks"
    rows = []
    for method, flags in METHODS.items():
        for seed in range(options.seeds):
            tracks = str(work / f"{NAME}-{len(rows)}.csv")
            psotrack("track", str(sequence), "--out", tracks, "--seed", str(seed), *flags, "--force")
            errors = json.loads(psotrack("evaluate", tracks, str(sequence), "--json", "-"))
            seconds = json.loads(Path(tracks).with_suffix(".json").read_text())["seconds"]
            rows.append(
                {"sequence": NAME, "data_seed": options.data_seed, "method": method, "seed": seed}
                | {key: errors[key] for key in KEPT}
                | {"track_ms_per_frame": 1e3 * seconds["track"] / 250}
            )
    table = pd.DataFrame(rows)
    options.out.mkdir(parents=True, exist_ok=True)
    stem = f"{NAME.lower()}_seed{options.data_seed}"
    table.to_csv(options.out / f"{stem}.csv", index=False, float_format="%.6g")
    (options.out / f"{stem}.json").write_text(json.dumps(environment(), indent=2) + "\n")
    numbers = table.drop(columns=["sequence", "data_seed", "seed"])
    print(numbers.groupby("method", sort=False).mean().T.to_string(float_format="{:.4f}".format))


if __name__ == "__main__":
    main()
