"""Lenses as vectors of numbers, fx, fy, cx, cy and the distortion, and pixels with derivatives by all of them, float64.

OpenCV projects: its pinhole model with 0 to 14 coefficients, and its fisheye model with four.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError, SettingsError
from psotrack.geometry import (
    FISHEYE_COEFFICIENTS,
    PINHOLE_COEFFICIENTS,
    Camera,
    Rig,
    make_camera,
    make_rig,
    undistort,
)
from psotrack.geometry.rig_files import rescale_lenses
from psotrack.support import whole_number

#: Number of unknowns of a lens before the distortion: fx, fy, cx, cy.
PINHOLE = 4
#: Standard deviations of the distortion coefficients before any view: so wide that they matter only where the views
#: leave a coefficient open. The order is OpenCV's; p1 and p2 are small for every lens, and so is a tilted sensor.
_COEFFICIENT_STD = np.array([1, 1, 0.05, 0.05, 1, 1, 1, 1, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05], np.float64)
#: Standard deviation of the principal point about the image's middle, in image widths, and of log(fx / fy).
_CENTRE_STD, _ASPECT_STD = 0.1, 0.1


@dataclass(frozen=True)
class LensModel:
    """A family of lenses.

    Attributes:
        coefficients: number of distortion coefficients.
        fisheye: whether the lens is OpenCV's fisheye model instead of its pinhole model.
    """

    coefficients: int = 5
    fisheye: bool = False

    def __post_init__(self) -> None:
        known = (FISHEYE_COEFFICIENTS,) if self.fisheye else PINHOLE_COEFFICIENTS
        if self.coefficients not in known:
            raise SettingsError(
                "lens",
                expected=f"one of {', '.join(map(str, known))} coefficients",
                found=f"{self.coefficients}",
            )

    def __str__(self) -> str:
        """The word that `parse_lens_model` reads."""
        return "fisheye" if self.fisheye else f"{self.coefficients}"

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return PINHOLE + self.coefficients

    def start(self, focal_px: float, image_size_wh: tuple[int, int]) -> Float[np.ndarray, " unknowns"]:
        """A lens without distortion whose principal point is the image's middle."""
        # Pixel centres are at whole numbers.
        middle = (np.array(image_size_wh) - 1) / 2
        return np.concatenate([[focal_px, focal_px], middle, np.zeros(self.coefficients)])

    def project(
        self, lens: Float[np.ndarray, " unknowns"], points_m: Float[np.ndarray, "points 3"]
    ) -> tuple[
        Float[np.ndarray, "points 2"], Float[np.ndarray, "points 2 3"], Float[np.ndarray, "points 2 unknowns"]
    ]:
        """Pixels of points in the camera's axes, and their derivatives by the points and by the lens."""
        points_m = np.ascontiguousarray(points_m)[:, None]
        still = np.zeros(3)
        K = camera_matrix(lens)
        # The columns of OpenCV's derivatives that are by the shift of the points, and by the lens.
        if self.fisheye:
            pixels, slopes = cv2.fisheye.projectPoints(points_m, still, still, K, lens[PINHOLE:])
            by_shift, by_lens = slice(11, 14), slice(0, 8)
        else:
            dist = lens[PINHOLE:] if self.coefficients else np.zeros(4)
            pixels, slopes = cv2.projectPoints(points_m, still, still, K, dist)
            by_shift, by_lens = slice(3, 6), slice(6, 6 + self.size)
        slopes = np.asarray(slopes, np.float64).reshape(-1, 2, slopes.shape[-1])
        return np.asarray(pixels).reshape(-1, 2), slopes[..., by_shift], slopes[..., by_lens]

    def camera(
        self,
        lens: Float[np.ndarray, " unknowns"],
        T_cam_world: Float[np.ndarray, "4 4"],
        image_size_wh: tuple[int, int] = (1, 1),
    ) -> Camera:
        """The camera with this lens at a pose, whose rotation may have rounding errors."""
        U, _, V = np.linalg.svd(T_cam_world[:3, :3])
        return make_camera(
            R=U @ V,
            t_m=T_cam_world[:3, 3],
            K=camera_matrix(lens),
            image_size_wh=image_size_wh,
            dist=lens[PINHOLE:].tolist(),
            fisheye=self.fisheye,
        )

    def normalise(
        self, lens: Float[np.ndarray, " unknowns"], points_px: Float[np.ndarray, "points 2"]
    ) -> Float[np.ndarray, "points 2"]:
        """Directions (x / z, y / z) in which pixels are seen; NaN where the lens cannot be inverted."""
        # The lens alone counts: the camera's place and the size of its images do not.
        return undistort(self.camera(lens, np.eye(4)), points_px)

    def prior(
        self, image_size_wh: tuple[int, int]
    ) -> tuple[Float[np.ndarray, " unknowns"], Float[np.ndarray, "unknowns unknowns"]]:
        """What is known of a lens before any view: a value of each unknown, and the information about them."""
        information = np.zeros((self.size, self.size))
        width = max(image_size_wh)
        information[[2, 3], [2, 3]] = 1 / (_CENTRE_STD * width) ** 2
        # A difference of the focal lengths, in units of a typical focal length, is the logarithm of their ratio.
        information[:2, :2] = np.array([[1, -1], [-1, 1]]) / (_ASPECT_STD * width) ** 2
        rest = np.arange(PINHOLE, self.size)
        information[rest, rest] = 1 / _COEFFICIENT_STD[: self.coefficients] ** 2
        return self.start(0.0, image_size_wh), information


def camera_matrix(lens: Float[np.ndarray, " unknowns"]) -> Float[np.ndarray, "3 3"]:
    """(3, 3), intrinsics in pixels."""
    fx, fy, cx, cy = lens[:PINHOLE]
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def parse_lens_model(word: str) -> LensModel | None:
    """The model that a word names: a number of coefficients, fisheye, or auto: None, a model chosen by the views.

    Raises:
        SettingsError: there is no such model.
    """
    if word.lower() == "auto":
        return None
    if word.lower() == "fisheye":
        return LensModel(FISHEYE_COEFFICIENTS, fisheye=True)
    count = whole_number(word)
    if count not in PINHOLE_COEFFICIENTS:
        known = ", ".join(map(str, PINHOLE_COEFFICIENTS))
        raise SettingsError("lens", expected=f"auto, fisheye, or one of {known}", found=word)
    return LensModel(count)


def known_lenses(rig: Rig) -> dict[str, tuple[LensModel, np.ndarray]]:
    """Models and vectors of a rig's lenses, by camera.

    Raises:
        SettingsError: a lens has skew, which OpenCV's calibration does not know.
    """
    known = {}
    for index, name in enumerate(rig.names):
        camera = rig.cameras[index]
        K, dist = np.asarray(camera.K), np.asarray(camera.dist)
        if abs(K[0, 1]) > 0:
            raise SettingsError(f"camera {name}", expected="a lens without skew", found=f"{K[0, 1]:g} px")
        is_fisheye = bool(camera.fisheye)
        allowed = (FISHEYE_COEFFICIENTS,) if is_fisheye else PINHOLE_COEFFICIENTS
        size = next((n for n in allowed if n >= len(dist)), allowed[-1])
        padded = np.pad(dist[:size], (0, max(0, size - len(dist))))
        values = np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], padded])
        known[name] = LensModel(size, is_fisheye), values
    return known


def lenses_at_size(path: Path, lenses: Rig, sizes_wh: Mapping[str, tuple[int, int]]) -> Rig:
    """Lenses of a file at the size of the images, where these show the same, enlarged or reduced.

    Args:
        path: the file.
        lenses: its lenses by camera.
        sizes_wh: width and height of the images by camera, pixels, where they are known.

    Raises:
        InputError: images have another shape than those of the calibration.
    """
    cameras = {name: lenses.cameras[index] for index, name in enumerate(lenses.names)}
    cameras = rescale_lenses(path, cameras, sizes_wh)
    for name, size_wh in sizes_wh.items():
        width, height = cameras[name].image_size_wh.astype(int).tolist() if name in cameras else size_wh
        if (width, height) != size_wh:
            raise InputError(
                f"camera {name}",
                expected=f"images of {width} x {height} pixels as in {path}, or of the same shape",
                found="{} x {}".format(*size_wh),
            )
    return make_rig(cameras)


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
    model = LensModel(0)
    lens = model.start(0.0, image_size_wh)
    lens[:2] = np.array(image_size_wh) / 2 / np.tan(np.deg2rad(angles_deg) / 2)
    return model.camera(lens, np.eye(4), image_size_wh)
