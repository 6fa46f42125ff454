"""Results of `psotrack calibrate adjust` for sound rigs and for rigs with planted faults.

    python experiments/calibration/adjusting.py

The rigs, bodies and detectors are those of `doctor.py`, on boxes by formula (`_boxes`); the tracks are where the rig as
it is read places the bodies. The judge is the truth in the world's own frame: exact pixels of the bodies are
triangulated with the rig before and after the adjustment, all views alike. "Changed" counts rigs of which a camera was
moved, and "sound cameras moved" their cameras without a fault. "Worse" counts rigs that place the bodies worse than
before by more than 10 %. "In 90 %" is the share of moved cameras whose true centre is inside the stated 90 % ellipsoid.
"All free" is the bundle adjustment of all cameras, from which the wrong cameras are found: its errors are those without
the common motion of the whole rig, which pixels do not determine. Distances are medians over the rigs, of root mean
squares over a rig's bodies or cameras. Rigs in which a camera sees too few of the tracked bodies are refused.
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

from psotrack.calibration import find_drones_in_boxes
from psotrack.calibration.doctor import improve_with_check
from psotrack.calibration.gauge import common_motions, pose_change_metric, pose_changes
from psotrack.errors import InputError
from psotrack.geometry import Rig, project, triangulate_linearly
from psotrack.trajectories import Trajectories

sys.path += [str(Path(__file__).resolve().parent), str(Path(__file__).resolve().parents[1])]
import _boxes
import _results
from doctor import make_case

HERE = Path(__file__).parent
#: Factor by which the bodies' places must be worse to count as worse.
WORSE = 1.1

Fault = Callable[[Rig, int, np.random.Generator], Rig]


def all_turned(rig: Rig, index: int, rng: np.random.Generator) -> Rig:
    """A rig whose cameras are turned about their centres, by a standard deviation of 0.2 degrees about each axis."""
    T = rig.cameras.T_cam_world.copy()
    turns = Rotation.from_rotvec(rng.normal(0, 0.2, (len(rig), 3)), degrees=True).as_matrix()
    T[:, :3] = turns @ T[:, :3]
    return Rig(rig.names, replace(rig.cameras, T_cam_world=T))


#: Name of a fault -> function that plants it in one camera or in all.
FAULTS: dict[str, Fault] = {
    "nothing": lambda rig, index, rng: rig,
    "all turned by 0.2 degrees": all_turned,
    "one turned by 0.5 degrees": lambda rig, index, rng: _boxes.turned(rig, index, 0.5, rng),
    "one moved by 5 cm": lambda rig, index, rng: _boxes.moved(rig, index, 0.05, rng),
    "a focal length 2 % too long": lambda rig, index, rng: _boxes.refocused(rig, index, 1.02),
}


def main() -> None:
    """Plant the faults, adjust the rigs, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rigs", type=int, default=12, help="number of rigs with each fault")
    parser.add_argument("--fault", action="append", choices=list(FAULTS), help="only this one")
    parser.add_argument("--out", type=Path, default=HERE / "results", help="folder of the table")
    options = parser.parse_args()
    run = _results.Run("adjusting")
    rows = [adjust_rig(number, fault) for fault in options.fault or FAULTS for number in range(options.rigs)]
    cases = pd.DataFrame(rows)
    table = cases.groupby("planted", sort=False).apply(summary, include_groups=False).reset_index()
    print(table.to_string(index=False))
    if not options.fault:
        run.save(options.out, rows=table)


def adjust_rig(number: int, fault: str) -> dict[str, object]:
    """Adjust the rig of a case with a planted fault."""
    case, rng = make_case(number), np.random.default_rng((number, 11))
    truth, scene_frames = case.truth, np.arange(case.frames)
    index = int(rng.integers(len(truth)))
    rig = FAULTS[fault](case.rig, index, rng)
    time_s = scene_frames / _boxes.FPS
    place_m = case.flight.at(time_s)[0]
    off_m = place_errors(truth, rig, place_m)
    names = tuple(f"body{body + 1}" for body in range(place_m.shape[1]))
    tracks = Trajectories(scene_frames, time_s, names, place_m + np.nan_to_num(off_m))
    row: dict[str, object] = {"planted": fault, "refused": True, "before_m": rms(off_m)}
    try:
        views = find_drones_in_boxes(rig, case.seen, tracks)
        improved = improve_with_check(rig, views).improved
    except InputError as error:
        print(f"{fault}, rig {number}: refused: {error}", flush=True)
        return row
    faulty = {
        name for each, name in enumerate(rig.names) if each == index or fault.startswith(("all", "nothing"))
    }
    if fault == "nothing":
        faulty = set()
    centre_m = improved.rig.cameras.centre_world - truth.cameras.centre_world
    moved = [rig.names.index(name) for name in improved.moved]
    within = [inside(centre_m[each], improved.centre_covariance_m2[each]) for each in moved]
    row |= {
        "refused": False,
        "changed": bool(improved.moved) or improved.rescaled,
        "sound_moved": len(set(improved.moved) - faulty),
        "zoomed": len(improved.zoomed),
        "after_m": rms(place_errors(truth, improved.rig, place_m)),
        "moved": len(moved),
        "inside": sum(within),
        "free_m": rms(shape_errors(truth, rig, improved.everything.rig)),
    }
    print(
        f"{fault}, rig {number}, {len(rig)} cameras: {', '.join(improved.moved) or 'no camera'} moved; bodies "
        f"{1e3 * row['before_m']:.1f} mm -> {1e3 * row['after_m']:.1f} mm",
        flush=True,
    )
    return row


def place_errors(
    truth: Rig, rig: Rig, place_m: Float[np.ndarray, "frames bodies 3"]
) -> Float[np.ndarray, "frames bodies 3"]:
    """Errors of the bodies' places in the world, by a rig, from exact pixels; NaN where fewer than two see one."""
    pixels, depth = project(truth.cameras, place_m.reshape(-1, 1, 3))
    seen = (depth > 0.3) & ((pixels > 0) & (pixels < truth.cameras.image_size_wh)).all(axis=-1)
    # All views count, also the faulty one: `triangulate` would leave it out.
    found_m = triangulate_linearly(rig.cameras, np.where(seen[..., None], pixels, np.nan))
    return found_m.reshape(place_m.shape) - place_m


def shape_errors(truth: Rig, given: Rig, now: Rig) -> Float[np.ndarray, "cameras 3"]:
    """Errors of the centres, metres, without the common motion of the whole rig."""
    T = np.asarray(given.cameras.T_cam_world)
    motions = common_motions(T)
    held = motions.T @ pose_change_metric(T)
    off = pose_changes(T, np.asarray(now.cameras.T_cam_world)) - pose_changes(
        T, np.asarray(truth.cameras.T_cam_world)
    )
    off = (off - motions @ np.linalg.solve(held @ motions, held @ off))[:-1].reshape(-1, 6)
    turns = Rotation.from_rotvec(off[:, :3]).as_matrix() @ T[:, :3, :3]
    t_m = T[:, :3, 3] + off[:, 3:]
    centre_m = -np.matvec(turns.swapaxes(-1, -2), t_m)
    return centre_m - given.cameras.centre_world


def inside(error_m: Float[np.ndarray, "3"], covariance_m2: Float[np.ndarray, "3 3"]) -> bool:
    """Whether the true position is inside the 90 % ellipsoid around the estimate."""
    return bool(error_m @ np.linalg.solve(covariance_m2, error_m) < chi2.ppf(0.9, 3))


def summary(cases: pd.DataFrame) -> pd.Series:
    """Row of the table for one fault."""
    done = cases[~cases["refused"]]
    changed = done[done["changed"].astype(bool)]
    worse = done["after_m"] > WORSE * done["before_m"] + 1e-3
    moved = int(done["moved"].sum())
    return pd.Series(
        {
            "rigs": len(cases),
            "refused": int(cases["refused"].sum()),
            "changed": len(changed),
            "sound cameras moved": int(done["sound_moved"].sum()),
            "or lens": int(done["zoomed"].sum()),
            "bodies of changed rigs, before (mm)": millimetres(changed["before_m"]),
            "after": millimetres(changed["after_m"]),
            "worse": int(worse.sum()),
            "in 90 %": round(float(done["inside"].sum()) / moved, 2) if moved else "",
            "all free: place (mm)": millimetres(done["free_m"]),
        },
        dtype=object,
    )


def millimetres(values_m: pd.Series) -> float | str:
    """Median in millimetres; empty without values."""
    return round(1e3 * float(values_m.median()), 1) if len(values_m) else ""


def rms(errors_m: Float[np.ndarray, "*any 3"]) -> float:
    """Root mean square length of vectors; NaN rows do not count."""
    return float(np.sqrt(np.nanmean((errors_m**2).sum(axis=-1))))


if __name__ == "__main__":
    main()
