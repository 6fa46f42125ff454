"""The program that makes Tables 6 to 8, on a short simulated sequence."""

from pathlib import Path

import cv2
import pandas as pd
import pytest
from helpers import made_once

from psotrack.simulation import SimulationSettings, change_scenario, scenario, simulate

EXPERIMENT = Path(__file__).parents[2] / "experiments" / "table7"
METHODS = ("paper", "single frames", "filter", "smoother")
FPS, NUM_FRAMES = 25.0, 60


def make_data(root):
    """A data folder with one sequence of two drones, whose own videos have half the usual size."""
    corner = {"position_m": (2.9, 2.1, 2.5), "target_m": (0.0, 0.0, 1.0)}
    recipe = change_scenario(scenario("S01_D2_A"), {"cameras": [corner], "image_size_wh": [160, 160]})
    simulate(recipe, root, SimulationSettings(NUM_FRAMES, 0.5, masks=False), jobs=1)


data = made_once("table7", make_data)


@pytest.mark.nightly
def test_tables_rows_and_a_second_run(run_program, data, tmp_path):
    run_program(EXPERIMENT / "table7.py", "--data", data, "--out", tmp_path).ended()
    every = pd.read_csv(tmp_path / "results.csv")
    assert set(every["drone"]) == {"dron1", "dron2", "all"}
    rows = every[every["drone"] == "dron1"].set_index(["wrong", "method"])
    assert list(rows.index) == [(wrong, method) for wrong in (0.0, 0.02) for method in METHODS]
    clean, wrong = rows.loc[0.0], rows.loc[0.02]
    # The accuracy at full size is 5 mm; at half the size, pixels are twice as large.
    assert (clean["position_median_m"] < 0.02).all()
    assert (clean["orientation_median_deg"] < 0.5).all()
    assert (rows["posed_rate"] >= 0.9).all()
    # The paper's method does not leave out a marker with a wrong id, and has no covariances.
    assert wrong["position_max_m"]["paper"] > 3 * wrong["position_max_m"]["filter"]
    assert rows["inside_90_rate"].isna().tolist() == [method == "paper" for _, method in rows.index]
    # Clocks with offsets of seconds are found to a tenth of a frame.
    assert (rows["offset_s"].abs() > 0.1).all()
    for name in ("offset_s_off_frames", "orientation_offset_s_off_frames"):
        assert (rows[name].abs() < 0.1).all()
    table = (tmp_path / "table7.md").read_text()
    (pooled_m,) = every.query("drone == 'all' and wrong == 0.02 and method == 'paper'")["distance_m.mean"]
    assert f"| {1e3 * pooled_m:.2f} |" in table
    described = pd.read_csv(tmp_path / "table6.csv").set_index("drone").loc["dron1"]
    assert (described["frames"], described["length (s)"]) == (NUM_FRAMES, NUM_FRAMES / FPS)
    for picture in ("paths_S01_D2_A_dron1", "errors_S01_D2_A_dron1_2_percent_wrong"):
        assert cv2.imread(str(tmp_path / f"{picture}.png")) is not None
    # Markers are not detected again, and a sequence that cannot be used does not stop the others.
    kept = tmp_path / "detections" / "S01_D2_A_dron1.npz"
    before = kept.stat().st_mtime_ns
    assert run_program(EXPERIMENT / "table7.py", "--data", data, "--out", tmp_path).code == 0
    assert kept.stat().st_mtime_ns == before
