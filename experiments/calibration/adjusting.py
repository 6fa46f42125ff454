"""What `psotrack calibrate adjust` does to right rigs, and to rigs with a fault in them.

    python experiments/calibration/adjusting.py data/Simulated_Data/S0*

Reads sequences with their detections and reference, plants each fault in the calibration, and adjusts. Errors are those
of the cameras' places against the calibration as it was; where all cameras were moved, after the common motion of the
whole rig that pixels do not tell is taken out. "In 90 %" is the share of cameras whose true place is inside the 90 %
ellipsoid that is stated; "all free" is the bundle adjustment of all cameras, which is judged before the rig is written.
Writes OUT/adjusting.csv.
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

from psotrack.calibration import centre_by_pose, find_drones_in_boxes, improve
from psotrack.calibration.gauge import common_motions, pose_change_metric, pose_changes
from psotrack.datasets.dpjait import read_detections, read_sequence
from psotrack.geometry import Rig
from psotrack.methods import detection_files_of
from psotrack.settings import YOLO

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results

HERE = Path(__file__).parent
#: The camera that is tampered with.
ONE = 2

Fault = Callable[[Rig, np.random.Generator], Rig]


def sound(rig: Rig, rng: np.random.Generator) -> Rig:
    """Nothing wrong."""
    return rig


def jittered(rig: Rig, rng: np.random.Generator) -> Rig:
    """Every camera turned about its own centre, by 0.2 degrees about each axis."""
    T = rig.cameras.T_cam_world.copy()
    turns = Rotation.from_rotvec(rng.normal(0, 0.2, (len(rig), 3)), degrees=True).as_matrix()
    T[:, :3] = turns @ T[:, :3]
    return Rig(rig.names, replace(rig.cameras, T_cam_world=T))


def moved(rig: Rig, rng: np.random.Generator) -> Rig:
    """One camera moved by 5 cm."""
    T, shift = rig.cameras.T_cam_world.copy(), rng.normal(size=3)
    T[ONE, :3, 3] += 0.05 * shift / np.linalg.norm(shift)
    return Rig(rig.names, replace(rig.cameras, T_cam_world=T))


def longer(rig: Rig, rng: np.random.Generator) -> Rig:
    """The focal length of one camera 2 % too long."""
    K = rig.cameras.K.copy()
    K[ONE, :2, :2] *= 1.02
    return Rig(rig.names, replace(rig.cameras, K=K))


#: And the cameras that have it.
FAULTS: dict[str, tuple[Fault, slice]] = {
    "nothing": (sound, slice(None)),
    "all turned by 0.2 degrees": (jittered, slice(None)),
    "one moved by 5 cm": (moved, slice(ONE, ONE + 1)),
    "a focal length 2 % too long": (longer, slice(ONE, ONE + 1)),
}


def main() -> None:
    """Plant, adjust, and show."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequences", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=HERE / "results", help="Folder of the table.")
    options = parser.parse_args()
    run = _results.Run("adjusting")
    cases = pd.concat([of_sequence(folder) for folder in options.sequences])
    table = cases.groupby("planted", sort=False).apply(summary, include_groups=False).reset_index()
    print(table.to_string(index=False))
    run.save(options.out, rows=table)


def of_sequence(folder: Path) -> pd.DataFrame:
    """A row for each camera and fault."""
    recording = read_sequence(folder)
    boxes = {name: read_detections(path) for name, path in detection_files_of(recording, YOLO).items()}
    if recording.truth is None:
        raise SystemExit(f"{folder}: it has no reference, which says which box is whose")
    truth, rng, rows = recording.rig, np.random.default_rng(0), []
    for name, (fault, tampered) in FAULTS.items():
        rig = fault(truth, rng)
        views = find_drones_in_boxes(rig, boxes, recording.truth)
        improved = improve(rig, views.points_px, views.noise_px, common_errors=views.common_errors)
        whole = len(improved.moved) == len(rig)
        free_m, _ = errors(truth, rig, improved.everything.rig, whole=True)
        (before_m, before_deg), (after_m, after_deg) = (
            errors(truth, rig, one, whole=whole) for one in (rig, improved.rig)
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
                    "tampered": index in range(len(rig))[tampered],
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
    """How far centres, metres, and axes, degrees, are off the truth; if `whole`, off that moved as near as can be."""
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
    """Whether the 90 % ellipsoid about the estimate holds the truth."""
    return bool(error_m @ np.linalg.solve(covariance_m2, error_m) < chi2.ppf(0.9, 3))


def summary(cases: pd.DataFrame) -> pd.Series:
    """Of one fault, over sequences and cameras."""
    tampered, others = cases[cases["tampered"]], cases[~cases["tampered"]]
    return pd.Series(
        {
            "rigs": cases["rig"].nunique(),
            "moved": f"{int(cases['moved'].sum())} of {len(cases)}",
            "or lens": int(cases["zoomed"].sum()),
            "place, before (mm)": round(1e3 * rms(tampered["before_m"]), 1),
            "after": round(1e3 * rms(tampered["after_m"]), 1),
            "of the others": round(1e3 * rms(others["after_m"]), 1),
            "in 90 %": round(float(cases["inside"].mean()), 2),
            "axes, before (degrees)": round(rms(tampered["before_deg"]), 3),
            "axes, after": round(rms(tampered["after_deg"]), 3),
            "all free: place (mm)": round(1e3 * rms(cases["free_m"]), 1),
            "all free: in 90 %": round(float(cases["free_inside"].mean()), 2),
        }
    )


def rms(values: pd.Series) -> float:
    """0 for none."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


if __name__ == "__main__":
    main()
