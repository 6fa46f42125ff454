"""Calibrations that other laboratories published, against the images and points that were published with them.

They are read from `$PSOTRACK_REAL_DATA/OWNER/NAME/`, and none is part of this repository.
"""

import json

import cv2
import numpy as np
import pandas as pd
import pytest
from real_data import published
from scipy.spatial.distance import pdist

from psotrack.calibration import Board, BoardFinder
from psotrack.errors import InputError
from psotrack.geometry import project, triangulate_linearly, undistort
from psotrack.geometry.rig_files import read_lenses, read_rig

pytestmark = pytest.mark.real


@pytest.mark.parametrize("name", ["camera_array.toml", "config.toml"])
def test_caliscopes_points_are_where_its_cameras_saw_them(name):
    folder = published("mprib/caliscope") / "tests/sessions/4_cam_recording"
    rig = read_rig(folder / name)
    assert rig.names == ("0", "1", "2", "3")
    corners = pd.read_csv(folder / "calibration/extrinsic/xy.csv")
    table = corners.pivot_table(
        index=["sync_index", "keypoint_id"], columns="cam_id", values=["img_loc_x", "img_loc_y"]
    )
    seen = np.stack([table["img_loc_x"].to_numpy(), table["img_loc_y"].to_numpy()], axis=-1)
    seen = seen[np.isfinite(seen[..., 0]).sum(axis=1) >= 3]
    assert len(seen) > 30
    position_m = triangulate_linearly(rig.cameras, seen)
    residual_px = np.linalg.norm(project(rig.cameras, position_m[:, None])[0] - seen, axis=-1)
    # The authors' own medians are 0.35 to 0.65 px; a wrong convention gives hundreds of pixels.
    assert (np.nanmedian(residual_px, axis=0) < 1.0).all()


def test_aniposes_cameras_see_the_board_in_one_place():
    folder = published("talmolab/sleap-anipose") / "tests/data/minimal_session"
    with pytest.raises(InputError, match="because the file leaves it open"):
        read_rig(folder / "calibration.toml")
    # The entry `side` is a copy of `top`.
    rig = read_rig(folder / "calibration.toml", metres_per_unit=1e-3).select(("back", "mid", "top"))
    board, seen = Board((8, 11), 0.024, 0.01875, "4x4_1000", legacy=True), []
    for name in rig.names:
        (path,) = (folder / name / "calibration_images").glob(f"{name}-*-10.jpg")
        seen.append(BoardFinder(board).find(cv2.imread(str(path), 0)))
    seen = np.stack(seen, axis=1)
    shared = np.isfinite(seen).all(axis=(1, 2))
    assert shared.sum() > 10
    found = triangulate_linearly(rig.cameras, seen[shared])
    residual_px = np.linalg.norm(project(rig.cameras, found[:, None])[0] - seen[shared], axis=-1)
    assert np.sqrt(np.mean(residual_px**2)) < 1.0
    # Neighbours on the board are one square apart.
    apart, true = (pdist(places) for places in (found, board.corners_m[shared]))
    near = np.isclose(true, 0.024, atol=1e-5)
    np.testing.assert_allclose(apart[near], 0.024, rtol=0, atol=5e-4)


def test_qualisyss_cameras_see_people_in_one_place():
    folder = published("perfanalytics/pose2sim") / "Pose2Sim/Demo_MultiPerson"
    rig = read_rig(folder / "calibration/Calib.qca.txt")
    assert rig.names == ("cam01", "cam02", "cam03", "cam04")
    assert rig.cameras.image_size_wh.tolist() == [[1088, 1920]] * 4
    assert ((rig.cameras.centre_world[:, 2] > 1.5) & (rig.cameras.centre_world[:, 2] < 2.5)).all()
    reduction = 4
    axes = [np.arange(-2, 2, 0.05), np.arange(-2, 2, 0.05), np.arange(0.1, 2.0, 0.05)]
    grid_m = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = np.ones(len(grid_m), bool)
    for index, name in enumerate(rig.names):
        moving = moving_pixels(folder / f"videos/{name}.mp4", reduction)
        pixels, depth_m = project(rig.cameras[index], grid_m)
        column, row = np.floor(pixels / reduction).astype(int).T
        inside &= (depth_m > 0) & (column >= 0) & (row >= 0) & (column < 272) & (row < 480)
        inside[inside] = moving[row[inside], column[inside]]
    # The voxels of a person that all cameras see moving; upside down, five voxels meet by chance.
    assert inside.sum() > 40


def moving_pixels(path, reduction):
    """Pixels of the middle frame that differ from the median of the video."""
    video = cv2.VideoCapture(str(path))
    frames = []
    while (frame := video.read()[1]) is not None:
        frames.append(cv2.resize(frame, None, fx=1 / reduction, fy=1 / reduction))
    frames = np.stack(frames[::4])
    return (np.abs(frames[12].astype(int) - np.median(frames, axis=0)).max(axis=-1)) > 40


def test_easymocaps_cameras_agree_on_matches_between_photos(caplog):
    folder = published("zhu-lebin/trackmesh_gui")
    rig = read_rig(folder / "extri.yml", (1920, 1080))
    assert len(rig) == 11
    assert "no pose: camera 1, 10, 14, 16" in caplog.text
    assert len(read_lenses(folder / "intri.yml", (1920, 1080))) == 32
    sift = cv2.SIFT_create(2000)
    seen = [
        sift.detectAndCompute(cv2.imread(str(folder / f"train/{name:0>3}_0001_00001.jpg"), 0), None)
        for name in ("11", "12")
    ]
    pairs = cv2.BFMatcher().knnMatch(seen[0][1], seen[1][1], k=2)
    pairs = [one for one, other in pairs if one.distance < 0.75 * other.distance]
    ends = [
        np.array([seen[0][0][pair.queryIdx].pt for pair in pairs]),
        np.array([seen[1][0][pair.trainIdx].pt for pair in pairs]),
    ]
    one, other = (rig.cameras[rig.names.index(name)] for name in ("11", "12"))
    rays = [
        np.c_[undistort(camera, end), np.ones(len(end))]
        for camera, end in zip((one, other), ends, strict=True)
    ]
    T = other.T_cam_world @ np.linalg.inv(one.T_cam_world)
    lines = np.cross(T[:3, 3], rays[0] @ T[:3, :3].T)
    distance_px = np.abs((lines * rays[1]).sum(-1)) / np.hypot(*lines.T[:2]) * other.K[0, 0]
    # Less than a fifth with the rotation turned the other way.
    assert np.mean(distance_px < 5) > 0.5


def test_handpose3ds_pose_of_the_second_camera_in_the_first():
    folder = published("TemugeB/handpose3d") / "camera_parameters"
    rig = read_rig(folder / "c0.dat", (720, 720), metres_per_unit=1.0)
    assert rig.names == ("cam0", "cam1")
    T = rig.cameras.T_cam_world[1] @ np.linalg.inv(rig.cameras.T_cam_world[0])
    # The file says this pose a second time.
    stated = (folder / "rot_trans_c1.dat").read_text().rpartition("R:")[2]
    rows, _, translation = stated.partition("T:")
    np.testing.assert_allclose(T[:3, :3], np.array(rows.split(), float).reshape(3, 3), atol=0.02)
    np.testing.assert_allclose(T[:3, 3], np.array(translation.split(), float), atol=0.5)


def test_lenses_by_name_in_json():
    folder = published("cvlab-epfl/multiview_calib") / "examples/drone_rolex"
    lenses = read_lenses(folder / "intrinsics_rational.json")
    stated = json.loads((folder / "intrinsics_rational.json").read_text())
    assert lenses.names == tuple(stated)
    assert lenses.cameras.image_size_wh.tolist() == [[3840, 2160]] * len(stated)
    for index, one in enumerate(stated.values()):
        np.testing.assert_array_equal(lenses.cameras.K[index], one["K"])
        np.testing.assert_array_equal(lenses.cameras.dist[index], one["dist"])
