"""The benchmark from videos to tracks, in small: it measures and writes its table and record."""

import json
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
import small_sweeps

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_from_videos_to_tracks(tmp_path_factory: pytest.TempPathFactory, tmp_path: Path) -> None:
    data = small_sweeps.small_sequence(tmp_path_factory)
    words = ["--sequence", data / "Simulated_Data" / "S01_D2_A", "--repeats", 1, "--results", tmp_path]
    command = [sys.executable, ROOT / "experiments" / "benchmarks" / "benchmark.py", "videos", *words]
    environment = small_sweeps.environment(data) | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(map(str, command), capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    (row,) = pd.read_csv(tmp_path / "end_to_end.csv").to_dict("records")
    # Six frames at a small size do not show both drones.
    assert (row["drones"] >= 1, row["cameras"], row["video_s"]) == (True, 8, 0.24)
    assert 0 < row["real_time_factor"] < row["real_time_factor_running"]
    assert row["decode_s"] > 0
    assert row["track_s"] > 0
    record = json.loads((tmp_path / "end_to_end.json").read_text())
    assert record["result"] == "end_to_end"
    assert record["figures"]["processors"] >= 1
