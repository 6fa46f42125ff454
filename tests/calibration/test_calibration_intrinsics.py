"""Intrinsics from a data sheet, and from videos of a board that OpenCV draws."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from psotrack.calibration import (
    Board,
    LensChoice,
    LensModel,
    calibrate_rig,
    choose_lens_model,
    find_views,
    instants_of_numbers,
    lens_of_view,
    open_images,
    parse_lens_model,
)
from psotrack.calibration.rig.lenses import find_lens, fit_boards
from psotrack.errors import InputError, SettingsError
from psotrack.geometry import make_camera, project
from psotrack.recordings import VideoWriter


def test_lenses_of_a_data_sheet():
    """The dataset's action camera, 92.45 x 60.83 degrees."""
    lens = lens_of_view(92.45, 60.83, (3840, 2160))
    edges = project(
        lens, np.array([[np.tan(np.deg2rad(92.45 / 2)), 0, 1], [0, -np.tan(np.deg2rad(60.83 / 2)), 1]])
    )[0]
    # Pixel centres are at whole numbers: the image ends half a pixel after the last pixel's centre.
    np.testing.assert_allclose(edges, [[3839.5, 1079.5], [1919.5, -0.5]], atol=1e-9)
    with pytest.raises(SettingsError, match="between 0 and 180"):
        lens_of_view(180.0, 60.0, (640, 480))


BOARD = Board((7, 5), 0.04, 0.03)
BOARD_K = np.array([[620.0, 0, 322.0], [0, 625.0, 236.0], [0, 0, 1]])


def board_video(path, poses, size_wh=(640, 480)):
    """Video of the board, drawn by OpenCV and warped by the homography of each pose (turn in degrees, shift in m)."""
    per_m = 4000.0
    sheet = BOARD.opencv().generateImage((int(0.28 * per_m), int(0.2 * per_m)))
    with VideoWriter(path, 25.0, size_wh) as writer:
        for turn, shift in poses:
            R = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
            # Pixel (u, v) of the sheet lies at ((u + 0.5) / per_m, (v + 0.5) / per_m) on the board, metres.
            to_board = np.array(
                [[1 / per_m, 0, 0.5 / per_m - 0.14], [0, 1 / per_m, 0.5 / per_m - 0.1], [0, 0, 1]]
            )
            H = BOARD_K @ np.column_stack([R[:, 0], R[:, 1], shift]) @ to_board
            large = cv2.warpPerspective(
                sheet,
                np.diag([3.0, 3.0, 1.0]) @ TO_LARGE_CENTRES @ H,
                (3 * size_wh[0], 3 * size_wh[1]),
                borderValue=200,
            )
            image = cv2.resize(large, size_wh, interpolation=cv2.INTER_AREA)
            writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    return open_images([path])


def lens_of_board(images, board, model):
    """The calibration of a single camera."""
    found = find_views(board, images, instants_of_numbers(images))
    return calibrate_rig(found.board, found.views, LensChoice(model))


#: Shift by a third of a pixel: if an image is enlarged three times, the centre of pixel p moves to 3 p + 1.
TO_LARGE_CENTRES = np.array([[1, 0, 1 / 3], [0, 1, 1 / 3], [0, 0, 1.0]])


def test_a_lens_from_a_board(tmp_path):
    rng = np.random.default_rng(0)
    poses = [
        (rng.uniform(-35, 35, 3), (rng.uniform(-0.1, 0.1), rng.uniform(-0.08, 0.08), rng.uniform(0.32, 0.55)))
        for _ in range(20)
    ]
    lens = lens_of_board(board_video(tmp_path / "board.avi", poses), BOARD, LensModel(4))
    camera, std = lens.rig.cameras[0], lens.lens_std[0]
    found = np.array([*np.diag(camera.K)[:2], *camera.K[:2, 2]])
    # Corners have errors of a tenth of a pixel; an error of 5 standard deviations has a chance of one in a million.
    assert (np.abs(found - [620, 625, 322, 236]) < 5 * std[:4] + 0.5).all()
    assert (np.abs(found - [620, 625, 322, 236]) < [6, 6, 4, 4]).all()
    assert np.abs(camera.dist).max() < 0.1
    assert lens.residual_px[lens.used].max() < 1.0
    assert lens.used[0].any(axis=1).sum() > 14


def test_videos_that_do_not_determine_the_lens_are_refused(tmp_path):
    path = tmp_path / "board.avi"
    with pytest.raises(InputError, match="at least 5 views of 6 corners"):
        lens_of_board(board_video(path, [((0, 0, 0), (0, 0, 0.4))] * 4), BOARD, LensModel(4))
    path.unlink()
    # Regression: for the second set of poses, the fit ends at a focal length of 320 000 px, with which the boards seem
    # tilted, and that lens was accepted.
    for step_m, distance_m in ((0.003, 0.4), (0.005, 0.45)):
        flat = [((0, 0, 3.0 * i), (step_m * i, 0, distance_m)) for i in range(10)]
        with pytest.raises(InputError, match="views that determine the focal length"):
            lens_of_board(board_video(path, flat), BOARD, LensModel(4))
    with pytest.raises(SettingsError, match=r"board\.marker_m"):
        Board((7, 5), 0.04, 0.05)
    with pytest.raises(SettingsError, match="at least 3 x 3 squares"):
        Board((7, 2), 0.04, 0.03)
    with pytest.raises(SettingsError, match=r"dictionary: expected one of .*, 4x4_50, .*, found 9x9"):
        Board((7, 5), 0.04, 0.03, "9x9").opencv()


@pytest.mark.slow
def test_a_lens_of_more_coefficients_from_a_board(tmp_path):
    """The board is drawn without distortion: all coefficients are 0 within their deviations."""
    rng = np.random.default_rng(0)
    poses = [
        (rng.uniform(-35, 35, 3), (rng.uniform(-0.1, 0.1), rng.uniform(-0.08, 0.08), rng.uniform(0.32, 0.55)))
        for _ in range(12)
    ]
    video = board_video(tmp_path / "board.avi", poses)
    lens = lens_of_board(video, BOARD, LensModel(5))
    assert lens.lens_std[0].shape == (9,)
    assert (np.abs(lens.rig.cameras[0].dist) < 6 * lens.lens_std[0][4:] + 0.05).all()
    for model in (LensModel(8), LensModel(12), LensModel(14), LensModel(4, fisheye=True)):
        lens = lens_of_board(video, BOARD, model)
        assert lens.lens_std[0].shape == (model.size,)
        # A fisheye lens shows straight lines as the pinhole does only where k1 = 1/3, k2 = -1/5 or so and on.
        assert np.sqrt(np.mean(lens.residual_px[lens.used] ** 2)) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dist", "is_fisheye", "chosen"),
    [((-0.2, 0.05, 0.001, 0.0005, 0.0), False, "5"), ((0.02, -0.01, 0.003, -0.001), True, "fisheye")],
)
def test_the_lens_model_is_chosen_by_views_left_out(dist, is_fisheye, chosen):
    """Views of a board through the formula of the lens, with errors of 0.1 px, up to the corners of the image."""
    board, rng = Board((8, 6), 0.1, 0.075), np.random.default_rng(1)
    focal_px = 350.0 if is_fisheye else 700.0
    K = np.array([[focal_px, 0, 639.5], [0, focal_px, 359.5], [0, 0, 1]])
    camera = make_camera(
        R=np.eye(3), t_m=np.zeros(3), K=K, dist=dist, image_size_wh=(1280, 720), fisheye=is_fisheye
    )
    views = np.full((15, board.num_corners, 2), np.nan)
    for view in views:
        R = Rotation.from_euler("xyz", rng.uniform(-35, 35, 3), degrees=True).as_matrix()
        distance_m = rng.uniform(0.5, 0.8) if is_fisheye else rng.uniform(0.8, 1.3)
        aim = rng.uniform((-0.8, -0.45), (0.8, 0.45)) * distance_m * (1.3 if is_fisheye else 0.8)
        places = (board.corners_m - board.corners_m.mean(axis=0)) @ R.T + [*aim, distance_m]
        pixels = project(camera, places)[0]
        inside = ((pixels > 0) & (pixels < [1279, 719])).all(axis=1)
        view[inside] = pixels[inside] + rng.normal(0, 0.1, (int(inside.sum()), 2))
    seen = np.isfinite(views[..., 0]).sum(axis=1) >= 8
    assert str(choose_lens_model(board, views[seen], (1280, 720))) == chosen


#: Focal length in pixels, OpenCV's coefficients, and whether the lens is a fisheye, of lenses with strong distortion.
STRONG_LENSES = {
    "8": (520.0, (0.9, -0.12, 0.0008, -0.0006, 0.02, 1.25, -0.05, 0.03), False),
    "12": (650.0, (-0.25, 0.09, 5e-4, -7e-4, -0.01, 0.05, 0.02, 0.01, 0.012, -0.006, 0.009, 0.004), False),
    "14": (
        650.0,
        (-0.25, 0.09, 5e-4, -7e-4, -0.01, 0.05, 0.02, 0.01, 0.004, -0.002, 0.003, 0.001, 0.06, -0.04),
        False,
    ),
    "fisheye": (330.0, (0.06, -0.03, 0.012, -0.003), True),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", list(STRONG_LENSES))
def test_the_chosen_model_shows_other_views_as_well_as_the_true_model(name):
    """Boards through OpenCV's own formulas, with errors of 0.1 px; rms on other views at most 1.05 times as large."""
    focal_px, dist, is_fisheye = STRONG_LENSES[name]
    board, rng, size_wh = Board((8, 6), 0.05, 0.0375), np.random.default_rng(3), (1280, 720)
    K = np.array([[focal_px, 0, 645], [0, 1.002 * focal_px, 352], [0, 0, 1]])
    views = []
    while len(views) < 50:
        # The board faces the camera, more or less, in any direction that the image shows.
        aim = np.array([*rng.uniform((-1.1, -0.62), (1.1, 0.62)) * 600 / focal_px, 1.0])
        aim /= np.linalg.norm(aim)
        x = np.cross([0.0, 1.0, 0.0], aim)
        x /= np.linalg.norm(x)
        R = np.column_stack([x, np.cross(aim, x), aim])
        R = R @ Rotation.from_euler("xyz", rng.uniform(-40, 40, 3), degrees=True).as_matrix()
        distance_m = 0.4 * focal_px / rng.uniform(300, 560)
        places = (board.corners_m - board.corners_m.mean(axis=0)) @ R.T + distance_m * aim
        show = cv2.fisheye.projectPoints if is_fisheye else cv2.projectPoints
        pixels = np.reshape(show(places[:, None], np.zeros(3), np.zeros(3), K, np.array(dist))[0], (-1, 2))
        # Beyond 50 degrees the formulas with 12 and 14 coefficients fold back.
        near = np.hypot(*places[:, :2].T) < (5.0 if is_fisheye else 1.15) * places[:, 2]
        inside = ((pixels > 0) & (pixels < np.array(size_wh) - 1)).all(axis=1) & near & (places[:, 2] > 0.05)
        if inside.sum() >= 12:
            noisy = np.where(inside[:, None], pixels + rng.normal(0, 0.1, pixels.shape), np.nan)
            views.append(noisy)
    known, other = np.array(views[:20]), np.array(views[20:])

    def rms_px(model):
        lens = find_lens(board, model, known, size_wh)
        return np.sqrt(np.nanmean(fit_boards(board, model, lens, other, size_wh) ** 2))

    chosen = choose_lens_model(board, known, size_wh)
    true_px = rms_px(parse_lens_model(name))
    assert true_px < 0.16
    assert rms_px(chosen) < 1.05 * true_px
