"""Fields of one camera in a rig file, under any of the names that calibration programs use, and their checks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError
from psotrack.geometry import FISHEYE_COEFFICIENTS, PINHOLE_COEFFICIENTS, Camera, make_camera
from psotrack.geometry.rig_files.entries import Entry
from psotrack.support import LARGEST

#: Largest element of |R Rᵀ - I| in a rotation matrix that is taken for rounded and made orthogonal: matrices written
#: with four decimals pass.
_ROTATION_TOLERANCE = 1e-3

MATRIX = ("matrix", "K", "camera_matrix", "cameraMatrix", "intrinsic_matrix", "K-matrix")
DISTORTION = ("distortions", "distortion", "D", "dist", "distortion_coefficients", "distCoeffs", "distCoeff")
ROTATION = ("rotation", "R", "rvec", "rotation_matrix")
TRANSLATION = ("translation", "t", "T", "tvec")
_SIZE = ("size", "image_size", "imageSize", "resolution")


@dataclass(frozen=True)
class CameraFields:
    """The fields of one camera in a file.

    Attributes:
        path: path of the file.
        place: name of the camera's table in the file, for messages.
        values: values by field name.
    """

    path: Path
    place: str
    values: Mapping[str, Any]

    def error(self, name: str, expected: str, found: str, remedy: str = "") -> InputError:
        """Error whose message names the file and the field."""
        place = f"{self.place}.{name}" if self.place else name
        return InputError(f"{self.path}, {place}", expected=expected, found=found, remedy=remedy)

    def first(self, *names: str) -> str | None:
        """First of these fields that has a value, or None.

        Text counts as no value except in the field `name`, because caliscope wrote "null" for missing values.
        """
        present = (name for name in names if self.values.get(name) is not None)
        return next(
            (name for name in present if not isinstance(self.values[name], str) or name == "name"), None
        )

    def array(self, names: tuple[str, ...], *shapes: tuple[int, ...]) -> Float[np.ndarray, "..."]:
        """Value of the first of these fields, as an array of finite numbers.

        Args:
            names: names that programs use for the field.
            shapes: allowed shapes; -1 stands for any length.
        """
        name = self.first(*names)
        expected = " or ".join(_words(shape) for shape in shapes)
        if name is None:
            raise self.error(" or ".join(names[:3]), expected, "none")
        try:
            array = np.array(self.values[name], np.float64)
        except (TypeError, ValueError):
            raise self.error(name, expected, quoted(self.values[name])) from None
        # OpenCV writes vectors as matrices with one column or one row.
        squeezed = array.ravel() if array.ndim == 2 and 1 in array.shape else array
        for shape in shapes:
            if squeezed.ndim == len(shape) and all(
                want in (-1, have) for want, have in zip(shape, squeezed.shape, strict=True)
            ):
                if not (np.abs(squeezed) <= LARGEST).all():
                    raise self.error(name, "finite numbers", quoted(self.values[name]))
                return squeezed
        raise self.error(name, expected, " x ".join(map(str, array.shape)) or quoted(self.values[name]))


def entry_from_fields(fields: CameraFields, image_size_wh: tuple[int, int] | None) -> Entry:
    """The camera that these fields describe.

    A camera without rotation and translation is not placed; a camera that has no lens either was never calibrated.

    Args:
        fields: fields of the camera.
        image_size_wh: width and height in pixels, if the fields have none.

    Raises:
        InputError: a field is missing or wrong.
    """
    placed = fields.first(*ROTATION) is not None or fields.first(*TRANSLATION) is not None
    if not placed and fields.first(*MATRIX, *DISTORTION) is None:
        return Entry(None, placed=False)
    return Entry(camera_from_fields(fields, image_size_wh, placed=placed), placed)


def camera_from_fields(
    fields: CameraFields, image_size_wh: tuple[int, int] | None, *, placed: bool
) -> Camera:
    """Make a camera from its fields; the translation stays in the file's unit.

    Args:
        fields: fields of the camera.
        image_size_wh: width and height in pixels, if the fields have none.
        placed: read the camera's pose; if not, the camera stands at the world's origin.

    Raises:
        InputError: a field is missing or wrong.
    """
    K = intrinsics(fields)
    fisheye = is_fisheye(fields)
    dist = distortion(fields, fisheye=fisheye)
    R, t = np.eye(3), np.zeros(3)
    if placed:
        R, t = rotation(fields), fields.array(TRANSLATION, (3,))
    size = image_size(fields, image_size_wh)
    return make_camera(R=R, t_m=t, K=K, dist=dist.tolist(), image_size_wh=size, fisheye=fisheye)


def lens_model(camera: Camera) -> tuple[list[float], bool]:
    """The distortion coefficients of one camera, and whether it is a fisheye; a fisheye has four."""
    fisheye = camera.fisheye is not None and bool(camera.fisheye)
    coefficients = camera.dist.tolist()
    return (coefficients[:FISHEYE_COEFFICIENTS] if fisheye else coefficients), fisheye


def intrinsics(fields: CameraFields) -> Float[np.ndarray, "3 3"]:
    """The 3 x 3 matrix of the intrinsics, scaled so that its last element is 1."""
    K = fields.array(MATRIX, (3, 3))
    if not (K[0, 0] > 0 and K[1, 1] > 0 and K[1, 0] == 0 and np.array_equal(K[2], [0, 0, 1])):
        raise fields.error(
            str(fields.first(*MATRIX)),
            "intrinsics [[fx, s, cx], [0, fy, cy], [0, 0, 1]], fx and fy above 0",
            quoted(K.tolist()),
        )
    return K


def is_fisheye(fields: CameraFields) -> bool:
    """Whether the fields name OpenCV's fisheye model."""
    model = fields.values.get("model") or fields.values.get("distortion_model")
    if isinstance(model, str):
        return model.lower() in {"fisheye", "equidistant", "kannala_brandt"}
    return bool(fields.values.get("fisheye") or fields.values.get("fisheye_model"))


def distortion(fields: CameraFields, *, fisheye: bool) -> Float[np.ndarray, " coefficients"]:
    """The distortion coefficients in OpenCV's order; none if the field is missing."""
    name = fields.first(*DISTORTION)
    if name is None:
        return np.zeros(FISHEYE_COEFFICIENTS if fisheye else 0)
    given = fields.values[name]
    dist = np.zeros(0) if isinstance(given, list) and not given else fields.array(DISTORTION, (-1,))
    if fisheye and not dist[FISHEYE_COEFFICIENTS:].any():
        dist = np.pad(dist[:FISHEYE_COEFFICIENTS], (0, 0 if dist.size else FISHEYE_COEFFICIENTS))
    allowed = (FISHEYE_COEFFICIENTS,) if fisheye else PINHOLE_COEFFICIENTS
    if dist.size not in allowed:
        what = "coefficients of a fisheye" if fisheye else "coefficients"
        raise fields.error(name, f"{', '.join(map(str, allowed))} {what}", f"{dist.size}")
    return dist


def rotation(fields: CameraFields) -> Float[np.ndarray, "3 3"]:
    """The rotation matrix of a field that holds a Rodrigues vector or a matrix."""
    turn = fields.array(ROTATION, (3,), (3, 3))
    if turn.ndim == 1:
        return Rotation.from_rotvec(turn).as_matrix()
    return rotation_matrix(turn, fields, str(fields.first(*ROTATION)))


def rotation_matrix(
    turn: Float[np.ndarray, "3 3"], fields: CameraFields, name: str
) -> Float[np.ndarray, "3 3"]:
    """A matrix of the field `name`, checked; the nearest rotation if its digits are rounded."""
    off = np.abs(turn @ turn.T - np.eye(3)).max()
    if off > _ROTATION_TOLERANCE or np.linalg.det(turn) < 0:
        remedy = "its axes are mirrored" if np.linalg.det(turn) < 0 else ""
        raise fields.error(name, "a rotation matrix", quoted(turn.tolist()), remedy)
    if off < 1e-12:
        return turn
    left, _, right = np.linalg.svd(turn)
    return left @ right


def image_size(fields: CameraFields, image_size_wh: tuple[int, int] | None) -> tuple[int, int]:
    """Width and height in pixels: the camera's own, or else the given ones."""
    if name := fields.first(*_SIZE):
        sides = fields.array(_SIZE, (2,))
    elif fields.first("image_width") and fields.first("image_height"):
        name = "image_width"
        sides = np.array([fields.array((f"image_{side}",), ()) for side in ("width", "height")])
    elif fields.first("image_shape"):
        # NumPy's shape of an image: rows before columns.
        name = "image_shape"
        sides = fields.array(("image_shape",), (2,), (3,))[1::-1]
    elif image_size_wh is not None:
        return image_size_wh
    else:
        raise fields.error("size or image_size", "width and height of the images", "none", "pass --size")
    if (sides < 1).any() or (sides != np.round(sides)).any():
        raise fields.error(name, "whole numbers of pixels above 0", quoted(sides.tolist()))
    return int(sides[0]), int(sides[1])


def quoted(value: Any) -> str:
    """A value as text for a message, not longer than 60 characters."""
    text = str(value).replace("\n", " ")
    return text if len(text) <= 60 else f"{text[:60]}..."


def _words(shape: tuple[int, ...]) -> str:
    if not shape:
        return "a number"
    return "numbers" if -1 in shape else f"{' x '.join(map(str, shape))} numbers"
