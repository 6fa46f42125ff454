"""Boards in images that OpenCV draws: printed inverted, seen mirrored, and boards that are not the stated one."""

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from board_rigs import draw_board
from click.testing import CliRunner
from real_data import published
from scipy.spatial.transform import Rotation

import psotrack as pt
from psotrack.calibration import (
    Board,
    calibrate_rig,
    detect_board,
    find_views,
    instants_of_numbers,
    open_images,
    open_recorded,
    save_board,
    say_print,
)
from psotrack.calibration.board_corners import BoardFinder
from psotrack.calibration.board_recognition import measure_markers, missing_board, recognise_board
from psotrack.cli.calibrate import calibrate
from psotrack.errors import InputError, OutputError, PsotrackError, SettingsError
from psotrack.geometry import make_camera, make_rig
from psotrack.geometry.rig_files import read_rig, write_rig
from psotrack.recordings import VideoWriter
from psotrack.recordings.datasets import open_recording

SIZE_WH = (640, 480)
K = np.array([[620.0, 0, 322.0], [0, 620.0, 236.0], [0, 0, 1]])
BOARD = Board((4, 6), 0.04, 0.03)
CHESS = Board((6, 5), 0.03, kind="chessboard")


def pose(seed=0):
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", rng.uniform(-25, 25, 3), degrees=True).as_matrix()
    T[:3, 3] = np.array([-0.08, -0.12, 0.45]) + rng.uniform(-0.02, 0.02, 3)
    return T


def projected(board, T):
    points = board.corners_m @ T[:3, :3].T + T[:3, 3]
    return points[:, :2] / points[:, 2:] * np.diag(K)[:2] + K[:2, 2]


def draw_grid(board, T):
    """Grey image of a grid of markers, drawn like a ChArUco board."""
    per_m = 2000.0  # pitch and side are whole numbers of pixels
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    pitch, side = round(board.square_m * per_m), round(board.marker_m * per_m)
    columns, rows = board.squares_wh
    sheet = np.full((rows * pitch, columns * pitch), 255, np.uint8)
    for place in range(columns * rows):
        top, left = place // columns * pitch, place % columns * pitch
        marker = cv2.aruco.generateImageMarker(dictionary, board.first_marker + place, side)
        sheet[top : top + side, left : left + side] = marker
    sheet = cv2.copyMakeBorder(sheet, 30, 30, 30, 30, cv2.BORDER_CONSTANT, value=255)
    to_board = np.array([[1 / per_m, 0, -29.5 / per_m], [0, 1 / per_m, -29.5 / per_m], [0, 0, 1]])
    to_large = np.array([[3.0, 0, 1], [0, 3, 1], [0, 0, 1]])
    H = to_large @ K @ T[:3, [0, 1, 3]] @ to_board
    large = cv2.warpPerspective(sheet, H, (3 * SIZE_WH[0], 3 * SIZE_WH[1]), borderValue=200)
    return cv2.resize(large, SIZE_WH, interpolation=cv2.INTER_AREA)


def draw_chess(T):
    """Image of the chessboard, with a white border."""
    sheet = np.kron(np.add.outer(np.arange(5), np.arange(6)) % 2, np.ones((75, 75))) * 255
    sheet = cv2.copyMakeBorder(sheet.astype(np.uint8), 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
    to_board = np.array([[1 / 2500, 0, -59.5 / 2500], [0, 1 / 2500, -59.5 / 2500], [0, 0, 1]])
    return cv2.warpPerspective(sheet, K @ T[:3, [0, 1, 3]] @ to_board, SIZE_WH, borderValue=255)


def test_corners_of_a_board():
    image = draw_board(BOARD, K, pose(), SIZE_WH)
    found = BoardFinder(BOARD).find(image)
    assert np.isfinite(found).all()
    assert np.abs(found - projected(BOARD, pose())).max() < 0.5
    # From behind, or in a mirror: the same corners at the pixels where they are.
    mirrored = BoardFinder(BOARD).find_mirrored(np.ascontiguousarray(image[:, ::-1]))
    expected = projected(BOARD, pose()) * [-1, 1] + [SIZE_WH[0] - 1, 0]
    assert np.abs(mirrored - expected).max() < 0.5


def test_corners_of_a_grid_and_of_a_chessboard():
    grid = Board((3, 4), 0.045, 0.036, "apriltag_36h11", "grid", first_marker=5)
    found = BoardFinder(grid).find(draw_grid(grid, pose()))
    assert np.isfinite(found).all()
    assert np.abs(found - projected(grid, pose())).max() < 0.6
    # Turned by half a turn, the corners keep their numbers: the square between the first four is dark.
    for turn in (0.0, 180.0):
        T = pose(1)
        T[:3, :3] = T[:3, :3] @ Rotation.from_euler("z", turn, degrees=True).as_matrix()
        T[:3, 3] = pose(1)[:3, 3] + 0.05 - T[:3, :3] @ [0.09, 0.075, 0] + pose(1)[:3, :3] @ [0.09, 0.075, 0]
        found = BoardFinder(CHESS).find(draw_chess(T))
        assert np.abs(found - projected(CHESS, T)).max() < 0.6


@pytest.mark.parametrize(
    ("printed", "inverted"),
    [(BOARD, False), (BOARD, True), (Board((5, 4), 0.05, 0.027, "5x5_100"), False), (CHESS, False)],
    ids=["charuco", "white on black", "small markers", "chessboard"],
)
@pytest.mark.slow
def test_what_a_board_is_follows_from_images_and_the_side_of_a_square(printed: Board, inverted: bool) -> None:
    draw = draw_chess if printed is CHESS else lambda T: draw_board(printed, K, T, SIZE_WH)
    images = [255 - draw(pose(seed)) if inverted else draw(pose(seed)) for seed in range(4)]
    found = detect_board(printed.square_m, images)
    assert (found.squares_wh, found.kind) == (printed.squares_wh, printed.kind)
    if printed.marker_m is not None:
        assert found.marker_m == pytest.approx(printed.marker_m, rel=0.04)
        assert found.dictionary == ("5x5_50" if "5x5" in printed.dictionary else "4x4_50")


def test_images_without_a_board_are_one_line() -> None:
    with pytest.raises(
        InputError, match="expected a ChArUco board or a chessboard, found neither in 3 images"
    ):
        detect_board(0.04, [np.full((240, 320), 128, np.uint8)] * 3)


def test_a_board_is_drawn_in_its_true_size(tmp_path: Path) -> None:
    """The squares of a page of 300 dots per inch, which a finder of the same board finds."""
    board = Board((7, 5), 0.035, 0.026)
    page = cv2.imread(str(save_board(tmp_path / "board.png", board)), cv2.IMREAD_GRAYSCALE)
    corners = BoardFinder(board).find(page)
    assert np.isfinite(corners).all()
    dots = np.diff(corners.reshape(4, 6, 2)[:, :, 0], axis=1)
    np.testing.assert_allclose(dots, 0.035 / 0.0254 * 300, rtol=2e-3)
    with pytest.raises(OutputError):
        save_board(tmp_path / "board.png", board)


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("legacy", [False, True])
def test_the_pattern_is_found_out_in_both_prints(inverted, legacy):
    printed = replace(BOARD, legacy=legacy)
    images = [draw_board(printed, K, pose(seed), SIZE_WH) for seed in range(2)]
    assert recognise_board(BOARD, [255 - image if inverted else image for image in images]) == (printed, 2)


SHOWN = "found a ChArUco board of 4 x 6 squares of 40 mm with markers of"


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        (Board((6, 4), 0.04, 0.03), (SHOWN, "pass --squares 4x6 --dictionary 4x4_50")),
        (Board((4, 6), 0.04, 0.03, "5x5_50"), (SHOWN, "--dictionary 4x4_50")),
        (Board((4, 6), 0.04, kind="chessboard"), (SHOWN, "pass --squares 4x6 --marker 0.0")),
        (Board((4, 3), 0.04, 0.04 * 0.75, kind="grid"), (SHOWN,)),
        (replace(BOARD, dictionary="4x4_100"), ("found too few of its corners",)),
    ],
)
@pytest.mark.slow
def test_another_board_is_named(stated: Board, words: tuple[str, ...]) -> None:
    message = str(missing_board(stated, [draw_board(BOARD, K, pose(seed), SIZE_WH) for seed in range(4)]))
    assert message.startswith(f"board: expected a {stated}, ")
    assert all(each in message for each in words), message


@pytest.mark.slow
def test_markers_that_stand_still_are_not_those_of_the_board() -> None:
    """As many markers as on the board are on the walls, which each of five cameras sees at other pixels."""
    walls = replace(BOARD, dictionary="6x6_250")
    images = [
        np.hstack(
            [draw_board(BOARD, K, pose(seed), SIZE_WH), draw_board(walls, K, pose(10 + camera), SIZE_WH)]
        )
        for seed in range(2)
        for camera in range(5)
    ]
    assert detect_board(0.04, images).dictionary == "4x4_50"
    # What stands still counts where nothing else is found.
    assert detect_board(0.04, [image[:, 640:] for image in images]).dictionary == "6x6_50"


def test_the_size_of_the_markers_is_measured():
    images = [draw_board(BOARD, K, pose(seed), SIZE_WH) for seed in range(4)]
    stated, true = replace(BOARD, marker_m=0.4 * BOARD.square_m), BOARD.marker_m / BOARD.square_m
    for shown in (images, [255 - image for image in images]):
        assert measure_markers(stated, shown) == pytest.approx(true, rel=0.05)
    assert measure_markers(stated, images[:2]) is None


@pytest.mark.slow
def test_another_grid_is_named() -> None:
    grid = Board((2, 2), 0.05, 0.04, "apriltag_36h11", "grid", first_marker=20)
    message = str(missing_board(replace(grid, first_marker=0), [draw_grid(grid, pose())]))
    assert "found markers 20 to 23 of the dictionary apriltag_36h11" in message
    assert "--first-marker" in message


def test_cameras_from_paths(tmp_path):
    for name in ("left", "right"):
        folder = tmp_path / name / "board"
        folder.mkdir(parents=True)
        for number in (2, 10):
            cv2.imwrite(str(folder / f"{name}7_{number}.png"), np.zeros((4, 6), np.uint8))
            cv2.imwrite(str(tmp_path / f"{name}{number:02d}.png"), np.zeros((4, 6), np.uint8))
    cameras = open_images([tmp_path / "left" / "board", tmp_path / "right" / "board"])
    assert [camera.name for camera in cameras] == ["left", "right"]
    np.testing.assert_array_equal(cameras[0].frames, [2, 10])
    assert [number for number, _ in cameras[0].read(np.array([10]))] == [10]
    assert [camera.name for camera in open_images([tmp_path / "left??.png", tmp_path / "right??.png"])] == [
        "left",
        "right",
    ]
    with pytest.raises(InputError, match="expected each camera once, found board again"):
        open_images([tmp_path / "left" / "board"] * 2)
    with pytest.raises(InputError, match="images of this pattern, found none"):
        open_images([tmp_path / "top*.png"])
    with pytest.raises(SettingsError, match="2 names, found 1"):
        open_images([tmp_path / "left" / "board", tmp_path / "right" / "board"], ["a"])


def test_cameras_of_a_recording_need_no_place(tmp_path):
    """A camera that is new in the rig is calibrated with those that have a place already."""
    for name in ("old", "new"):
        video = cv2.VideoWriter(str(tmp_path / f"{name}.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25, (64, 48))
        for _ in range(3):
            video.write(np.zeros((48, 64, 3), np.uint8))
        video.release()
    placed = make_camera(R=np.eye(3), t_m=np.zeros(3), K=np.diag([60.0, 60.0, 1.0]), image_size_wh=(64, 48))
    write_rig(tmp_path / "rig.toml", make_rig({"old": placed}))
    (tmp_path / "recording.toml").write_text(
        'version = 1\ncalibration = "rig.toml"\n[cameras.old]\nvideo = "old.avi"\n[cameras.new]\nvideo = "new.avi"\n'
    )
    cameras, (number, frames) = open_recorded(open_recording(tmp_path))
    assert [camera.name for camera in cameras] == ["old", "new"]
    np.testing.assert_array_equal(number, [0, 1, 2])
    np.testing.assert_array_equal(frames, [[0, 0], [1, 1], [2, 2]])


def test_a_camera_that_never_sees_the_board(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        for number in range(2):
            image = (
                draw_board(BOARD, K, pose(number), SIZE_WH) if name == "a" else np.zeros((480, 640), np.uint8)
            )
            cv2.imwrite(str(tmp_path / name / f"{number}.png"), image)
    cameras = open_images([tmp_path / "a", tmp_path / "b"])
    with pytest.raises(InputError, match=r"camera b: expected views of the board .* found none in 2 frames"):
        find_views(BOARD, cameras, instants_of_numbers(cameras))


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
    rms_px = np.sqrt(np.mean(calibrated.residual_px[calibrated.used] ** 2))
    assert rms_px < 0.24


def test_the_advice_for_a_video_that_ends_early_needs_no_option_of_other_commands(tmp_path):
    for name in ("left", "right"):
        with VideoWriter(tmp_path / f"{name}.avi", 25.0, SIZE_WH) as writer:
            for number in range(12):
                image = draw_board(BOARD, K, pose(number % 6), SIZE_WH)
                writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    path = tmp_path / "right.avi"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    words = ["rig", str(tmp_path / "left.avi"), str(path), "--squares", "4x6", "--square", "0.04"]
    with pytest.raises(InputError) as error:
        CliRunner().invoke(
            calibrate,
            [*words, "--marker", "0.03", "--dictionary", "4x4_50", "--out", str(tmp_path / "rig.toml")],
            catch_exceptions=False,
        )
    assert re.search(
        r"right\.avi: expected 12 frames, .*`ffmpeg -i right\.avi -frames:v \d+ -c copy", str(error.value)
    )
    assert "--frames" not in str(error.value)


@pytest.mark.slow
def test_any_frame_of_a_long_video_may_be_the_floor(tmp_path):
    """More than 300 frames are not all searched, which a line says; the frame of --floor always is."""
    for name, x_m in (("left", 0.0), ("right", 0.1)):
        with VideoWriter(tmp_path / f"{name}.avi", 25.0, SIZE_WH) as writer:
            for number in range(306):
                T = pose(number // 20 % 8)
                T[0, 3] -= x_m
                image = draw_board(BOARD, K, T, SIZE_WH)
                writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    paths = [str(tmp_path / f"{name}.avi") for name in ("left", "right")]
    words = [
        "rig",
        *paths,
        "--squares",
        "4x6",
        "--square",
        "0.04",
        "--marker",
        "0.03",
        "--dictionary",
        "4x4_50",
    ]
    out = tmp_path / "rig.toml"
    ran = CliRunner().invoke(calibrate, [*words, "--lens", "0", "--floor", "45", "--out", str(out)])
    assert ran.exit_code == 0, ran.output
    assert "left 154 of 306, right 154 of 306" in " ".join(ran.output.split())
    T_cam_board = pose(45 // 20)
    np.testing.assert_allclose(read_rig(out).cameras.T_cam_world[0, :3, 3], T_cam_board[:3, 3], atol=0.01)


@pytest.mark.slow
def test_the_command(tmp_path, caplog):
    """Two folders of drawn images, from the command line to the rig; and what the command refuses."""
    baseline = np.eye(4)
    baseline[0, 3] = -0.1
    for name, T in (("left", np.eye(4)), ("right", baseline)):
        (tmp_path / name).mkdir()
        for number in range(8):
            image = draw_board(BOARD, K, T @ pose(number), SIZE_WH)
            cv2.imwrite(str(tmp_path / name / f"{number}.png"), 255 - image)
    board = (
        "--squares",
        "4x6",
        "--square",
        "0.04",
        "--marker",
        "0.03",
        "--dictionary",
        "4x4_50",
        "--lens",
        "0",
    )
    paths = (str(tmp_path / "left"), str(tmp_path / "right"))
    out = tmp_path / "rig.toml"
    result = CliRunner().invoke(calibrate, ["rig", *paths, *board, "--out", str(out), "--json", "-"])
    assert result.exit_code == 0, result.output
    content = json.loads(result.stdout)
    assert content["print"] == []
    known = {"squares": (4, 6), "square_m": 0.04, "marker_m": 0.03, "dictionary": "4x4_50", "lens": "0"}
    found = pt.calibrate_rig(paths, **known, out=out, force=True)
    assert json.loads(json.dumps(found.to_dict())) == content
    assert "the world is camera left" in str(found)
    rig = read_rig(out)
    assert rig.names == ("left", "right")
    np.testing.assert_allclose(rig.cameras.centre_world, [[0, 0, 0], [0.1, 0, 0]], atol=0.005)
    other = ["--out", str(tmp_path / "other.toml")]
    CliRunner().invoke(calibrate, ["rig", *paths, *board[:-1], "auto", *other])
    assert (
        "camera left: lens models are compared by at least 9 views, found 8: it gets the usual" in caplog.text
    )
    other = ["--out", str(tmp_path / "another.toml")]
    for arguments, message in (
        ([*paths, *other], "expected one of --square, --squares, --points, --pairs, --markers"),
        ([paths[0], paths[0], *board, *other], "expected each camera once"),
        ([*paths, *board, "--floor", "99", *other], "the nearest one is 7"),
    ):
        result = CliRunner().invoke(calibrate, ["rig", *arguments])
        assert isinstance(result.exception, PsotrackError)
        assert message in str(result.exception)
