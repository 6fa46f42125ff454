"""Boards in drawn images: printed inverted, seen mirrored, not the stated one; and the lens that images of one show."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from board_rigs import HELD, HELD_K, draw_board, draw_sheet, film_board, random_poses
from real_data import published
from scipy.spatial.transform import Rotation

from psotrack.calibration import (
    Board,
    BoardFinder,
    LensChoice,
    LensModel,
    LensViews,
    calibrate_rig,
    choose_lens_model,
    detect_board,
    find_views,
    instants_of_numbers,
    open_images,
    open_recorded,
    parse_lens_model,
    save_board,
    say_print,
)
from psotrack.calibration.board_recognition import missing_board, recognise_board
from psotrack.calibration.rig.start import find_lens, fit_boards
from psotrack.geometry import make_camera, make_rig
from psotrack.geometry.rig_files import write_rig
from psotrack.recordings.datasets import open_recording

SIZE_WH = (640, 480)
CHESS = Board((6, 5), 0.03, kind="chessboard")


#: The board before the camera.
POSES = list(random_poses(16))


def projected(board, T):
    points = board.corners_m @ T[:3, :3].T + T[:3, 3]
    return points[:, :2] / points[:, 2:] * np.diag(HELD_K)[:2] + HELD_K[:2, 2]


def draw_grid(board, T):
    """Grey image of a grid of markers."""
    per_m = 2000.0  # pitch and side are whole numbers of pixels
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    pitch, side = round(board.square_m * per_m), round(board.marker_m * per_m)
    columns, rows = board.squares_wh
    sheet = np.full((rows * pitch, columns * pitch), 255, np.uint8)
    for place in range(columns * rows):
        top, left = place // columns * pitch, place % columns * pitch
        marker = cv2.aruco.generateImageMarker(dictionary, board.first_marker + place, side)
        sheet[top : top + side, left : left + side] = marker
    return draw_sheet(np.pad(sheet, 30, constant_values=255), 30, per_m, HELD_K, T, SIZE_WH)


def draw_chess(T):
    """Grey image of the chessboard, with a white border."""
    squares = np.add.outer(np.arange(5), np.arange(6)) % 2
    sheet = np.kron(255 * squares, np.ones((75, 75))).astype(np.uint8)
    sheet = np.pad(sheet, 60, constant_values=255)
    return draw_sheet(sheet, 60, 2500.0, HELD_K, T, SIZE_WH)


def drawn(count, board=HELD):
    return [draw_board(board, HELD_K, T, SIZE_WH) for T in POSES[:count]]


def test_corners_of_a_board_seen_from_both_sides():
    (image,) = drawn(1)
    expected = projected(HELD, POSES[0])
    found = BoardFinder(HELD).find(image)
    assert np.abs(found - expected).max() < 0.5
    # From behind, or in a mirror: the same corners at the pixels where they are.
    mirror = np.ascontiguousarray(image[:, ::-1])
    found = BoardFinder(HELD).find_mirrored(mirror)
    expected[:, 0] = SIZE_WH[0] - 1 - expected[:, 0]
    assert np.abs(found - expected).max() < 0.5


def test_corners_of_a_grid_and_of_a_chessboard():
    grid = Board((3, 4), 0.045, 0.036, "apriltag_36h11", "grid", first_marker=5)
    pose = POSES[1]
    found = BoardFinder(grid).find(draw_grid(grid, pose))
    assert np.abs(found - projected(grid, pose)).max() < 0.6
    # Turned by half a turn, the corners keep their numbers: the square between the first four is dark.
    R = pose[:3, :3]
    middle_m = np.array([0.09, 0.075, 0.0])
    half_turn = pose.copy()
    half_turn[:3, :3] = R @ np.diag([-1.0, -1.0, 1.0])
    half_turn[:3, 3] += 2 * R @ middle_m
    for T in (pose, half_turn):
        T = T.copy()
        T[:3, 3] += 0.05
        found = BoardFinder(CHESS).find(draw_chess(T))
        assert np.abs(found - projected(CHESS, T)).max() < 0.6


def test_a_board_is_drawn_in_its_true_size(tmp_path):
    """The squares of a page of 300 dots per inch, which a finder of the same board finds."""
    board = Board((7, 5), 0.035, 0.026)
    page = cv2.imread(str(save_board(tmp_path / "board.png", board)), cv2.IMREAD_GRAYSCALE)
    corners = BoardFinder(board).find(page)
    dots = np.diff(corners.reshape(4, 6, 2)[:, :, 0], axis=1)
    np.testing.assert_allclose(dots, 0.035 / 0.0254 * 300, rtol=2e-3)


# What a board is, by images.


def test_a_charuco_board_follows_from_images_and_the_side_of_a_square():
    """Small markers, printed white on black."""
    printed = Board((5, 4), 0.05, 0.027, "5x5_100")
    found = detect_board(0.05, [255 - image for image in drawn(3, printed)])
    assert found.squares_wh == (5, 4)
    assert found.marker_m == pytest.approx(0.027, rel=0.04)
    assert found.dictionary == "5x5_50"


def test_a_chessboard_follows_from_images_and_the_side_of_a_square():
    found = detect_board(0.03, [draw_chess(pose) for pose in POSES[:3]])
    assert found == CHESS


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("legacy", [False, True])
def test_the_pattern_is_found_out_in_both_prints(inverted, legacy):
    printed = Board((4, 6), 0.04, 0.03, legacy=legacy)
    images = [255 - image if inverted else image for image in drawn(2, printed)]
    assert recognise_board(Board((4, 6), 0.04, 0.03), images) == (printed, 2)


def test_another_board_or_grid_is_named():
    stated = Board((5, 7), 0.04, 0.03, "5x5_50")
    message = str(missing_board(stated, drawn(3)))
    assert message.startswith(f"board: expected a {stated}, ")
    assert "found a ChArUco board of 7 x 5 squares of 40 mm with markers of" in message
    assert "pass --squares 7x5 --dictionary 4x4_50" in message
    stated = Board((2, 2), 0.05, 0.04, "apriltag_36h11", "grid")
    image = draw_grid(replace(stated, first_marker=20), POSES[1])
    message = str(missing_board(stated, [image]))
    assert "found markers 20 to 23 of the dictionary apriltag_36h11" in message
    assert "--first-marker" in message


@pytest.mark.slow
def test_markers_that_stand_still_are_not_those_of_the_board():
    """As many markers as on the board are on the walls, which each of five cameras sees at other pixels."""
    walls = Board((7, 5), 0.04, 0.03, "6x6_250")
    on_walls = [draw_board(walls, HELD_K, pose, SIZE_WH) for pose in POSES[10:15]]
    images = []
    for board in drawn(2):
        images += [np.hstack([board, wall]) for wall in on_walls]
    assert detect_board(0.04, images).dictionary == "4x4_50"
    # What stands still counts where nothing else is found.
    assert detect_board(0.04, 2 * on_walls).dictionary == "6x6_50"


# Cameras that see a board.


def test_cameras_from_paths(tmp_path):
    black = np.zeros((4, 6), np.uint8)
    for name in ("left", "right"):
        folder = tmp_path / name / "board"
        folder.mkdir(parents=True)
        for number in (2, 10):
            cv2.imwrite(str(folder / f"{name}7_{number}.png"), black)
            cv2.imwrite(str(tmp_path / f"{name}{number:02d}.png"), black)
    cameras = open_images([tmp_path / "left" / "board", tmp_path / "right" / "board"])
    assert [camera.name for camera in cameras] == ["left", "right"]
    np.testing.assert_array_equal(cameras[0].frames, [2, 10])
    ((number, _),) = cameras[0].read(np.array([10]))
    assert number == 10
    by_pattern = open_images([tmp_path / "left??.png", tmp_path / "right??.png"])
    assert [camera.name for camera in by_pattern] == ["left", "right"]


def test_images_that_are_named_by_times_are_paired_with_the_nearest(tmp_path):
    """Nanoseconds, 33 ms apart, of cameras that are 1 ms apart; the second one lost a frame. TUM names seconds."""
    lost = -1
    for form in ("{:d}", "{:.6f}"):
        for name, delay_ns in (("cam[1]", 0), ("cam[2]", 1_000_000)):
            folder = tmp_path / form[2:-1] / name
            folder.mkdir(parents=True)
            for frame in range(6):
                time_ns = 1_600_000_000_000_000_000 + 33_000_000 * frame + delay_ns
                time = time_ns if form == "{:d}" else time_ns / 1e9
                if (name, frame) != ("cam[2]", 3):
                    cv2.imwrite(str(folder / f"{form.format(time)}.png"), np.zeros((8, 8), np.uint8))
        cameras = open_images(sorted(folder.parent.iterdir()))
        assert [camera.name for camera in cameras] == ["cam[1]", "cam[2]"]
        number, frames = instants_of_numbers(cameras)
        np.testing.assert_array_equal(number, frames[:, 0])
        apart_ms = np.where(frames[:, 1] == lost, lost, frames[:, 1] - frames[:, 0]) / 1e6
        np.testing.assert_allclose(apart_ms, [1, 1, 1, 0, 1, 1], atol=0.01)


def test_cameras_of_a_recording_need_no_place(tmp_path):
    """A camera that is new in the rig is calibrated with those that have a place already."""
    for name in ("old", "new"):
        film_board(tmp_path / f"{name}.avi", random_poses(3))
    placed = make_camera(R=np.eye(3), t_m=np.zeros(3), K=HELD_K, image_size_wh=SIZE_WH)
    write_rig(tmp_path / "rig.toml", make_rig({"old": placed}))
    cameras = "".join(f'[cameras.{name}]\nvideo = "{name}.avi"\n' for name in ("old", "new"))
    (tmp_path / "recording.toml").write_text(f'version = 1\ncalibration = "rig.toml"\n{cameras}')
    cameras, (number, frames) = open_recorded(open_recording(tmp_path))
    assert [camera.name for camera in cameras] == ["old", "new"]
    np.testing.assert_array_equal(number, [0, 1, 2])
    np.testing.assert_array_equal(frames, [[0, 0], [1, 1], [2, 2]])


@pytest.mark.slow
@pytest.mark.real
def test_four_webcams():
    """A board printed white on black, which one camera sees from behind; the author's focal lengths are near."""
    folder = published("mprib/caliscope") / "tests/sessions/4_cam_recording/calibration/extrinsic"
    cameras = open_images([folder / f"cam_{n}.mp4" for n in range(4)])
    found = find_views(Board((4, 5), 0.054, 0.0405, "4x4_1000"), cameras, instants_of_numbers(cameras))
    assert (found.mirrored > 0).tolist() == [False, True, False, False]
    assert say_print(found) == [
        f"cam_1 sees the board mirrored, in {found.mirrored[1]} of {found.views.seen[1].sum()} views"
    ]
    calibrated = calibrate_rig(found.board, found.views)
    np.testing.assert_allclose(calibrated.rig.cameras.K[:, 0, 0], [894.5, 704.0, 637.2, 640.4], rtol=0.03)
    assert np.nanmedian(calibrated.residual_px) < 0.6


@pytest.mark.slow
@pytest.mark.real
def test_a_stereo_pair_and_a_chessboard():
    """OpenCV's sample reports 0.22 px."""
    folder = published("kyamagu/mexopencv") / "test"
    cameras = open_images([folder / f"{side}??.jpg" for side in ("left", "right")])
    found = find_views(Board((10, 7), 0.025, kind="chessboard"), cameras, instants_of_numbers(cameras))
    calibrated = calibrate_rig(found.board, found.views)
    assert np.sqrt(np.mean(calibrated.residual_px[calibrated.used] ** 2)) < 0.24


# The lens of a camera.


def test_a_lens_from_a_board(tmp_path):
    cameras = open_images([film_board(tmp_path / "board.avi", random_poses(16))])
    found = find_views(HELD, cameras, instants_of_numbers(cameras))
    lens = calibrate_rig(found.board, found.views, LensChoice(LensModel(4)))
    (K,), (dist,) = lens.rig.cameras.K, lens.rig.cameras.dist
    off_px = np.abs([K[0, 0] - 620, K[1, 1] - 625, K[0, 2] - 322, K[1, 2] - 236])
    # Corners have errors of a tenth of a pixel; an error of 5 standard deviations has a chance of one in a million.
    assert (off_px < 5 * lens.lens_std[0][:4] + 0.5).all()
    assert (off_px < [6, 6, 4, 4]).all()
    assert np.abs(dist).max() < 0.1
    assert lens.residual_px[lens.used].max() < 1.0
    assert lens.used[0].any(axis=1).sum() > 11
    # A fisheye lens shows straight lines as the pinhole does only where k1 = 1/3, k2 = -1/5 or so and on.
    model = LensModel(4, fisheye=True)
    lens = calibrate_rig(found.board, found.views, LensChoice(model))
    assert lens.lens_std[0].shape == (model.size,)
    squares = lens.residual_px[lens.used] ** 2
    assert np.sqrt(squares.mean()) < 0.2


#: Name of the model -> focal length in pixels, and OpenCV's coefficients, of lenses with strong distortion.
STRONG_LENSES = {
    "5": (700.0, (-0.2, 0.05, 0.001, 0.0005, 0.0)),
    "14": (650.0, (-0.25, 0.09, 5e-4, -7e-4, -0.01, 0.05, 0.02, 0.01, 4e-3, -2e-3, 3e-3, 1e-3, 0.06, -0.04)),
    "fisheye": (330.0, (0.06, -0.03, 0.012, -0.003)),
}
LARGE_WH = (1280, 720)
LARGE_BOARD = Board((8, 6), 0.05, 0.0375)


def random_board_places(rng, focal_px):
    """Corners of a board that faces the camera, more or less, in any direction that the image shows, metres."""
    aim = np.ones(3)
    aim[:2] = rng.uniform((-1.1, -0.62), (1.1, 0.62)) * 600 / focal_px
    aim /= np.linalg.norm(aim)
    x = np.cross([0.0, 1.0, 0.0], aim)
    x /= np.linalg.norm(x)
    facing = np.column_stack([x, np.cross(aim, x), aim])
    turned = Rotation.from_euler("xyz", rng.uniform(-40, 40, 3), degrees=True)
    distance_m = 0.4 * focal_px / rng.uniform(300, 560)
    centred = LARGE_BOARD.corners_m - LARGE_BOARD.corners_m.mean(axis=0)
    return centred @ (facing @ turned.as_matrix()).T + distance_m * aim


def views_through_a_strong_lens(name, count):
    """(count, corners, 2), pixels by OpenCV's own formulas with errors of 0.1 px; NaN outside the image."""
    focal_px, dist = STRONG_LENSES[name]
    K = np.array([[focal_px, 0, 645], [0, 1.002 * focal_px, 352], [0, 0, 1]])
    show = cv2.fisheye.projectPoints if name == "fisheye" else cv2.projectPoints
    # Beyond 50 degrees the formulas with 12 and 14 coefficients fold back.
    steepest = 5.0 if name == "fisheye" else 1.15
    rng = np.random.default_rng(3)
    views = []
    while len(views) < count:
        places_m = random_board_places(rng, focal_px)
        pixels, _ = show(places_m[:, None], np.zeros(3), np.zeros(3), K, np.array(dist))
        pixels = pixels[:, 0]
        depth_m = places_m[:, 2]
        is_near = np.hypot(places_m[:, 0], places_m[:, 1]) < steepest * depth_m
        is_inside = ((pixels > 0) & (pixels < np.array(LARGE_WH) - 1)).all(axis=1)
        is_seen = is_near & is_inside & (depth_m > 0.05)
        if is_seen.sum() >= 12:
            noisy = pixels + rng.normal(0, 0.1, pixels.shape)
            views.append(np.where(is_seen[:, None], noisy, np.nan))
    return LensViews(LARGE_BOARD, np.array(views), LARGE_WH)


@pytest.mark.slow
@pytest.mark.parametrize("name", STRONG_LENSES)
def test_the_chosen_model_shows_other_views_as_well_as_the_true_model(name):
    """The rms on other views is at most 1.05 times as large."""
    views = views_through_a_strong_lens(name, 40)
    known, other = views.select(slice(20)), views.select(slice(20, None))

    def rms_px(model):
        residual_px = fit_boards(other, model, find_lens(known, model))
        return np.sqrt(np.nanmean(residual_px**2))

    true_px = rms_px(parse_lens_model(name))
    assert true_px < 0.16
    chosen = choose_lens_model(known)
    assert rms_px(chosen) < 1.05 * true_px
    if name in ("5", "fisheye"):
        assert str(chosen) == name
