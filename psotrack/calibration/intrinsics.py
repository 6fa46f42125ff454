"""Intrinsics of a camera, from its data sheet, or from a video in which a ChArUco board is moved.

The calibration is Z. Zhang's method (PAMI 22(11), 2000) as implemented in OpenCV, with the coefficients k1, k2, p1, p2.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int

from psotrack.detection import marker_dictionary
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
#: Largest standard deviation of the focal length, as a share of the focal length.
_MAX_FOCAL_ERROR = 0.02
#: Smallest angle between the planes of the board in the two views that differ most, degrees: views of parallel boards
#: do not determine the focal length.
_MIN_TILT_DEG = 10.0
#: Largest focal length, in image widths: 20 widths are a field of view of 3 degrees.
_MAX_FOCAL_WIDTHS = 20.0


@dataclass(frozen=True)
class Board:
    """A ChArUco board.

    Attributes:
        squares_wh: columns and rows of squares.
        square_m: side of a square in metres.
        marker_m: side of a marker in metres.
        dictionary: name of the markers' dictionary, such as 4x4_50.
    """

    squares_wh: tuple[int, int]
    square_m: float
    marker_m: float
    dictionary: str = "4x4_50"

    def __post_init__(self) -> None:
        if min(self.squares_wh) < 3:
            raise SettingsError(
                "board.squares_wh", expected="at least 3 x 3 squares", found=f"{self.squares_wh}"
            )
        check_positive("board.square_m", self.square_m)
        if not 0 < self.marker_m < self.square_m:
            raise SettingsError(
                "board.marker_m", expected="a side above 0 and below the square's", found=f"{self.marker_m:g}"
            )

    def opencv(self) -> cv2.aruco.CharucoBoard:
        """The board as an object of OpenCV."""
        return cv2.aruco.CharucoBoard(
            self.squares_wh, self.square_m, self.marker_m, marker_dictionary(self.dictionary)
        )


@dataclass(frozen=True)
class Lens:
    """Intrinsics from a video, with standard deviations and residuals.

    Attributes:
        camera: intrinsics; the pose is the world's origin.
        std: (8,), standard deviations of fx, fy, cx, cy in pixels, and of k1, k2, p1, p2.
        frame: (views,), numbers of the frames that were used.
        residual_px: (views,), root mean square reprojection error of each view, pixels.
    """

    camera: Camera
    std: Float[np.ndarray, "8"]
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


def lens_of_board(video: VideoInfo, board: Board) -> Lens:
    """Estimate the lens of a camera from a video in which a ChArUco board is moved.

    The views that differ most in the position, size and tilt of the board are used.

    Raises:
        InputError: the video cannot be read, too few views show enough corners of the board, or the views differ too
            little to determine the focal length.
        SettingsError: the dictionary does not exist.
    """
    model = board.opencv()
    views = _find_views(video, model)
    if len(views) < _MIN_VIEWS:
        raise InputError(
            video.path,
            expected=f"at least {_MIN_VIEWS} frames that show {_MIN_CORNERS} corners of the board",
            found=f"{len(views)}",
            remedy="check that squares, dictionary and markers are those of the printed board",
        )
    chosen = _choose_spread([view.outline for view in views], _MOST_VIEWS)
    used = [views[index] for index in sorted(chosen)]
    rms, K, dist, turns, _, std, _, per_view = cv2.calibrateCameraExtended(
        [view.points_m for view in used],
        [view.points_px for view in used],
        video.image_size_wh,
        np.eye(3),
        np.zeros(5),
        flags=cv2.CALIB_FIX_K3,
    )
    std = np.asarray(std, np.float64).ravel()[:8]
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
            dist=dist.ravel()[:4].tolist(),
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


def _find_views(video: VideoInfo, model: cv2.aruco.CharucoBoard) -> list[_View]:
    """Find the frames that show enough corners of the board."""
    detector = cv2.aruco.CharucoDetector(model)
    columns, rows = model.getChessboardSize()
    side = model.getSquareLength()
    corners_m = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]], np.float64) * side
    step = max(1, video.num_frames // _MOST_FRAMES)
    views = []
    for index, frame in enumerate(read_frames(video, step)):
        corners, ids, _, _ = detector.detectBoard(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY))
        if ids is None or len(ids) < _MIN_CORNERS:
            continue
        points_m = np.asarray(model.getChessboardCorners())[ids.ravel()][:, None]
        points_px = np.asarray(corners).reshape(-1, 1, 2)
        homography, _ = cv2.findHomography(points_m[:, 0, :2], points_px[:, 0])
        if homography is None:
            # All corners are on one line.
            continue
        outline = cv2.perspectiveTransform(corners_m[:, None], homography)[:, 0] / video.image_size_wh
        views.append(_View(index * step, points_m, points_px, outline.ravel()))
    return views


def _choose_spread(outlines: list[Float[np.ndarray, "8"]], count: int) -> list[int]:
    """Choose views that differ most: each next view is the farthest from the views chosen before."""
    outline = np.array(outlines)
    # The first view is the farthest from the median of all views.
    chosen = [int(np.linalg.norm(outline - np.median(outline, axis=0), axis=1).argmax())]
    distance = np.linalg.norm(outline - outline[chosen[0]], axis=1)
    while len(chosen) < min(count, len(outline)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(outline - outline[chosen[-1]], axis=1))
    return chosen


def _undistorted_camera(focal_length_px: Float[np.ndarray, "2"], image_size_wh: tuple[int, int]) -> Camera:
    # Pixel centres are at whole numbers, so the middle of the image is (size - 1) / 2.
    cx, cy = (np.array(image_size_wh) - 1) / 2
    K = np.array([[focal_length_px[0], 0.0, cx], [0.0, focal_length_px[1], cy], [0.0, 0.0, 1.0]])
    return make_camera(R=np.eye(3), t_m=np.zeros(3), K=K, image_size_wh=image_size_wh)
