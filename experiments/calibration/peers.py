"""A rig from a moved board: psotrack beside caliscope, aniposelib and OpenCV, on the same corners.

    python experiments/calibration/peers.py REAL [--peers PYTHON] [--quick]

REAL is the folder of the real recordings. Each method calibrates five times, each time without another fifth of the
instants that two cameras share. On the views left out, with the calibrated rig: "common" is the distance of the corners
from a board at one pose for all cameras of an instant; "others" is the distance from where the board is by the other
cameras alone; "length" is the error of the distance between two triangulated corners next to each other.

caliscope and aniposelib run in PYTHON, an interpreter that has them; without --peers they are left out.
`calibrateMultiview` of OpenCV takes (-1, -1), the pixel of a corner that is not seen, for a pixel; it is run on the
views with all corners ("OpenCV, whole boards"). "as published" is the calibration that
comes with the recording. Writes OUT/rigs.csv.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from scipy.optimize import least_squares

from psotrack.calibration import (
    Board,
    BoardViews,
    calibrate_rig,
    choose_instants,
    find_views,
    instants_of_numbers,
    open_images,
)
from psotrack.geometry import Rig, make_camera, make_rig, triangulate_linearly
from psotrack.geometry.rig_files import read_rig

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results

HERE = Path(__file__).parent
CALISCOPE = "mprib/caliscope/tests/sessions"
TALMO = "talmolab/sleap-anipose/tests/data/minimal_session"
#: Recording -> (images of each camera, board, published calibration and its unit in metres, or None where its format
#: states the unit).
SETS = {
    "4_cam_recording": (
        [f"{CALISCOPE}/4_cam_recording/calibration/extrinsic/cam_{n}.mp4" for n in range(4)],
        Board((4, 5), 0.054, 0.0405, "4x4_1000"),
        (f"{CALISCOPE}/4_cam_recording/camera_array.toml", None),
    ),
    "charuco_calibration": (
        [f"{CALISCOPE}/charuco_calibration/calibration/extrinsic/cam_{n}.mp4" for n in range(4)],
        Board((4, 5), 0.054, 0.0405, "4x4_1000"),
        (f"{CALISCOPE}/charuco_calibration/camera_array.toml", None),
    ),
    "sleap-anipose": (
        [f"{TALMO}/{name}/calibration_images" for name in ("back", "mid", "top")],
        Board((8, 11), 0.024, 0.01875, "4x4_1000"),
        (f"{TALMO}/calibration.toml", 1e-3),
    ),
    "stereo chessboard": (
        ["kyamagu/mexopencv/test/left??.jpg", "kyamagu/mexopencv/test/right??.jpg"],
        Board((10, 7), 0.025, kind="chessboard"),
        None,
    ),
}


def main() -> None:
    """Calibrate by every method, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("real", type=Path, help="folder of the real recordings")
    parser.add_argument("--peers", type=Path, help="Python that has caliscope and aniposelib")
    parser.add_argument("--sets", nargs="+", default=list(SETS), choices=list(SETS))
    parser.add_argument(
        "--folds", type=int, default=5, help="calibrations of each method, each without other instants"
    )
    parser.add_argument("--quick", action="store_true", help="one small recording only")
    parser.add_argument("--out", type=Path, default=_results.FOLDER, help="folder of the table")
    options = parser.parse_args()
    run = _results.Run("rigs")
    rows = []
    for name in ["stereo chessboard"] if options.quick else options.sets:
        paths, board, published = SETS[name]
        cameras = open_images([options.real / path for path in paths])
        found = find_views(board, cameras, choose_instants(instants_of_numbers(cameras)))
        board, views = found.board, found.views
        if name == "charuco_calibration":
            views = one_frame_later(views, "cam_1")
        for method, make in methods(options.peers, options.real, published).items():
            rows.append({"recording": name, "method": method} | measure(make, board, views, options.folds))
            print(pd.DataFrame(rows[-1:]).to_string(index=False), flush=True)
    table = pd.DataFrame(rows)
    print(table.to_string(index=False))
    run.save(options.out, rows=table)


def methods(peers, real, published):
    """Name of each method -> function of board and views that gives a rig, or None where it fails."""
    made = {
        "psotrack": lambda board, views: calibrate_rig(board, views).rig,
        "OpenCV, whole boards": lambda board, views: opencv(board, whole(views)),
    }
    for peer in ("caliscope", "aniposelib") if peers else ():
        made[peer] = lambda board, views, peer=peer: run_peer(peers, peer, board, views)
    if published:
        made["as published"] = lambda board, views: as_published(real / published[0], published[1], views)
    return made


def one_frame_later(views, name):
    """Views of a camera whose video starts one frame late: its frames count one less."""
    index = views.names.index(name)
    pixels = np.full(
        (*views.corners_px.shape[:1], views.number.max() + 1, *views.corners_px.shape[2:]), np.nan
    )
    pixels[:, views.number] = views.corners_px
    pixels[index, :-1] = pixels[index, 1:].copy()
    moved = BoardViews(views.names, views.image_size_wh, np.arange(pixels.shape[1]), pixels)
    return moved.select(moved.seen.any(axis=0))


def whole(views):
    """The views in which all corners are seen."""
    pixels = views.corners_px.copy()
    pixels[np.isnan(pixels[..., 0]).any(axis=-1)] = np.nan
    return BoardViews(views.names, views.image_size_wh, views.number, pixels)


def opencv(board, views):
    """`calibrateMultiview` of OpenCV: lenses and places of all cameras."""
    pixels = np.where(np.isfinite(views.corners_px), views.corners_px, -1.0).astype(np.float32)
    mask = views.seen.astype(np.uint8)
    pixels[mask == 0] = -1
    count = len(views.names)
    corners = board.corners_m.astype(np.float32)
    sizes = [tuple(map(int, size)) for size in views.image_size_wh]
    try:
        _, K, dist, R, T = cv2.calibrateMultiview(
            [corners] * len(views.number),
            [[pixels[camera, instant] for instant in range(len(views.number))] for camera in range(count)],
            sizes,
            mask,
            np.full(count, int(cv2.CALIB_MODEL_PINHOLE), np.uint8),
            [np.eye(3)] * count,
            [np.zeros(5)] * count,
            [np.zeros(3)] * count,
            [np.zeros(3)] * count,
        )[:5]
    except cv2.error as error:
        print("OpenCV:", str(error).strip().splitlines()[-1])
        return None
    poses = np.tile(np.eye(4), (count, 1, 1))
    for index in range(count):
        poses[index, :3, :3], poses[index, :3, 3] = cv2.Rodrigues(np.asarray(R[index]))[0], np.ravel(T[index])
    return rig_of(views, np.array(K), [np.ravel(one)[:5] for one in dist], poses)


def run_peer(python, peer, board, views):
    """Calibrate with a peer in its own Python."""
    with tempfile.TemporaryDirectory() as folder:
        corners, out = Path(folder) / "corners.npz", Path(folder) / "rig.npz"
        np.savez(
            corners,
            names=np.array(views.names),
            image_size_wh=views.image_size_wh,
            corners_px=views.corners_px,
            corners_m=board.corners_m,
            squares_wh=np.array(board.squares_wh),
            square_m=board.square_m,
            kind=board.kind,
        )
        done = subprocess.run(
            [python, HERE / "peers_worker.py", peer, corners, out],
            capture_output=True,
            text=True,
            check=False,
        )
        if not out.exists():
            print(f"{peer}:", (done.stderr.strip().splitlines() or ["no result"])[-1])
            return None
        made = np.load(out)
        return rig_of(views, made["K"], made["dist"], made["T"])


def as_published(path, metres_per_unit, views):
    """The calibration that comes with the recording, in metres."""
    rig = read_rig(path, metres_per_unit=metres_per_unit)
    names = [next(one for one in rig.names if name in (one, f"cam_{one}")) for name in views.names]
    chosen = rig.select(names)
    return Rig(views.names, chosen.cameras)


def rig_of(views, K, dist, T):
    """Rig of a method's arrays."""
    return make_rig(
        {
            name: make_camera(
                R=np.linalg.svd(T[i][:3, :3])[0] @ np.linalg.svd(T[i][:3, :3])[2],
                t_m=T[i][:3, 3],
                K=K[i],
                dist=list(map(float, dist[i])),
                image_size_wh=tuple(map(int, views.image_size_wh[i])),
            )
            for i, name in enumerate(views.names)
        }
    )


def measure(make, board, views, folds):
    """Figures of a method on views that it did not use, over all folds."""
    shared = np.flatnonzero(views.seen.sum(axis=0) >= 2)
    parts = []
    for fold in range(folds):
        left = np.isin(np.arange(len(views.number)), shared[fold::folds])
        rig = make(board, views.select(~left))
        if rig is not None:
            parts.append(errors_of(rig, board, views.select(left)))
    figures = {"rigs": len(parts), "views left out": int(views.seen[:, shared].sum())}
    if len(parts) < folds:
        return figures
    for words, each in zip(("common", "others", "length"), zip(*parts, strict=True), strict=True):
        error = np.concatenate(each)
        unit, digits = ("mm", 3) if words == "length" else ("px", 3)
        figures[f"{words} median ({unit})"] = round(float(np.median(error)), digits)
        figures[f"{words} rms ({unit})"] = round(float(np.sqrt(np.mean(error**2))), digits)
    return figures


def errors_of(rig, board, views):
    """Distances from one common board, and from the board of the other cameras, pixels; errors of lengths, mm."""
    common, others = [], []
    for instant in range(len(views.number)):
        there = np.flatnonzero(views.seen[:, instant])
        common += distances(rig, board, views, instant, there, there)
        for camera in there:
            others += distances(rig, board, views, instant, there[there != camera], [camera])
    points_m = triangulate_linearly(rig.cameras, views.corners_px.reshape(len(rig), -1, 2).swapaxes(0, 1))
    points_m = points_m.reshape(len(views.number), -1, 3)
    gaps = np.linalg.norm(board.corners_m[:, None] - board.corners_m, axis=-1)
    first, second = np.nonzero(np.triu(np.isclose(gaps, board.square_m), 1))
    length = np.linalg.norm(points_m[:, first] - points_m[:, second], axis=-1) - board.square_m
    return np.concatenate(common), np.concatenate(others), 1e3 * np.abs(length[np.isfinite(length)])


def distances(rig, board, views, instant, fitted, measured):
    """Distances of the corners in `measured` cameras from a board at the pose that fits the `fitted` cameras best."""

    at = {}
    for camera in {*fitted, *measured}:
        seen = np.isfinite(views.corners_px[camera, instant, :, 0])
        at[camera] = (
            board.corners_m[seen],
            views.corners_px[camera, instant, seen],
            np.asarray(rig.cameras.T_cam_world[camera]),
            np.asarray(rig.cameras.K[camera]),
            np.asarray(rig.cameras.dist[camera]),
        )

    def off(pose, cameras):
        parts = []
        for camera in cameras:
            corners_m, corners_px, T, K, dist = at[camera]
            # The board in the camera's axes; OpenCV's projection is fast, and is not the one under test.
            turn = cv2.Rodrigues(T[:3, :3] @ cv2.Rodrigues(pose[:3])[0])[0]
            shift = T[:3, :3] @ pose[3:] + T[:3, 3]
            parts.append(cv2.projectPoints(corners_m, turn, shift, K, dist)[0].reshape(-1, 2) - corners_px)
        return parts

    starts = []
    for camera in fitted:
        corners_m, corners_px, T_cam_world, K, dist = at[camera]
        _, turns, shifts, _ = cv2.solvePnPGeneric(corners_m, corners_px, K, dist, flags=cv2.SOLVEPNP_IPPE)
        for turn, shift in zip(turns, shifts, strict=True):
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
            T = np.linalg.inv(T_cam_world) @ T
            starts.append(np.concatenate([cv2.Rodrigues(T[:3, :3])[0].ravel(), T[:3, 3]]))
    fits = [
        least_squares(
            lambda pose: np.concatenate(off(pose, fitted)).ravel(), start, x_scale="jac", method="lm"
        )
        for start in starts
    ]
    best = min(fits, key=lambda fit: fit.cost).x
    return [np.linalg.norm(part, axis=-1) for part in off(best, measured)]


if __name__ == "__main__":
    main()
