"""Poses of cameras from labels whose errors are correlated, beside `solvePnPRansac` and LM of OpenCV.

    python experiments/calibration/extrinsics_labels.py [--quick]

A drone of known path is labelled in every frame. A label's error is white noise of 1 px and a correlated error over
neighbouring labels, an AR(1) process, of 0, 1.5 or 3 px; some labels are on something else. Each camera is located by
`locate_camera`, by OpenCV, and by least squares of exactly the labels that are on the drone ("true labels"), which no
program knows. The poses are measured on another flight: on its labels, which have errors of the same kind ("left out"),
and on the drone itself ("exact"). A ratio is an error over that of OpenCV, which counts as a tenth of a pixel at least.
"refused" counts the draws in which `locate_camera` finds two poses that fit equally well; these have no ratio. The
95 % interval of the mean ratio is a bootstrap over the draws.
Writes OUT/extrinsics_labels.csv.
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
from psotrack.errors import InputError
from psotrack.geometry import look_at, make_camera, project

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results

HERE = Path(__file__).parent
K = np.array([[1157.0, 0.0, 959.5], [0.0, 1157.0, 539.5], [0.0, 0.0, 1.0]])
DIST = np.array([-0.1, 0.03, 0.0005, -0.0005, 0.0])
SIZE_WH = (1920, 1080)
#: Correlation of a label's correlated error with that of the label before.
CORRELATION = 0.95
METHODS = ("psotrack", "RANSAC and LM", "true labels")


def main() -> None:
    """Locate cameras in all settings, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=100, help="number of cameras for each row")
    parser.add_argument("--quick", action="store_true", help="few cameras")
    parser.add_argument("--out", type=Path, default=HERE / "results", help="folder of the table")
    options = parser.parse_args()
    run = _results.Run("extrinsics_labels")
    rows = []
    for labels, correlated_px, false in product((12, 60, 300), (0.0, 1.5, 3.0), (0.0, 0.1)):
        rows.append(summary(labels, correlated_px, false, 5 if options.quick else options.draws))
        print(rows[-1], flush=True)
    table = pd.DataFrame(rows)
    print(table.to_string(index=False))
    run.save(options.out, rows=table)


def summary(labels: int, correlated_px: float, false: float, draws: int) -> dict[str, object]:
    """Row of the table."""
    # (draws, methods, measures)
    found = [one_camera(labels, correlated_px, false, seed) for seed in range(draws)]
    errors_px = np.array([errors for errors in found if errors is not None])
    row: dict[str, object] = {"labels": labels, "correlated error (px)": correlated_px, "false labels": false}
    row["refused"] = draws - len(errors_px)
    for method, name in enumerate(METHODS):
        row[f"{name} (px)"] = round(float(np.median(errors_px[:, method, 1])), 3)
    ratio = errors_px / np.maximum(errors_px[:, METHODS.index("RANSAC and LM"), None], 0.1)
    for method in (METHODS.index("psotrack"), METHODS.index("true labels")):
        left_out, exact = ratio[:, method].T
        low, high = interval(np.log(exact))
        row |= {
            f"{METHODS[method]}: largest ratio, left out": round(float(left_out.max()), 3),
            f"{METHODS[method]}: largest ratio, exact": round(float(exact.max()), 3),
            f"{METHODS[method]}: draws above 1.1, exact": int((exact > 1.1).sum()),
            f"{METHODS[method]}: draws below 1/1.1, exact": int((exact < 1 / 1.1).sum()),
            f"{METHODS[method]}: mean ratio, exact": round(float(np.exp(np.log(exact).mean())), 3),
            f"{METHODS[method]}: mean ratio, exact, low": round(float(np.exp(low)), 3),
            f"{METHODS[method]}: mean ratio, exact, high": round(float(np.exp(high)), 3),
        }
    return row


def interval(values: np.ndarray) -> tuple[float, float]:
    """95 % interval of the mean, by bootstrap."""
    rng = np.random.default_rng(0)
    means = values[rng.integers(0, len(values), (2000, len(values)))].mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


def one_camera(
    labels: int, correlated_px: float, false: float, seed: int
) -> list[tuple[float, float]] | None:
    """Errors on another flight, pixels, of each method, on its labels and exact; None if two poses fit equally well."""
    rng = np.random.default_rng(seed)
    around = rng.uniform(0, 2 * np.pi)
    R, t_m = look_at((5 * np.cos(around), 5 * np.sin(around), rng.uniform(1, 3)), (0.0, 0.0, 1.0))
    camera = make_camera(R=R, t_m=t_m, K=K, dist=DIST, image_size_wh=SIZE_WH)
    points_m, others_m = path(rng, labels), path(rng, 300)
    pixels = project(camera, points_m)[0] + label_errors(rng, labels, correlated_px)
    wrong = rng.random(labels) < false
    pixels[wrong] += rng.normal(0, 100, (int(wrong.sum()), 2))
    truth = project(camera, others_m)[0]
    left_out = truth + label_errors(rng, len(truth), correlated_px)
    try:
        located = locate_camera(points_m, pixels, camera)
    except InputError as error:
        if "two poses" not in str(error):
            raise
        return None
    _, turn, shift, inliers = cv2.solvePnPRansac(points_m, pixels, K, DIST)
    poses = [(located.T_cam_world[:3, :3], located.T_cam_world[:3, 3])]
    for chosen in (np.ravel(inliers), np.flatnonzero(~wrong)):
        refined = cv2.solvePnPRefineLM(points_m[chosen], pixels[chosen], K, DIST, turn.copy(), shift.copy())
        poses.append((cv2.Rodrigues(refined[0])[0], np.ravel(refined[1])))
    errors = []
    for R, t_m in poses:
        seen = project(make_camera(R=R, t_m=t_m, K=K, dist=DIST, image_size_wh=SIZE_WH), others_m)[0]
        errors.append((rms(seen - left_out), rms(seen - truth)))
    return errors


def label_errors(rng: np.random.Generator, count: int, correlated_px: float) -> np.ndarray:
    """Errors of labels one after the other, pixels: white noise, and a correlated error."""
    errors = rng.normal(0, 1.0, (count, 2))
    correlated = rng.normal(0, 1, 2)
    for index in range(count):
        errors[index] += correlated_px * correlated
        correlated = CORRELATION * correlated + np.sqrt(1 - CORRELATION**2) * rng.normal(0, 1, 2)
    return errors


def rms(off_px: np.ndarray) -> float:
    """Root mean square of distances."""
    return float(np.sqrt(np.mean(np.sum(off_px**2, axis=-1))))


def path(rng: np.random.Generator, count: int) -> np.ndarray:
    """Positions along a flight through the room, metres."""
    t = np.linspace(0, 20, count)[:, None] * rng.uniform(0.5, 1.0, 3) + rng.uniform(0, 2 * np.pi, 3)
    return np.array([1.5, 1.5, 0.8]) * np.sin(t) + np.array([0.0, 0.0, 1.2])


if __name__ == "__main__":
    main()
