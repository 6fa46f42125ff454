"""Intrinsics of a camera, from its data sheet, or from a video in which a ChArUco board is moved.

The calibration is Z. Zhang's method (PAMI 22(11), 2000) as implemented in OpenCV, with 4 to 14 distortion coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from psotrack.calibration.board_corners import choose_spread, outline_of
from psotrack.calibration.board_recognition import explain_missing_board, recognise_board
from psotrack.calibration.boards import Board
from psotrack.errors import InputError, SettingsError, check_positive
from psotrack.geometry import Camera, make_camera
from psotrack.recordings import VideoInfo, read_frames

#: Smallest number of views: fewer views determine k1, k2, p1, p2 badly.
_MIN_VIEWS = 8
#: Smallest number of corners in a view: fewer corners determine the board's pose badly.
_MIN_CORNERS = 8
#: Largest number of views that are used: more views add little, because the chosen views differ most.
_MOST_VIEWS = 40
#: Largest number of frames in which the board is searched; limits the time for long videos.
_MOST_FRAMES = 300
#: Number of frames from which it is found out how the board was printed.
_MOST_SAMPLES = 12
#: Largest standard deviation of the focal length, as a share of the focal length.
_MAX_FOCAL_ERROR = 0.02
#: Smallest angle between the planes of the board in the two views that differ most, degrees: views of parallel boards
#: do not determine the focal length.
_MIN_TILT_DEG = 10.0
#: OpenCV's flags by the number of distortion coefficients.
_FLAGS = {
    4: cv2.CALIB_FIX_K3,
    5: 0,
    8: cv2.CALIB_RATIONAL_MODEL,
    12: cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL,
    14: cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL | cv2.CALIB_TILTED_MODEL,
}
#: Largest focal length, in image widths: 20 widths are a field of view of 3 degrees.
_MAX_FOCAL_WIDTHS = 20.0


@dataclass(frozen=True)
class Lens:
    """Intrinsics from a video, with standard deviations and residuals.

    Attributes:
        camera: intrinsics; the pose is the world's origin.
        std: (4 + coefficients,), standard deviations of fx, fy, cx, cy in pixels, and of the distortion coefficients.
        frame: (views,), numbers of the frames that were used.
        residual_px: (views,), root mean square reprojection error of each view, pixels.
    """

    camera: Camera
    std: Float[np.ndarray, " unknowns"]
    frame: Int[np.ndarray, " views"]
    residual_px: Float[np.ndarray, " views"]


def lens_of_view(horizontal_deg: float, vertical_deg: float, image_size_wh: tuple[int, int]) -> Camera:
    """Make a lens without distortion from its field of view, from edge to edge of the image.

    The pose of the camera is the world's origin.

    Raises:
        SettingsError: an angle is not between 0 and 180 degrees.
    """
    angles_deg = np.array([horizontal_deg, vertical_deg])
    if not ((angles_deg > 0) & (angles_deg < 180)).all():
        raise SettingsError(
            "field of view", expected="angles between 0 and 180 degrees", found=f"{angles_deg.tolist()}"
        )
    return _undistorted_camera(
        np.array(image_size_wh) / 2 / np.tan(np.deg2rad(angles_deg) / 2), image_size_wh
    )


def lens_of_sensor(
    focal_length_mm: float, sensor_mm: tuple[float, float], image_size_wh: tuple[int, int]
) -> Camera:
    """Make a lens without distortion from its focal length and the sensor's width and height.

    The pose of the camera is the world's origin.

    Raises:
        SettingsError: a length is not above 0.
    """
    for name, length_mm in zip(
        ("focal_length_mm", "sensor_mm", "sensor_mm"), (focal_length_mm, *sensor_mm), strict=True
    ):
        check_positive(name, length_mm)
    return _undistorted_camera(focal_length_mm * np.array(image_size_wh) / np.array(sensor_mm), image_size_wh)


def lens_of_board(video: VideoInfo, board: Board, coefficients: int = 4) -> Lens:
    """Estimate the lens of a camera from a video in which a ChArUco board is moved.

    The views that differ most in the position, size and tilt of the board are used.

    Args:
        video: the video.
        board: the board.
        coefficients: number of distortion coefficients in OpenCV's order: 4, 5, 8, 12 or 14. More coefficients need
            views in all corners of the image.

    Raises:
        InputError: the video cannot be read, too few views show enough corners of the board, or the views differ too
            little to determine the focal length.
        SettingsError: the dictionary does not exist, or no model has this number of coefficients.
    """
    if coefficients not in _FLAGS:
        expected = f"one of {', '.join(map(str, _FLAGS))}"
        raise SettingsError("coefficients", expected=expected, found=f"{coefficients}")
    board.opencv()
    views = _find_views(video, board)
    if len(views) < _MIN_VIEWS:
        raise InputError(
            video.path,
            expected=f"at least {_MIN_VIEWS} frames that show {_MIN_CORNERS} corners of the board",
            found=f"{len(views)}",
            remedy="check that squares, dictionary and markers are those of the printed board",
        )
    chosen = choose_spread(np.array([view.outline for view in views]), _MOST_VIEWS)
    used = [views[index] for index in sorted(chosen)]
    rms, K, dist, turns, _, std, _, per_view = cv2.calibrateCameraExtended(
        [view.points_m for view in used],
        [view.points_px for view in used],
        video.image_size_wh,
        np.eye(3),
        np.zeros(max(coefficients, 5)),
        flags=_FLAGS[coefficients],
    )
    std = np.asarray(std, np.float64).ravel()[: 4 + coefficients]
    # Boards that are all parallel to the image fit every focal length, and its stated deviation is then meaningless.
    normals = np.array([cv2.Rodrigues(turn)[0][:, 2] for turn in turns])
    tilt_deg = np.rad2deg(np.arccos(np.clip((normals @ normals.T).min(), -1, 1)))
    # The estimated tilts are meaningless too if the fit diverged to a very large focal length.
    diverged = K[0, 0] > _MAX_FOCAL_WIDTHS * video.image_size_wh[0]
    uncertain = not (std[:2] < _MAX_FOCAL_ERROR * np.diag(K)[:2]).all()
    if not np.isfinite(rms) or diverged or tilt_deg < _MIN_TILT_DEG or uncertain:
        raise InputError(
            video.path,
            expected=f"views that determine the focal length to {_MAX_FOCAL_ERROR:.0%}",
            found=f"boards whose tilts differ by at most {tilt_deg:.0f} degrees, error {std[0] / K[0, 0]:.1%}",
            remedy="tilt the board, and move it into all corners of the image",
        )
    return Lens(
        make_camera(
            R=np.eye(3),
            t_m=np.zeros(3),
            K=K,
            dist=dist.ravel()[:coefficients].tolist(),
            image_size_wh=video.image_size_wh,
        ),
        std,
        np.array([view.frame for view in used]),
        np.asarray(per_view, np.float64).ravel(),
    )


@dataclass(frozen=True)
class _View:
    """Corners of the board in one frame.

    Attributes:
        frame: number of the frame.
        points_m: (corners, 1, 3), positions on the board, metres.
        points_px: (corners, 1, 2), positions in the image, pixels.
        outline: (8,), positions of the board's four corners, in image widths and heights.
    """

    frame: int
    points_m: np.ndarray
    points_px: np.ndarray
    outline: Float[np.ndarray, "8"]


def _find_views(video: VideoInfo, board: Board) -> list[_View]:
    """Find the frames that show enough corners of the board.

    Raises:
        InputError: the video cannot be read, or does not show this board.
    """
    step = max(1, video.num_frames // _MOST_FRAMES)
    samples = max(1, video.num_frames // _MOST_SAMPLES)
    recognised = recognise_board(board, map(_grey, read_frames(video, samples)))
    if not recognised.views:
        found, remedy = explain_missing_board(board, list(map(_grey, read_frames(video, samples))))
        raise InputError(video.path, expected=f"a {board}", found=found, remedy=remedy)
    finder, views = recognised.finder(), []
    for index, frame in enumerate(read_frames(video, step)):
        corners_px = finder.find(_grey(frame))
        seen = np.isfinite(corners_px[:, 0])
        if seen.sum() < _MIN_CORNERS:
            continue
        outline = outline_of(board, corners_px)
        if outline is not None:
            views.append(
                _View(
                    index * step,
                    board.corners_m[seen][:, None].astype(np.float32),
                    corners_px[seen][:, None].astype(np.float32),
                    outline / np.tile(video.image_size_wh, 4),
                )
            )
    return views


def _grey(frame: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "height width"]:
    return np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY))


def _undistorted_camera(focal_length_px: Float[np.ndarray, "2"], image_size_wh: tuple[int, int]) -> Camera:
    # Pixel centres are at whole numbers, so the middle of the image is (size - 1) / 2.
    cx, cy = (np.array(image_size_wh) - 1) / 2
    K = np.array([[focal_length_px[0], 0.0, cx], [0.0, focal_length_px[1], cy], [0.0, 0.0, 1.0]])
    return make_camera(R=np.eye(3), t_m=np.zeros(3), K=K, image_size_wh=image_size_wh)
