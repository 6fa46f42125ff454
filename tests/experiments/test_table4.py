"""The script that makes the paper's Table 4, on one very small sequence, with two methods."""

import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
import small_sweeps

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
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


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_sweeps.small_sequence(tmp_path_factory)


def table4(data: Path, out: Path) -> subprocess.CompletedProcess[str]:
    methods = out.with_suffix(".toml")
    methods.write_text(METHODS)
    words = [EXPERIMENTS / "table4" / "table4.py", "--methods", methods, "--data", data, "--out", out]
    return subprocess.run(
        [sys.executable, *map(str, words)],
        capture_output=True,
        text=True,
        env=small_sweeps.environment(data),
        check=False,
    )


def test_every_sequence_by_every_method(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "table4"
    done = table4(data, out)
    assert done.returncode == 0, done.stderr
    rows = pd.read_csv(out / "results.csv").set_index("method")
    assert list(rows["sequence"]) == ["S01_D2_A"] * 2
    # Both methods begin at the true positions; the images have a quarter of the pixels.
    assert (rows["mean_error_m"] < 0.1).all()
    assert (rows["id_switches"] == 0).all()
    table = (out / "table4.md").read_text()
    for method in ("lines", "lines-blobs"):
        assert f"{1e3 * rows['mean_error_m'][method]:.1f}" in table
    assert "## FNR" in table


def test_after_a_change_of_detections_only_methods_that_use_them_run_again(
    data: Path, tmp_path: Path
) -> None:
    """The method with detections runs again; the method with blobs does not use detections, and does not run again."""
    copied = tmp_path / "copied"
    shutil.copytree(data / "Simulated_Data", copied / "Simulated_Data")
    (copied / "cache").symlink_to(data / "cache")
    out = tmp_path / "table4"
    assert table4(copied, out).returncode == 0
    before = small_sweeps.stamps(out)
    detections = next((copied / "Simulated_Data" / "S01_D2_A" / "dl_data").glob("cam1*.csv"))
    detections.write_text(detections.read_text().split("\n", 1)[1])
    done = table4(copied, out)
    assert done.returncode == 0, done.stderr
    after = small_sweeps.stamps(out)
    assert len(after) == 3
    assert before.items() <= after.items()


def test_a_folder_without_sequences(tmp_path: Path) -> None:
    words = [EXPERIMENTS / "table4" / "table4.py", "--data", tmp_path, "--out", tmp_path / "out"]
    done = subprocess.run([sys.executable, *map(str, words)], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert (
        done.stderr.strip()
        == f"table4: {tmp_path}: expected sequences in Simulated_Data or Real_Data, found none"
    )
