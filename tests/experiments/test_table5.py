"""The script that makes the paper's Table 5, on one very small sequence: its files, and no repeated work."""

import subprocess
import sys
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

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_sweeps.small_sequence(tmp_path_factory)


def table5(data: Path, out: Path, grid: str = GRID) -> subprocess.CompletedProcess[str]:
    out.parent.mkdir(parents=True, exist_ok=True)
    (out.parent / "grid.toml").write_text(grid)
    words = [
        EXPERIMENTS / "table5" / "table5.py",
        "--grid",
        out.parent / "grid.toml",
        "--data",
        data,
        "--out",
        out,
    ]
    return subprocess.run(
        [sys.executable, *map(str, words)],
        capture_output=True,
        text=True,
        env=small_sweeps.environment(data),
        check=False,
    )


def test_table_rows_and_figures_are_made_once(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "table5"
    done = table5(data, out)
    assert done.returncode == 0, done.stderr
    assert "S01_D2_A: 86 to 140 mm" in done.stdout
    rows = pd.read_csv(out / "results.csv")
    assert len(rows) == 8
    assert set(rows["method"]) == {"paper", "psotrack"}
    assert (rows["track_ms_per_frame"] > 0).all()
    table = (out / "table5.md").read_text()
    mean_mm = 1e3 * rows.groupby(["method", "settings.swarm.iterations"])["mean_error_m"].mean()
    for mean in mean_mm:
        assert f"{mean:.1f} ±" in table
    drawn = cv2.imread(str(out / "error_against_work.png"))[..., ::-1]
    for colour in COLOURS[:2]:
        assert (drawn == colour_rgb(colour)).all(axis=-1).sum() > 20, "of two methods"
    before = small_sweeps.stamps(out)
    again = table5(data, out)
    assert again.returncode == 0, again.stderr
    assert small_sweeps.stamps(out) == before


def test_without_the_sequence(data: Path, tmp_path: Path) -> None:
    done = table5(data, tmp_path / "out", GRID.replace("S01_D2_A", "S02_D4_A"))
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert "expected the sequence S02_D4_A, found none" in line
    assert not (tmp_path / "out" / "table5.md").exists()
