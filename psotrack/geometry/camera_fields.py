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
from psotrack.geometry.cameras import Camera, make_camera

#: Largest element of |R Rᵀ - I| in a rotation matrix; matrices written with 8 digits pass.
_ROTATION_TOLERANCE = 1e-6
#: Numbers of OpenCV's distortion coefficients that `psotrack.geometry.cameras` supports.
_COEFFICIENTS = (0, 4, 5, 8)


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
        return InputError(f"{self.path}, {self.place}.{name}", expected=expected, found=found, remedy=remedy)

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
            raise self.error(" or ".join(names), expected, "none")
        try:
            array = np.array(self.values[name], np.float64)
        except (TypeError, ValueError):
            raise self.error(name, expected, _quoted(self.values[name])) from None
        # OpenCV writes vectors as matrices with one column or one row.
        squeezed = array.ravel() if array.ndim == 2 and 1 in array.shape else array
        for shape in shapes:
            if squeezed.ndim == len(shape) and all(
                want in (-1, have) for want, have in zip(shape, squeezed.shape, strict=True)
            ):
                if not np.isfinite(squeezed).all():
                    raise self.error(name, "finite numbers", _quoted(self.values[name]))
                return squeezed
        raise self.error(name, expected, " x ".join(map(str, array.shape)) or _quoted(self.values[name]))


def camera_from_fields(
    fields: CameraFields, image_size_wh: tuple[int, int] | None, metres_per_unit: float, placed: bool
) -> Camera:
    """Make a camera from its fields.

    Args:
        fields: fields of the camera.
        image_size_wh: width and height in pixels, if the fields have none.
        metres_per_unit: length unit of the translation, metres.
        placed: read the camera's pose; if not, the camera stands at the world's origin.

    Raises:
        InputError: a field is missing or wrong.
    """
    if fields.values.get("fisheye"):
        raise fields.error("fisheye", "a lens of OpenCV's pinhole model", "a fisheye")
    dist = np.zeros(0)
    coefficients = ("distortions", "D", "dist", "distortion_coefficients")
    if fields.first(*coefficients):
        dist = fields.array(coefficients, (-1,))
    if dist.size not in _COEFFICIENTS:
        allowed = ", ".join(map(str, _COEFFICIENTS))
        raise fields.error(str(fields.first(*coefficients)), f"{allowed} coefficients", f"{dist.size}")
    K = fields.array(("matrix", "K", "camera_matrix"), (3, 3))
    if not (K[0, 0] > 0 and K[1, 1] > 0 and K[1, 0] == 0 and np.array_equal(K[2], [0, 0, 1])):
        name = str(fields.first("matrix", "K", "camera_matrix"))
        raise fields.error(
            name, "intrinsics [[fx, s, cx], [0, fy, cy], [0, 0, 1]], fx and fy above 0", _quoted(K.tolist())
        )
    R, t_m = np.eye(3), np.zeros(3)
    if placed:
        R = _rotation(fields)
        t_m = fields.array(("translation", "t", "T", "tvec"), (3,)) * metres_per_unit
    return make_camera(
        R=R, t_m=t_m, K=K, dist=dist.tolist(), image_size_wh=_image_size(fields, image_size_wh)
    )


def _rotation(fields: CameraFields) -> Float[np.ndarray, "3 3"]:
    names = ("rotation", "R", "rvec")
    turn = fields.array(names, (3,), (3, 3))
    if turn.ndim == 1:
        return Rotation.from_rotvec(turn).as_matrix()
    if np.abs(turn @ turn.T - np.eye(3)).max() > _ROTATION_TOLERANCE or np.linalg.det(turn) < 0:
        remedy = "its axes are mirrored" if np.linalg.det(turn) < 0 else ""
        raise fields.error(str(fields.first(*names)), "a rotation matrix", _quoted(turn.tolist()), remedy)
    return turn


def _image_size(fields: CameraFields, image_size_wh: tuple[int, int] | None) -> tuple[int, int]:
    if fields.first("size", "image_size"):
        sides = fields.array(("size", "image_size"), (2,))
    elif fields.first("image_width") and fields.first("image_height"):
        sides = np.array([fields.array((f"image_{side}",), ()) for side in ("width", "height")])
    elif image_size_wh is not None:
        return image_size_wh
    else:
        raise fields.error("size or image_size", "width and height of the images", "none", "pass --size")
    if (sides < 1).any() or (sides != np.round(sides)).any():
        raise fields.error("size", "whole numbers of pixels above 0", _quoted(sides.tolist()))
    return int(sides[0]), int(sides[1])


def _words(shape: tuple[int, ...]) -> str:
    if not shape:
        return "a number"
    return "numbers" if -1 in shape else f"{' x '.join(map(str, shape))} numbers"


def _quoted(value: Any) -> str:
    text = str(value).replace("\n", " ")
    return text if len(text) <= 60 else f"{text[:60]}..."
