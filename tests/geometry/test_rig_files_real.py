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
from psotrack.geometry import project, triangulate_linearly
from psotrack.geometry.rig_files import read_lenses, read_rig

pytestmark = pytest.mark.real


@pytest.mark.parametrize("name", ["camera_array.toml", "config.toml"])
def test_caliscopes_points_are_where_its_cameras_saw_them(name):
    folder = published("mprib/caliscope") / "tests/sessions/4_cam_recording"
    rig = read_rig(folder / name)
    assert rig.names == ("0", "1", "2", "3")
    corners = pd.read_csv(folder / "calibration/extrinsic/xy.csv")
    place = ["sync_index", "keypoint_id"]
    x = corners.pivot_table(index=place, columns="cam_id", values="img_loc_x")
    y = corners.pivot_table(index=place, columns="cam_id", values="img_loc_y")
    seen = np.stack([x.to_numpy(), y.to_numpy()], axis=-1)
    seen = seen[np.isfinite(seen[..., 0]).sum(axis=1) >= 3]
    assert len(seen) > 30
    position_m = triangulate_linearly(rig.cameras, seen)
    pixels, _ = project(rig.cameras, position_m[:, None])
    residual_px = np.linalg.norm(pixels - seen, axis=-1)
    # The authors' own medians are 0.35 to 0.65 px; a wrong convention gives hundreds of pixels.
    assert (np.nanmedian(residual_px, axis=0) < 1.0).all()


def test_aniposes_cameras_see_the_board_in_one_place():
    folder = published("talmolab/sleap-anipose") / "tests/data/minimal_session"
    with pytest.raises(InputError, match="because the file leaves it open"):
        read_rig(folder / "calibration.toml")
    # The entry `side` is a copy of `top`.
    rig = read_rig(folder / "calibration.toml", metres_per_unit=1e-3).select(("back", "mid", "top"))
    board = Board((8, 11), 0.024, 0.01875, "4x4_1000", legacy=True)
    seen = []
    for name in rig.names:
        (path,) = (folder / name / "calibration_images").glob(f"{name}-*-10.jpg")
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        seen.append(BoardFinder(board).find(image))
    seen = np.stack(seen, axis=1)
    shared = np.isfinite(seen).all(axis=(1, 2))
    assert shared.sum() > 10
    seen = seen[shared]
    position_m = triangulate_linearly(rig.cameras, seen)
    pixels, _ = project(rig.cameras, position_m[:, None])
    squares = ((pixels - seen) ** 2).sum(axis=-1)
    assert np.sqrt(squares.mean()) < 1.0
    # Neighbours on the board are one square apart.
    near = np.isclose(pdist(board.corners_m[shared]), 0.024, atol=1e-5)
    np.testing.assert_allclose(pdist(position_m)[near], 0.024, rtol=0, atol=5e-4)


def test_qualisyss_cameras_hang_above_people():
    folder = published("perfanalytics/pose2sim") / "Pose2Sim/Demo_MultiPerson"
    rig = read_rig(folder / "calibration/Calib.qca.txt")
    assert rig.names == ("cam01", "cam02", "cam03", "cam04")
    assert rig.cameras.image_size_wh.tolist() == [[1088, 1920]] * 4
    height_m = rig.cameras.centre_world[:, 2]
    assert ((height_m > 1.5) & (height_m < 2.5)).all()
    # All cameras see the middle of a person.
    pixels, depth_m = project(rig.cameras, np.array([[0.0, 0.0, 1.0]]))
    assert (depth_m > 0).all()
    assert ((pixels > 0) & (pixels < (1088, 1920))).all()


def test_lenses_by_name_in_json():
    folder = published("cvlab-epfl/multiview_calib") / "examples/drone_rolex"
    lenses = read_lenses(folder / "intrinsics_rational.json")
    stated = json.loads((folder / "intrinsics_rational.json").read_text())
    assert lenses.names == tuple(stated)
    assert lenses.cameras.image_size_wh.tolist() == [[3840, 2160]] * len(stated)
    for index, one in enumerate(stated.values()):
        np.testing.assert_array_equal(lenses.cameras.K[index], one["K"])
        np.testing.assert_array_equal(lenses.cameras.dist[index], one["dist"])


def test_one_lens_in_json():
    folder = published("wordbomb/PoseFree-GeoLocator")
    (path,) = folder.glob("UAV experiment/**/cam2_0619.json")
    lens = read_lenses(path)
    assert lens.names == ("cam2_0619",)
    assert lens.cameras.K[0, 0, 0] == 1563.66571
    assert lens.cameras.dist.shape == (1, 5)
    assert lens.cameras.image_size_wh.tolist() == [[1920, 1080]]
