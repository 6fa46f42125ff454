"""Intrinsics of a camera, from its data sheet, or from a video in which a board is moved.

The calibration is the adjustment of a rig (`rig.adjustment`) with one camera, so both know the same boards and lenses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from psotrack.calibration.boards import Board
from psotrack.calibration.lens_models import LensModel
from psotrack.calibration.rig.adjustment import LensChoice, calibrate_rig
from psotrack.calibration.rig.images import CameraImages, instants_of_numbers
from psotrack.calibration.rig.lens_choice import MOST_FITS, choose_lens_model
from psotrack.calibration.rig.views import find_views
from psotrack.errors import InputError, SettingsError
from psotrack.geometry import Camera, make_camera
from psotrack.support import Report, no_progress

#: Names of the distortion coefficients in OpenCV's order.
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
_FISHEYE = ("k1", "k2", "k3", "k4")
#: Smallest number of views: fewer views determine k1, k2, p1, p2 badly.
_MIN_VIEWS = 8
#: Largest standard deviation of the focal length, as a fraction of the focal length.
_MAX_FOCAL_ERROR = 0.02
#: Smallest angle between the planes of the board in the two views that differ most, degrees: views of parallel boards
#: do not determine the focal length.
_MIN_TILT_DEG = 10.0
#: Largest focal length, in image widths: 20 widths are a field of view of 3 degrees.
_MAX_FOCAL_WIDTHS = 20.0


@dataclass(frozen=True)
class Lens:
    """Intrinsics from a video, with standard deviations and residuals.

    Attributes:
        camera: intrinsics; the pose is the world's origin.
        model: model of the lens.
        compared_px: median error of each model that was compared, on views left out, pixels; none if it was stated.
        std: (4 + coefficients,), standard deviations of fx, fy, cx, cy in pixels, and of the distortion coefficients.
        frame: (views,), numbers of the frames that were used.
        residual_px: (views,), root mean square reprojection error of each view, pixels.
        searched: number of frames that were searched for the board.
    """

    camera: Camera
    model: LensModel
    compared_px: dict[str, float]
    std: Float[np.ndarray, " unknowns"]
    frame: Int[np.ndarray, " views"]
    residual_px: Float[np.ndarray, " views"]
    searched: int

    def to_dict(self) -> dict[str, Any]:
        """The values of the lens by name, their standard deviations, and the residuals."""
        K, dist = self.camera.K, np.asarray(self.camera.dist)[: self.model.coefficients]
        known = _FISHEYE if self.model.fisheye else _COEFFICIENTS
        names = ("fx_px", "fy_px", "cx_px", "cy_px", *known[: self.model.coefficients])
        values = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *dist]
        return {
            "model": str(self.model),
            "compared_px": self.compared_px,
            "values": dict(zip(names, map(float, values), strict=True)),
            "std": dict(zip(names, map(float, self.std), strict=True)),
            "frames": self.frame.tolist(),
            "residual_px": self.residual_px.tolist(),
        }


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
    focal_length_px = np.array(image_size_wh) / 2 / np.tan(np.deg2rad(angles_deg) / 2)
    # Pixel centres are at whole numbers, so the middle of the image is (size - 1) / 2.
    cx, cy = (np.array(image_size_wh) - 1) / 2
    K = np.array([[focal_length_px[0], 0.0, cx], [0.0, focal_length_px[1], cy], [0.0, 0.0, 1.0]])
    return make_camera(R=np.eye(3), t_m=np.zeros(3), K=K, image_size_wh=image_size_wh)


def lens_of_board(
    images: CameraImages, board: Board, model: LensModel | None = None, report: Report = no_progress
) -> Lens:
    """Estimate the lens of a camera from images in which a board is moved.

    Args:
        images: the video or the images.
        board: the board; how it was printed is found out.
        model: model of the lens; None to choose it by views left out. More coefficients need views in all corners of
            the image.
        report: display of the progress.

    Raises:
        InputError: the images cannot be read, too few views show enough corners of the board, or the views differ too
            little to determine the focal length.
        SettingsError: the dictionary does not exist.
    """
    found = find_views(board, (images,), instants_of_numbers((images,)), report)
    board = found.board
    views = found.views.select(found.views.seen[0])
    if len(views.number) < _MIN_VIEWS:
        raise InputError(
            images.path,
            expected=f"at least {_MIN_VIEWS} frames that show {board.least_corners} corners of the board",
            found=f"{len(views.number)}",
            remedy="move the board nearer, and hold it still for a moment in each place",
        )
    compared_px: dict[str, float] = {}
    if model is None:
        with report("lens", MOST_FITS) as advance:
            comparison = choose_lens_model(board, views.corners_px[0], images.image_size_wh, advance)
        model, compared_px = comparison.model, comparison.error_px
    calibrated = calibrate_rig(board, views, LensChoice(model), report=report)
    camera, std = calibrated.rig.cameras[0], calibrated.lens_std[0]
    used = calibrated.used[0]
    is_good = used.any(axis=1)
    focal_px = np.diag(np.asarray(camera.K))[:2]
    # Boards that are all parallel to the image fit every focal length, and its stated deviation is then meaningless.
    normals = calibrated.T_world_board[is_good, :3, 2]
    tilt_deg = np.rad2deg(np.arccos(np.clip((normals @ normals.T).min(), -1, 1)))
    # The estimated tilts are meaningless too if the fit diverged to a very large focal length.
    diverged = focal_px[0] > _MAX_FOCAL_WIDTHS * images.image_size_wh[0]
    uncertain = not (std[:2] < _MAX_FOCAL_ERROR * focal_px).all()
    if diverged or tilt_deg < _MIN_TILT_DEG or uncertain:
        raise InputError(
            images.path,
            expected=f"views that determine the focal length to {_MAX_FOCAL_ERROR:.0%}",
            found=f"boards whose tilts differ by at most {tilt_deg:.0f} degrees, error {std[0] / focal_px[0]:.1%}",
            remedy="tilt the board, and move it into all corners of the image",
        )
    squares = np.where(used, calibrated.residual_px[0], 0.0) ** 2
    rms_px = np.sqrt(squares.sum(axis=1)[is_good] / used.sum(axis=1)[is_good])
    return Lens(camera, model, compared_px, std, views.number[is_good], rms_px, int(found.searched[0]))
