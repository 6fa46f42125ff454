"""One peer's calibration of a rig from given corners, run by `peers.py` in the peer's own Python.

python peers_worker.py caliscope|aniposelib CORNERS.npz RIG.npz
"""

import sys

import numpy as np


def main() -> None:
    """Read the corners, calibrate, and write the rig."""
    peer, corners, out = sys.argv[1:]
    data = np.load(corners)
    K, dist, T = {"caliscope": caliscope, "aniposelib": aniposelib}[peer](data)
    np.savez(out, K=K, dist=dist, T=T)


def caliscope(data):
    """Its scripting API: lenses one by one, then all together with the board's lengths."""
    import pandas as pd
    from caliscope.api import (
        CameraArray,
        Charuco,
        Chessboard,
        ConstraintSet,
        ImagePoints,
        calibrate_extrinsics,
        calibrate_intrinsics,
    )

    pixels, board = data["corners_px"], data["corners_m"]
    camera, instant, corner = np.nonzero(np.isfinite(pixels[..., 0]))
    table = pd.DataFrame(
        {
            "sync_index": instant,
            "cam_id": camera,
            "frame_index": instant,
            "frame_time": instant / 10.0,
            "object_id": 0,
            "keypoint_id": corner,
            "img_loc_x": pixels[camera, instant, corner, 0],
            "img_loc_y": pixels[camera, instant, corner, 1],
            "obj_loc_x": board[corner, 0],
            "obj_loc_y": board[corner, 1],
            "obj_loc_z": 0.0,
        }
    )
    points = ImagePoints(table)
    sizes = {index: tuple(map(int, size)) for index, size in enumerate(data["image_size_wh"])}
    cameras = CameraArray.from_image_sizes(sizes)
    for index in sizes:
        cameras[index] = calibrate_intrinsics(points, cameras[index]).camera
    columns, rows = map(int, data["squares_wh"])
    side_cm = 100 * float(data["square_m"])
    if str(data["kind"]) == "charuco":
        constraints = ConstraintSet.from_charuco(Charuco.from_squares(columns, rows, side_cm))
    else:
        constraints = ConstraintSet.from_chessboard(Chessboard(rows - 1, columns - 1, side_cm))
    array = calibrate_extrinsics(points, cameras, constraints).capture_volume.camera_array
    T = np.tile(np.eye(4), (len(sizes), 1, 1))
    for index in sizes:
        T[index, :3, :3], T[index, :3, 3] = array[index].rotation, np.ravel(array[index].translation)
    return (
        np.array([array[index].matrix for index in sizes]),
        np.array([np.ravel(array[index].distortions) for index in sizes]),
        T,
    )


def aniposelib(data):
    """Its `calibrate_rows`, the steps after its own search for corners."""
    import cv2
    from aniposelib.boards import CharucoBoard, Checkerboard
    from aniposelib.cameras import CameraGroup

    pixels = data["corners_px"]
    columns, rows = map(int, data["squares_wh"])
    side = float(data["square_m"])
    if str(data["kind"]) == "charuco":
        board = CharucoBoard(columns, rows, side, 0.75 * side, 4, 1000)
    else:
        board = Checkerboard(columns - 1, rows - 1, square_length=side)
    group = CameraGroup.from_names([str(name) for name in data["names"]])
    all_rows = []
    for camera, size in zip(group.cameras, data["image_size_wh"], strict=True):
        camera.set_size(tuple(map(int, size)))
    for of_camera in pixels:
        of_rows = []
        for instant, corners in enumerate(of_camera):
            seen = np.flatnonzero(np.isfinite(corners[:, 0]))
            if len(seen):
                of_rows.append(
                    {
                        "framenum": instant,
                        "corners": corners[seen][:, None].astype(np.float32),
                        "ids": seen[:, None].astype(np.int32),
                    }
                )
        all_rows.append(of_rows)
    if str(data["kind"]) != "charuco":
        for of_rows in all_rows:
            for row in of_rows:
                row["ids"] = np.arange(len(row["corners"]))
    # A board of few corners has fewer than its least number of corners.
    group.calibrate_rows(all_rows, board, verbose=False, min_corners_intrinsic=6)
    T = np.tile(np.eye(4), (len(pixels), 1, 1))
    for index, camera in enumerate(group.cameras):
        T[index, :3, :3] = cv2.Rodrigues(camera.get_rotation())[0]
        T[index, :3, 3] = np.ravel(camera.get_translation())
    return (
        np.array([camera.get_camera_matrix() for camera in group.cameras]),
        np.array([np.ravel(camera.get_distortions()) for camera in group.cameras]),
        T,
    )


if __name__ == "__main__":
    main()
