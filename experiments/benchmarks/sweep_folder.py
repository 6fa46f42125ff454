"""Seconds that a sweep's folder of many cells takes: `psotrack sweep --status`, one more cell, and all rows.

python experiments/benchmarks/sweep_folder.py --cells 10000
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pandas as pd

from psotrack.sweep import Store


def main() -> None:
    """Make a folder of cells without tracking, and print the seconds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=10_000)
    cells = parser.parse_args().cells
    with tempfile.TemporaryDirectory() as name:
        store = Store(Path(name) / "results")
        (store.folder / "cells").mkdir(parents=True)
        first_s = _add(store, 0, 100)
        _add(store, 100, cells - 100)
        last_s = _add(store, cells, 100)
        began = time.perf_counter()
        subprocess.run(
            [sys.executable, "-m", "psotrack", "sweep", "--status", store.folder, "--quiet"], check=True
        )
        status_s = time.perf_counter() - began
        began = time.perf_counter()
        assert len(store.rows()) == cells + 100
        rows_s = time.perf_counter() - began
        print(
            f"{cells} cells: one of the first 100 {1e3 * first_s / 100:.1f} ms, one more {1e3 * last_s / 100:.1f} ms"
        )
        print(f"--status {status_s:.2f} s, all rows {rows_s:.2f} s")


def _add(store: Store, start: int, count: int) -> float:
    """Add cells with one run each; the seconds that this takes."""
    began = time.perf_counter()
    for number in range(start, start + count):
        key = f"{number:040x}"
        errors = pd.DataFrame({"seed": [0] * 5, "frame": range(5), "error_m": [0.01] * 5})
        with store.lock(key, "a cell"):
            store.add(key, pd.DataFrame({"seed": [0], "mean_error_m": [0.01], "cell": [key]}), errors)
    return time.perf_counter() - began


if __name__ == "__main__":
    main()
