"""Accuracy of a camera's pose from twelve hand-marked points, about five metres away, by Monte Carlo simulation.

    python experiments/calibration/extrinsics.py

Marks have a standard deviation of 1 px. Points are spread over the image, and in depth over the range of each row of
the table. "In 90 %" is the share of true centres inside
the 90 % ellipsoid of the covariance that `locate_camera` states. Writes OUT/extrinsics.csv.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.stats import chi2

from psotrack.calibration import locate_camera
from psotrack.geometry import Camera, look_at, make_camera, project

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results

HERE = Path(__file__).parent
K = np.array([[1157.0, 0.0, 959.5], [0.0, 1157.0, 539.5], [0.0, 0.0, 1.0]])
SIZE_WH = (1920, 1080)
AWAY_M, NOISE_PX = 5.0, 1.0
#: Range of depths in words -> depths of the nearest and the farthest possible point along the optical axis, metres.
DEPTHS_M = {"2.5 to 7.5 m": (2.5, 7.5), "3.5 to 6.5 m": (3.5, 6.5), "4.5 to 5.5 m": (4.5, 5.5)}
#: Columns and rows of cells of the image; each cell has one point.
COLUMNS, ROWS = 4, 3


def main() -> None:
    """Draw points, locate the camera, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=500, help="number of cameras for each row")
    parser.add_argument("--out", type=Path, default=HERE / "results", help="folder of the table")
    options = parser.parse_args()
    run = _results.Run("extrinsics")
    rows = [summary(words, range_m, options.draws) for words, range_m in DEPTHS_M.items()]
    table = pd.DataFrame(rows)
    print(table.to_string(index=False))
    run.save(options.out, rows=table)


def summary(words: str, range_m: tuple[float, float], draws: int) -> dict[str, object]:
    """Row of the table: errors of the camera's centre over random points and noise."""
    off_m, inside = [], []
    for one, points_m, points_px in scenes(range_m, draws):
        located = locate_camera(points_m, points_px, one, NOISE_PX)
        T = located.T_cam_world
        off = -T[:3, :3].T @ T[:3, 3] - one.centre_world
        off_m.append(np.linalg.norm(off))
        inside.append(off @ np.linalg.solve(located.centre_covariance_m2, off) < chi2.ppf(0.9, 3))
    off_mm = 1e3 * np.array(off_m)
    return {
        "depth of points": words,
        "median (mm)": round(float(np.median(off_mm)), 1),
        "95th percentile (mm)": round(float(np.percentile(off_mm, 95)), 1),
        "below 10 mm": round(float((off_mm < 10).mean()), 2),
        "in 90 %": round(float(np.mean(inside)), 2),
    }


def scenes(
    range_m: tuple[float, float], draws: int
) -> Iterator[tuple[Camera, Float[np.ndarray, "points 3"], Float[np.ndarray, "points 2"]]]:
    """Draw cameras that look at the middle of a room, with points and the marked pixels of the points."""
    rng = np.random.default_rng(0)
    cell_px = np.array(SIZE_WH) / [COLUMNS, ROWS]
    cells = np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)), axis=-1).reshape(-1, 2)
    for _ in range(draws):
        around = rng.uniform(0, 2 * np.pi)
        centre_m = (AWAY_M * np.cos(around), AWAY_M * np.sin(around), 2.0)
        R, t_m = look_at(centre_m, (0.0, 0.0, 1.0))
        one = make_camera(R=R, t_m=t_m, K=K, image_size_wh=SIZE_WH)
        pixels = (cells + rng.uniform(0.1, 0.9, cells.shape)) * cell_px
        rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(K).T
        points_m = (rays * rng.uniform(*range_m, (len(rays), 1)) - t_m) @ R
        yield one, points_m, project(one, points_m)[0] + rng.normal(0, NOISE_PX, pixels.shape)


if __name__ == "__main__":
    main()
