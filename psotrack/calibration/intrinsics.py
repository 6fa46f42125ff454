"""Intrinsics: from what a data sheet says, and from a video of a ChArUco board that is moved about.

The calibration is Z. Zhang's (PAMI 22(11), 2000), as OpenCV has it, with k1, k2, p1, p2.
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

#: Views that a calibration needs: fewer fix k1, k2, p1, p2 badly.
_MIN_VIEWS = 8
#: Corners that a view needs: with fewer the board's own pose is loose.
_MIN_CORNERS = 8
#: Views that are used; more do not tell more, once they are spread.
_MOST_VIEWS = 40
#: Frames that boards are sought in.
_MOST_FRAMES = 300
#: Share of the focal length that its standard deviation may be.
_LOOSE = 0.02
#: What two of the boards must differ by.
_TILTED_DEG = 10.0
#: Widths of an image that a focal length may be: 20 are a field of view of 3 degrees.
_MOST_WIDTHS = 20.0


@dataclass(frozen=True)
class Board:
    """A ChArUco board.

    Attributes:
        squares_wh: columns and rows of squares.
        square_m: side of a square in metres.
        marker_m: side of a marker in metres.
        dictionary: of its markers, such as 4x4_50.
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
        """The board as OpenCV knows it."""
        return cv2.aruco.CharucoBoard(
            self.squares_wh, self.square_m, self.marker_m, marker_dictionary(self.dictionary)
        )


@dataclass(frozen=True)
class Lens:
    """Intrinsics from a video, and how well they fit.

    Attributes:
        camera: at the world's origin.
        std: (8,), standard deviations of fx, fy, cx, cy in pixels, and of k1, k2, p1, p2.
        frame: (views,), numbers of the frames that were used.
        residual_px: (views,), root mean square reprojection error of each.
    """

    camera: Camera
    std: Float[np.ndarray, "8"]
    frame: Int[np.ndarray, " views"]
    residual_px: Float[np.ndarray, " views"]


def lens_of_view(horizontal_deg: float, vertical_deg: float, image_size_wh: tuple[int, int]) -> Camera:
    """A lens without distortion from its field of view, from edge to edge of the image; at the world's origin.

    Raises:
        SettingsError: an angle is not between 0 and 180 degrees.
    """
    angles_deg = np.array([horizontal_deg, vertical_deg])
    if not ((angles_deg > 0) & (angles_deg < 180)).all():
        raise SettingsError(
            "field of view", expected="angles between 0 and 180 degrees", found=f"{angles_deg.tolist()}"
        )
    return _plain(np.array(image_size_wh) / 2 / np.tan(np.deg2rad(angles_deg) / 2), image_size_wh)


def lens_of_sensor(
    focal_length_mm: float, sensor_mm: tuple[float, float], image_size_wh: tuple[int, int]
) -> Camera:
    """A lens without distortion from its focal length and the sensor's width and height; at the world's origin.

    Raises:
        SettingsError: a length is not above 0.
    """
    for name, length_mm in zip(
        ("focal_length_mm", "sensor_mm", "sensor_mm"), (focal_length_mm, *sensor_mm), strict=True
    ):
        check_positive(name, length_mm)
    return _plain(focal_length_mm * np.array(image_size_wh) / np.array(sensor_mm), image_size_wh)


def lens_of_board(video: VideoInfo, board: Board) -> Lens:
    """The lens of a camera before which a ChArUco board is moved about.

    Of all views those are used that differ most in where, how large and how tilted the board is.

    Raises:
        InputError: the video cannot be read, too few views show enough of the board, or they are too much alike to fix
            the focal length.
        SettingsError: there is no such dictionary.
    """
    model = board.opencv()
    views = _views(video, model)
    if len(views) < _MIN_VIEWS:
        raise InputError(
            video.path,
            expected=f"at least {_MIN_VIEWS} frames that show {_MIN_CORNERS} corners of the board",
            found=f"{len(views)}",
            remedy="is it this board? squares, dictionary and markers must be those that were printed",
        )
    chosen = _spread([view.outline for view in views], _MOST_VIEWS)
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
    # Boards that all face the camera fit every focal length, and the deviation of one is rubbish.
    normals = np.array([cv2.Rodrigues(turn)[0][:, 2] for turn in turns])
    tilted = np.rad2deg(np.arccos(np.clip((normals @ normals.T).min(), -1, 1)))
    # So is their tilt, where the fit ran away to a focal length of hundreds of images.
    endless = K[0, 0] > _MOST_WIDTHS * video.image_size_wh[0]
    loose = not (std[:2] < _LOOSE * np.diag(K)[:2]).all()
    if not np.isfinite(rms) or endless or tilted < _TILTED_DEG or loose:
        raise InputError(
            video.path,
            expected=f"views that fix the focal length to {_LOOSE:.0%}",
            found=f"boards that are tilted by {tilted:.0f} degrees at most, and {std[0] / K[0, 0]:.1%}",
            remedy="tilt the board, and carry it into all corners of the image",
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
    frame: int
    points_m: np.ndarray
    points_px: np.ndarray
    #: (8,), where the board's four corners are, in image sizes.
    outline: Float[np.ndarray, "8"]


def _views(video: VideoInfo, model: cv2.aruco.CharucoBoard) -> list[_View]:
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
            # All corners on one line.
            continue
        outline = cv2.perspectiveTransform(corners_m[:, None], homography)[:, 0] / video.image_size_wh
        views.append(_View(index * step, points_m, points_px, outline.ravel()))
    return views


def _spread(outlines: list[Float[np.ndarray, "8"]], count: int) -> list[int]:
    """Indices of views that are far from one another: each next one is the farthest from those before it."""
    outline = np.array(outlines)
    # The first is the farthest from the middle of all.
    chosen = [int(np.linalg.norm(outline - np.median(outline, axis=0), axis=1).argmax())]
    distance = np.linalg.norm(outline - outline[chosen[0]], axis=1)
    while len(chosen) < min(count, len(outline)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(outline - outline[chosen[-1]], axis=1))
    return chosen


def _plain(focal_length_px: Float[np.ndarray, "2"], image_size_wh: tuple[int, int]) -> Camera:
    # Pixel centres are at whole numbers: the middle of the image is half a pixel from half its size.
    cx, cy = (np.array(image_size_wh) - 1) / 2
    K = np.array([[focal_length_px[0], 0.0, cx], [0.0, focal_length_px[1], cy], [0.0, 0.0, 1.0]])
    return make_camera(R=np.eye(3), t_m=np.zeros(3), K=K, image_size_wh=image_size_wh)
