"""The programs that make the paper's Tables 4 and 5 and the benchmark, on one very small sequence."""

import json
from pathlib import Path

import cv2
import pandas as pd
import pytest
import small_sweeps

from psotrack.show.flights import colour_rgb
from psotrack.support import COLOURS

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
TWO_METHODS = "[methods.paper]\n[methods.psotrack]\nswarm.spread_m = 0.06\n[grid]"
GRID = small_sweeps.GRID.format(runs=2, iterations=[2, 3]).replace("[grid]", TWO_METHODS)
#: The sequence has six frames: too few for the background model "living".
METHODS = """
runs = 1
[settings]
init = "truth"
silhouettes.reduction = 2
silhouettes.background = "mog2"
[methods.lines]
method = "projection-lines"
[methods.lines-blobs]
method = "projection-lines"
detections = "blobs"
"""

pytestmark = pytest.mark.slow


data = small_sweeps.small_sequence


@pytest.fixture
def run(run_program, data, monkeypatch):
    """Runs a program of the experiments."""
    monkeypatch.setenv("PSOTRACK_CACHE", str(data / "cache"))
    return lambda script, *words: run_program(EXPERIMENTS / script, *words)


def test_table_4(run, data, tmp_path):
    methods, out = tmp_path / "methods.toml", tmp_path / "table4"
    methods.write_text(METHODS)
    words = ("--methods", methods, "--data", data, "--out", out, "--results", tmp_path)
    run("table4/table4.py", *words).ended()
    rows = pd.read_csv(tmp_path / "table4.csv").set_index("method")
    assert list(rows["sequence"]) == ["S01_D2_A"] * 2
    # Both methods begin at the true positions; the images have a quarter of the pixels.
    assert (rows["mean_error_m"] < 0.1).all()
    assert (rows["id_switches"] == 0).all()
    table = (out / "table4.md").read_text()
    for method in ("lines", "lines-blobs"):
        assert f"{1e3 * rows['mean_error_m'][method]:.1f}" in table
    assert "## FNR" in table
    assert json.loads((tmp_path / "table4.json").read_text())["figure"] == "table4"
    nothing = run("table4/table4.py", "--data", tmp_path / "none", "--out", out)
    expected = "expected sequences in Simulated_Data or Real_Data, found none"
    assert (nothing.code, nothing.err) == (1, f"table4: {tmp_path / 'none'}: {expected}\n")


def test_table_5_is_made_once(run, data, tmp_path):
    grid, out = tmp_path / "grid.toml", tmp_path / "table5"
    grid.write_text(GRID)
    words = ("--grid", grid, "--data", data, "--out", out, "--results", tmp_path)
    done = run("table5/table5.py", *words).ended()
    assert "S01_D2_A: 86 to 140 mm" in done.out
    rows = pd.read_csv(tmp_path / "table5.csv")
    assert (len(rows), set(rows["method"])) == (8, {"paper", "psotrack"})
    table = (out / "table5.md").read_text()
    for mean_m in rows.groupby(["method", "settings.swarm.iterations"])["mean_error_m"].mean():
        assert f"{1e3 * mean_m:.1f} ±" in table
    drawn = cv2.imread(str(out / "error_against_work.png"))[..., ::-1]
    for colour in COLOURS[:2]:
        assert (drawn == colour_rgb(colour)).all(axis=-1).sum() > 20, "of two methods"
    before = small_sweeps.stamps(out)
    assert run("table5/table5.py", *words).code == 0
    assert small_sweeps.stamps(out) == before


def test_from_videos_to_tracks(run, data, tmp_path):
    words = ("--sequence", data / "Simulated_Data" / "S01_D2_A", "--repeats", 1, "--results", tmp_path)
    run("benchmark.py", "videos", *words, "--backgrounds", "living").ended()
    (row,) = pd.read_csv(tmp_path / "speed.csv").to_dict("records")
    # Six frames at a small size do not show both drones.
    assert (row["drones"] >= 1, row["background"], row["video_s"]) == (True, "living", 0.24)
    assert min(row[key] for key in ("factor", "decode_s_of_processes", "track_s", "floor_s", "peak_mb")) > 0
