"""Recordings as a laboratory makes them: own cameras and a board."""

import json

import cv2
import numpy as np
import pytest

from psotrack.geometry import look_at, make_camera, project
from psotrack.geometry.rig_files import read_rig
from psotrack.recordings import probe
from psotrack.simulation import OWN_CAMERAS
from psotrack.simulation.imaging.lens_image import lens_image
from psotrack.simulation.imaging.posed_board import PosedBoard, board_poses, draw_board, own_board
from psotrack.simulation.imaging.raster import pinhole
from psotrack.simulation.own_cameras import own_rig


def lens():
    R, t_m = look_at((0.3, -3.0, 1.5), (0.0, 0.2, 1.0))
    K = np.array([[620.0, 0, 318.0], [0, 625.0, 242.0], [0, 0, 1]])
    return make_camera(R=R, t_m=t_m, K=K, image_size_wh=(640, 480), dist=(-0.2, 0.05, 0.001, -0.0005))


def board(turn_deg=(0.0, 0.0)):
    R, _ = look_at((0.3 + turn_deg[0] / 20, -3.0, 1.5), (0.1, 0.0, 1.1))
    return PosedBoard(R.T, np.array([-0.35, 0.0, 1.7]))


def grey_image(cam):
    return np.full((cam.height, cam.width, 3), 90, np.uint8)


def test_the_board_is_where_opencv_projects_it():
    """Drawn into the images of which the lens's image consists, against `projectPoints` with distortion."""
    camera, places = lens(), board((15.0, 0.0))
    seen = lens_image(camera)
    image = seen.assemble([draw_board(grey_image(cam), cam, places) for cam in seen.faces])
    assert image.shape == (480, 640, 3)
    found, ids, *_ = cv2.aruco.CharucoDetector(own_board().opencv()).detectBoard(image)
    on_board = own_board().corners_m[np.asarray(ids).ravel()]
    points_m = places.corner_m + on_board @ places.axes.T
    T = camera.T_cam_world
    expected = cv2.projectPoints(points_m, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], camera.K, camera.dist)[0]
    assert len(found) == own_board().num_corners
    np.testing.assert_allclose(found.reshape(-1, 2), expected[:, 0], rtol=0, atol=0.2)


def test_the_back_of_the_board_shows_nothing_and_a_board_behind_the_camera_is_not_seen():
    cam, places = pinhole(lens()), board()
    grey = grey_image(cam)
    turned = PosedBoard(places.axes * [-1, 1, -1], places.corner_m + places.axes[:, 0])
    seen = draw_board(grey, cam, turned)
    assert set(np.unique(seen)) <= set(range(90, 121))
    assert (seen == 120).sum() > 10_000
    # A board that reaches beyond the upper edge of the image is drawn as far as it is seen.
    raised = PosedBoard(places.axes, places.corner_m + np.array([0.0, 0.0, 0.6]))
    assert (draw_board(grey, cam, raised)[0] != 90).any()
    behind = PosedBoard(places.axes, np.array([0.0, -9.0, 1.0]))
    np.testing.assert_array_equal(draw_board(grey, cam, behind), grey)


def test_neighbours_see_the_board_together_and_it_is_tilted():
    rig = own_rig(1.0)
    places = board_poses(rig, 33, seed=1)
    assert [place.corner_m[2] for place in places].count(0.0) == 1
    for place in places:
        np.testing.assert_allclose(place.axes @ place.axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(place.axes) == pytest.approx(1)
    corners = np.stack([place.corner_m + own_board().corners_m @ place.axes.T for place in places])
    front = np.stack([-place.axes[:, 2] for place in places])
    seen, angles_deg = [], []
    for camera in (rig.cameras[index] for index in range(len(rig))):
        pixels, depth = project(camera, corners)
        inside = ((pixels > 0) & (pixels < camera.image_size_wh - 1)).all(axis=(1, 2)) & (depth > 0).all(
            axis=1
        )
        way = camera.centre_world - corners.mean(axis=1)
        cosine = (way * front).sum(axis=-1) / np.linalg.norm(way, axis=-1)
        seen.append(inside & (cosine > 0))
        angles_deg.append(np.degrees(np.arccos(cosine)))
    shared = np.array(seen, int) @ np.array(seen, int).T
    assert (np.diag(shared) >= 8).all()
    left, right, gopro, serial = range(4)
    assert min(shared[left, gopro], shared[gopro, serial], shared[serial, right]) >= 4
    # Every second round of boards, one board per camera, is turned to the middle between two cameras: measured 31
    # degrees to the second camera, and 55 degrees when a board is turned to one camera.
    between = np.arange(33) // 4 % 2 == 1
    assert np.sort(angles_deg, axis=0)[1, between].max() < 45


def test_the_folder_of_a_laboratory(tmp_path, run_psotrack):
    folder = tmp_path / "lab"
    small = ("--scale", 0.1, "--frames", 6, "--jobs", 1, "-q")
    result = run_psotrack("simulate", "S01_D2_A", "--as-own-cameras", "--out", folder, *small)
    assert result.code == 0, result.err
    for camera in OWN_CAMERAS:
        flight, calibration = probe(folder / camera.flight), probe(folder / "board" / f"{camera.name}.avi")
        size = tuple(round(side * 0.1) for side in camera.size)
        assert flight.image_size_wh == calibration.image_size_wh == size
        assert flight.fps == pytest.approx(camera.fps, abs=1e-3)
        # The flight takes 0.24 s.
        assert flight.num_frames == int((0.24 - camera.start_s) * camera.fps)
        assert calibration.num_frames == 48
    assert len({camera.fps for camera in OWN_CAMERAS}) == 3
    rig = read_rig(folder / "truth" / "rig.toml")
    assert rig.names == tuple(camera.name for camera in OWN_CAMERAS)
    record = json.loads((folder / "simulation.json").read_text())
    assert record["board"]["squares_wh"] == [4, 5]
    # The board's corner on the floor is the origin of the world in which rig and reference are written.
    for name in ("dron1", "dron2"):
        # Columns of TUM files: time, x, y, z, quaternion.
        rows = np.loadtxt(folder / f"{name}.tum")
        assert rows.shape == (25, 8)
        assert (rows[:, 3] > 0.3).all()
    heights = rig.cameras.centre_world[:, 2]
    np.testing.assert_allclose(heights, [camera.position_m[2] for camera in OWN_CAMERAS], atol=1e-9)
