"""Results of `psotrack calibrate adjust` for correct rigs and for rigs with a planted fault.

    python experiments/calibration/adjusting.py data/Simulated_Data/S0*

Reads sequences with their detections and reference, plants each fault in the calibration, and adjusts the rig. Errors
are differences from the original calibration. If all cameras were moved, the common motion of the whole rig, which
pixels do not determine, is removed first. "In 90 %" is the share of cameras whose true position is inside the stated
90 % ellipsoid. "All free" is the bundle adjustment of all cameras, from which the wrong cameras are found. Writes
OUT/adjusting.csv.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from psotrack.calibration import centre_by_pose, find_drones_in_boxes
from psotrack.calibration.gauge import common_motions, pose_change_metric, pose_changes
from psotrack.datasets.dpjait import read_detections, read_sequence
from psotrack.doctor import improve_with_check
from psotrack.geometry import Rig
from psotrack.methods import detection_files_of
from psotrack.settings import YOLO

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results

HERE = Path(__file__).parent
#: Index of the camera that gets the fault.
FAULTY_CAMERA = 2

Fault = Callable[[Rig, np.random.Generator], Rig]


def without_fault(rig: Rig, rng: np.random.Generator) -> Rig:
    """A rig without a fault."""
    return rig


def all_turned(rig: Rig, rng: np.random.Generator) -> Rig:
    """A rig whose cameras are turned about their centres, by a standard deviation of 0.2 degrees about each axis."""
    T = rig.cameras.T_cam_world.copy()
    turns = Rotation.from_rotvec(rng.normal(0, 0.2, (len(rig), 3)), degrees=True).as_matrix()
    T[:, :3] = turns @ T[:, :3]
    return Rig(rig.names, replace(rig.cameras, T_cam_world=T))


def moved(rig: Rig, rng: np.random.Generator) -> Rig:
    """A rig with one camera moved by 5 cm."""
    T, shift = rig.cameras.T_cam_world.copy(), rng.normal(size=3)
    T[FAULTY_CAMERA, :3, 3] += 0.05 * shift / np.linalg.norm(shift)
    return Rig(rig.names, replace(rig.cameras, T_cam_world=T))


def with_longer_focal_length(rig: Rig, rng: np.random.Generator) -> Rig:
    """A rig with one focal length that is 2 % too long."""
    K = rig.cameras.K.copy()
    K[FAULTY_CAMERA, :2, :2] *= 1.02
    return Rig(rig.names, replace(rig.cameras, K=K))


#: Name of a fault -> function that plants it, and the cameras that get it.
FAULTS: dict[str, tuple[Fault, slice]] = {
    "nothing": (without_fault, slice(None)),
    "all turned by 0.2 degrees": (all_turned, slice(None)),
    "one moved by 5 cm": (moved, slice(FAULTY_CAMERA, FAULTY_CAMERA + 1)),
    "a focal length 2 % too long": (with_longer_focal_length, slice(FAULTY_CAMERA, FAULTY_CAMERA + 1)),
}


def main() -> None:
    """Plant the faults, adjust the rigs, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequences", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=HERE / "results", help="folder of the table")
    options = parser.parse_args()
    run = _results.Run("adjusting")
    cases = pd.concat([adjust_sequence(folder) for folder in options.sequences])
    table = cases.groupby("planted", sort=False).apply(summary, include_groups=False).reset_index()
    print(table.to_string(index=False))
    run.save(options.out, rows=table)


def adjust_sequence(folder: Path) -> pd.DataFrame:
    """Adjust the rig of a sequence with each fault; one row per camera and fault."""
    recording = read_sequence(folder)
    boxes = {name: read_detections(path) for name, path in detection_files_of(recording, YOLO).items()}
    if recording.truth is None:
        raise SystemExit(f"{folder}: expected a reference, which assigns boxes to drones, found none")
    truth, rng, rows = recording.rig, np.random.default_rng(0), []
    for name, (fault, faulty) in FAULTS.items():
        rig = fault(truth, rng)
        views = find_drones_in_boxes(rig, boxes, recording.truth)
        improved = improve_with_check(rig, views).improved
        whole = len(improved.moved) == len(rig)
        free_m, _ = errors(truth, rig, improved.everything.rig, whole=True)
        (before_m, before_deg), (after_m, after_deg) = (
            errors(truth, rig, now, whole=whole) for now in (rig, improved.rig)
        )
        covariance_m2, free_covariance_m2 = (
            improved.centre_covariance_m2,
            improved.everything.centre_covariance_m2,
        )
        for index, camera in enumerate(rig.names):
            rows.append(
                {
                    "planted": name,
                    "rig": folder,
                    "faulty": index in range(len(rig))[faulty],
                    "moved": camera in improved.moved,
                    "zoomed": camera in improved.zoomed,
                    "before_m": np.linalg.norm(before_m[index]),
                    "after_m": np.linalg.norm(after_m[index]),
                    "before_deg": np.linalg.norm(before_deg[index]),
                    "after_deg": np.linalg.norm(after_deg[index]),
                    "inside": inside(after_m[index], covariance_m2[index]),
                    "free_m": np.linalg.norm(free_m[index]),
                    "free_inside": inside(free_m[index], free_covariance_m2[index]),
                }
            )
        print(f"{folder}, {name}: {', '.join(improved.moved) or 'no camera'} moved", flush=True)
    return pd.DataFrame(rows)


def errors(
    truth: Rig, given: Rig, now: Rig, *, whole: bool
) -> tuple[Float[np.ndarray, "cameras 3"], Float[np.ndarray, "cameras 3"]]:
    """Errors of centres, metres, and axes, degrees; if `whole`, without the common motion of the whole rig.

    Args:
        truth: the correct rig.
        given: the rig with the fault.
        now: the rig whose errors are computed.
        whole: whether the errors are minimised over common motions of the rig.
    """
    T = np.asarray(given.cameras.T_cam_world)
    off = pose_changes(T, np.asarray(truth.cameras.T_cam_world))
    if whole:
        motions = common_motions(T)
        held = motions.T @ pose_change_metric(T)
        off = off - motions @ np.linalg.solve(held @ motions, held @ off)
    off = pose_changes(T, np.asarray(now.cameras.T_cam_world)) - off
    off = off[:-1].reshape(-1, 6)
    by_pose = np.stack([centre_by_pose(pose[:3, :3], pose[:3, 3]) for pose in T])
    return np.matvec(by_pose, off), np.rad2deg(off[:, :3])


def inside(error_m: Float[np.ndarray, "3"], covariance_m2: Float[np.ndarray, "3 3"]) -> bool:
    """Whether the true position is inside the 90 % ellipsoid around the estimate."""
    return bool(error_m @ np.linalg.solve(covariance_m2, error_m) < chi2.ppf(0.9, 3))


def summary(cases: pd.DataFrame) -> pd.Series:
    """Row of the table for one fault, over all sequences and cameras."""
    faulty, others = cases[cases["faulty"]], cases[~cases["faulty"]]
    return pd.Series(
        {
            "rigs": cases["rig"].nunique(),
            "moved": f"{int(cases['moved'].sum())} of {len(cases)}",
            "or lens": int(cases["zoomed"].sum()),
            "place, before (mm)": round(1e3 * rms(faulty["before_m"]), 1),
            "after": round(1e3 * rms(faulty["after_m"]), 1),
            "of the others": round(1e3 * rms(others["after_m"]), 1),
            "in 90 %": round(float(cases["inside"].mean()), 2),
            "axes, before (degrees)": round(rms(faulty["before_deg"]), 3),
            "axes, after": round(rms(faulty["after_deg"]), 3),
            "all free: place (mm)": round(1e3 * rms(cases["free_m"]), 1),
            "all free: in 90 %": round(float(cases["free_inside"].mean()), 2),
        }
    )


def rms(values: pd.Series) -> float:
    """Root mean square; 0 without values."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


if __name__ == "__main__":
    main()
