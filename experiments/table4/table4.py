"""The paper's Table 4, triangulation based on projection lines, beside the swarm: mean and median error, and FNR.

    python experiments/table4/table4.py            # S01_D2_A, S02_D4_A and S04_D10, simulated into data/ if missing
    python experiments/table4/table4.py --data FOLDER_OF_THE_DATASET    # every sequence in it that has a reference
    python experiments/table4/table4.py --detector trained   # also detections by a network that is trained first

FNR is the share of frames and drones that were missed. --detector adds projection lines and both fused on the
detections of a network: `trained` is trained first, on simulated sequences that are not in the table, in a quarter of
an hour; `network` comes with the package; else a file (see `psotrack detect --detector`).

Writes the tables, table4.md, and the files of `psotrack sweep` to --out. Finished cells in --out are not run again.
With --results, rows and record become the headline figure.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tomllib
from pathlib import Path

import pandas as pd

from psotrack.errors import PsotrackError
from psotrack.recordings.datasets import CALIBRATION
from psotrack.settings import TrackSettings
from psotrack.simulation import SimulationSettings, simulate
from psotrack.support import progress_bar
from psotrack.sweeps import grid, pivot, render_table, sweep

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results
from _sequences import simulated_root

HERE = Path(__file__).parent
SIMULATED = ("S01_D2_A", "S02_D4_A", "S04_D10")
#: Sequences on which `--detector trained` is trained; the last one validates.
TRAINING = ("S03_D10_A", "S06_D6", "S11_D4", "S07_D8")
TRAINING_FRAMES = 100
EPOCHS, STEPS = 8, 200
#: Title -> column, its factor, and decimals.
TABLES = {
    "Mean error (mm)": ("mean_error_m", 1e3, 1),
    "Median error (mm)": ("median_error_m", 1e3, 1),
    "Mean error, each drone's constant offset taken out (mm)": ("offset_removed_mean_error_m", 1e3, 1),
    "FNR": ("missed_rate", 1.0, 4),
    "Identity switches": ("id_switches", 1.0, 0),
    "MOTA": ("mota", 1.0, 3),
    "Time of the track stage per frame (ms)": ("track_ms_per_frame", 1.0, 1),
}
KEPT = [
    "sequence",
    "method",
    "frames",
    "drones",
    "mean_error_m",
    "median_error_m",
    "p95_error_m",
    "max_error_m",
]
KEPT += ["offset_removed_mean_error_m", "missed_rate", "id_switches", "mota", "idf1", "hota"]
KEPT += ["offset_removed_inside_90_rate", "track_ms_per_frame", "commit"]


def main() -> None:
    """Simulate the sequences that are missing, track, and show the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--data", type=Path, help="root folder of the sequences [default: simulated into data/]"
    )
    parser.add_argument(
        "--methods",
        type=Path,
        default=HERE / "methods.toml",
        help="[default: methods.toml, beside this file]",
    )
    parser.add_argument("--out", type=Path, default=Path("table4"))
    parser.add_argument("--detector", metavar="trained|network|FILE", help="also by a network's detections")
    parser.add_argument("--results", type=Path, help="write rows and record into this folder")
    options = parser.parse_args()
    run = _results.Run("table4")
    try:
        data = options.data or simulated_root(SIMULATED, Path("data"))
        methods = tomllib.loads(options.methods.read_text())
        rows = tracked({**methods, "sequences": at_hand(data)}, options.out, data)
        if options.detector:
            more = detected(methods, options.detector, options.out, data)
            errors = [*rows.attrs["errors"], *more.attrs["errors"]]
            rows = pd.concat([rows, more], ignore_index=True)
            rows.attrs["errors"] = errors
        show(rows, options.out)
        if options.results:
            run.save(options.results, rows=rows[[name for name in KEPT if name in rows]])
    except PsotrackError as error:
        sys.exit(f"table4: {error}")
    if rows.attrs["errors"]:
        sys.exit("\n".join(f"table4: {error}" for error in rows.attrs["errors"]))


def at_hand(data: Path) -> list[str]:
    """The names of all sequences below a folder."""
    found = sorted(path.parent.name for path in data.glob(f"*/*/{CALIBRATION}"))
    if not found:
        sys.exit(f"table4: {data}: expected sequences in Simulated_Data or Real_Data, found none")
    return found


def detected(methods: dict, detector: str, out: Path, data: Path) -> pd.DataFrame:
    """The rows of methods that read detections, by those of a network instead of those that came with the sequences."""
    model = str(trained(out)) if detector == "trained" else detector
    root = out / "detected" / Path(detector).stem
    for sequence in sorted(path.parent for path in data.glob(f"*/*/{CALIBRATION}")):
        folder = root / sequence.parent.name / sequence.name
        folder.mkdir(parents=True, exist_ok=True)
        for path in sequence.iterdir():
            link = folder / path.name
            if path.name != "dl_data" and not link.is_symlink():
                link.symlink_to(path.resolve())
        if not (folder / "dl_data").exists():
            psotrack("detect", str(sequence), "--detector", model, "--out", str(folder / "dl_data"))
    reading = {name: each for name, each in methods["methods"].items() if reads_detections(each)}
    cells = {**methods, "methods": reading, "sequences": at_hand(root)}
    rows = tracked(cells, out / "detected" / "runs" / Path(detector).stem, root)
    rows["method"] += f" by {Path(detector).stem}"
    return rows


def reads_detections(method: dict) -> bool:
    """Whether a method reads the detections that came with a sequence."""
    return TrackSettings().changed(method).reads_detections


def trained(out: Path) -> Path:
    """The file of a network that is trained on sequences that are not in the table."""
    model, root = out / "trained.model", out / "training"
    settings = SimulationSettings(num_frames=TRAINING_FRAMES, scale=0.5, onboard=False)
    for name in TRAINING:
        if not (root / "Simulated_Data" / name).exists():
            simulate(name, root, settings, report=progress_bar)
    if not model.exists():
        folders = [str(root / "Simulated_Data" / name) for name in TRAINING]
        psotrack("train", *folders, "--out", str(model), "--epochs", f"{EPOCHS}", "--steps", f"{STEPS}")
    return model


def psotrack(*words: str) -> None:
    """Run a command of psotrack; an error ends this program."""
    print("$ psotrack", *words, flush=True)
    subprocess.run([sys.executable, "-m", "psotrack", *words], check=True)


def tracked(cells: dict, out: Path, data: Path) -> pd.DataFrame:
    """One row per sequence and method; cells that are finished in `out` are not run again."""
    from psotrack.support import keep_compiled

    keep_compiled(out / "cache" / "compiled")
    return sweep(grid(cells), out, data=data, cache=out / "cache", progress=True).rows()


def show(rows: pd.DataFrame, out: Path) -> None:
    """Print and write the tables."""
    parts = []
    for title, (value, scale, decimals) in TABLES.items():
        table = pivot(rows, rows_by=["sequence"], columns_by=["method"], value=value, scale=scale)
        parts.append(f"## {title}\n\n{render_table(table, 'markdown', decimals=decimals)}")
        print(f"{title}\n{render_table(table, decimals=decimals)}")
    (out / "table4.md").write_text("\n".join(parts))


if __name__ == "__main__":
    main()
