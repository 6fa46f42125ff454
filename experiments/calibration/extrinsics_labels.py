"""Poses of cameras from labels whose errors last from point to point, beside `solvePnPRansac` and LM of OpenCV.

    python experiments/calibration/extrinsics_labels.py [--quick]

A drone of known path is labelled in every frame. A label's error is white noise of 1 px and an error that lasts over
neighbouring labels, an AR(1) process, of 0, 1.5 or 3 px; some labels are on something else. Each camera is located by
`locate_camera` and by OpenCV, and both are measured on another path, without errors of labels: the table has the median
error of each, and the largest ratio of the two over all cameras and draws where OpenCV's error is above a tenth of a
pixel. Writes OUT/extrinsics_labels.csv.
"""

from __future__ import annotations

import argparse
import sys
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from psotrack.calibration import locate_camera
from psotrack.geometry import look_at, make_camera, project

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results

HERE = Path(__file__).parent
K = np.array([[1157.0, 0.0, 959.5], [0.0, 1157.0, 539.5], [0.0, 0.0, 1.0]])
DIST = np.array([-0.1, 0.03, 0.0005, -0.0005, 0.0])
SIZE_WH = (1920, 1080)
#: Correlation of the lasting error of a label with that of the label before.
LASTING = 0.95


def main() -> None:
    """Locate cameras in all settings, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=40, help="number of cameras for each row")
    parser.add_argument("--quick", action="store_true", help="few cameras")
    parser.add_argument("--out", type=Path, default=HERE / "results", help="folder of the table")
    options = parser.parse_args()
    run = _results.Run("extrinsics_labels")
    rows = []
    for labels, lasting_px, false in product((12, 60, 300), (0.0, 1.5, 3.0), (0.0, 0.1)):
        rows.append(summary(labels, lasting_px, false, 5 if options.quick else options.draws))
        print(rows[-1], flush=True)
    table = pd.DataFrame(rows)
    print(table.to_string(index=False))
    run.save(options.out, rows=table)


def summary(labels: int, lasting_px: float, false: float, draws: int) -> dict[str, object]:
    """Row of the table."""
    ours, theirs = np.array([one_camera(labels, lasting_px, false, seed) for seed in range(draws)]).T
    # A draw in which both are exact to a tenth of a pixel has no ratio.
    ratio = ours / np.maximum(theirs, 0.1)
    return {
        "labels": labels,
        "lasting error (px)": lasting_px,
        "false labels": false,
        "psotrack (px)": round(float(np.median(ours)), 3),
        "RANSAC and LM (px)": round(float(np.median(theirs)), 3),
        "mean ratio": round(float(np.exp(np.mean(np.log(ratio)))), 3),
        "largest ratio": round(float(ratio.max()), 3),
    }


def one_camera(labels: int, lasting_px: float, false: float, seed: int) -> tuple[float, float]:
    """Errors on points left out, pixels, of `locate_camera` and of OpenCV."""
    rng = np.random.default_rng(seed)
    around = rng.uniform(0, 2 * np.pi)
    R, t_m = look_at((5 * np.cos(around), 5 * np.sin(around), rng.uniform(1, 3)), (0.0, 0.0, 1.0))
    camera = make_camera(R=R, t_m=t_m, K=K, dist=DIST, image_size_wh=SIZE_WH)
    points_m, others_m = path(rng, labels), path(rng, 300)
    pixels = project(camera, points_m)[0] + rng.normal(0, 1.0, (labels, 2))
    error = rng.normal(0, 1, 2)
    for index in range(labels):
        pixels[index] += lasting_px * error
        error = LASTING * error + np.sqrt(1 - LASTING**2) * rng.normal(0, 1, 2)
    wrong = rng.random(labels) < false
    pixels[wrong] += rng.normal(0, 100, (int(wrong.sum()), 2))
    truth = project(camera, others_m)[0]
    located = locate_camera(points_m, pixels, K, DIST)
    _, turn, shift, inliers = cv2.solvePnPRansac(points_m, pixels, K, DIST)
    inliers = np.ravel(inliers)
    turn, shift = cv2.solvePnPRefineLM(points_m[inliers], pixels[inliers], K, DIST, turn, shift)
    poses = (
        (located.T_cam_world[:3, :3], located.T_cam_world[:3, 3]),
        (cv2.Rodrigues(turn)[0], np.ravel(shift)),
    )
    errors = []
    for R, t_m in poses:
        seen = project(make_camera(R=R, t_m=t_m, K=K, dist=DIST, image_size_wh=SIZE_WH), others_m)[0]
        errors.append(float(np.sqrt(np.mean(np.sum((seen - truth) ** 2, axis=-1)))))
    return errors[0], errors[1]


def path(rng: np.random.Generator, count: int) -> np.ndarray:
    """Positions along a flight through the room, metres."""
    t = np.linspace(0, 20, count)[:, None] * rng.uniform(0.5, 1.0, 3) + rng.uniform(0, 2 * np.pi, 3)
    return np.array([1.5, 1.5, 0.8]) * np.sin(t) + np.array([0.0, 0.0, 1.2])


if __name__ == "__main__":
    main()
