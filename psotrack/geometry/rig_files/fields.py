"""Fields of one camera in a rig file, under any of the names that calibration programs use; one conversion for all."""

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
from psotrack.support import LARGEST

#: Lengths of units by the names that files and options use, metres.
UNITS_M = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
#: Largest element of |R Rᵀ - I| in a rotation matrix that is taken for rounded and made orthogonal: matrices written
#: with four decimals pass.
_ROTATION_TOLERANCE = 1e-3

MATRIX = ("matrix", "K", "camera_matrix", "cameraMatrix", "intrinsic_matrix", "K-matrix")
DISTORTION = ("distortions", "distortion", "D", "dist", "distortion_coefficients", "distCoeffs", "distCoeff")
ROTATION = ("rotation", "R", "rvec", "rotation_matrix")
TRANSLATION = ("translation", "t", "T", "tvec")
_SIZE = ("size", "image_size", "imageSize", "resolution")


@dataclass(frozen=True)
class Entry:
    """One camera of a rig file.

    Attributes:
        camera: the camera, in metres; None if the file has no lens for it.
        placed: whether the file has the camera's pose; if not, the camera stands at the world's origin.
    """

    camera: Camera | None
    placed: bool = True


@dataclass(frozen=True)
class CameraFields:
    """What a file says of one camera: readers of all formats yield this.

    Attributes:
        path: path of the file.
        place: place of the camera in the file, for messages.
        values: values by field name. `rows_upwards` is true where pixels are counted upwards from the lower edge.
        name: name of the camera.
        unit_m: unit of length that the format or the file states, metres; None if both leave it open.
    """

    path: Path
    place: str
    values: Mapping[str, Any]
    name: str = ""
    unit_m: float | None = None

    def error(self, name: str, expected: str, found: str, remedy: str = "") -> InputError:
        """Error whose message names the file and the field."""
        place = ".".join(part for part in (self.place, name) if part)
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

    def entry(self, image_size_wh: tuple[int, int] | None, metres_per_unit: float) -> Entry:
        """The camera that these fields describe.

        A camera without rotation and translation is not placed; a camera that has no lens either was never calibrated.

        Args:
            image_size_wh: width and height in pixels, if the fields have none.
            metres_per_unit: unit of the translation, metres.

        Raises:
            InputError: a field is missing or wrong.
        """
        placed = self.first(*ROTATION, *TRANSLATION) is not None
        if not placed and not self.has_lens:
            return Entry(None, placed=False)
        K, fisheye = self._intrinsics(), self._is_fisheye()
        dist = self._distortion(fisheye=fisheye)
        R, t_m = np.eye(3), np.zeros(3)
        if placed:
            R, t_m = self._rotation(), self.array(TRANSLATION, (3,)) * metres_per_unit
        size_wh = self.size_wh or image_size_wh
        if size_wh is None:
            raise self.error("size or image_size", "width and height of the images", "none", "pass --size")
        if self.values.get("rows_upwards"):
            K[1, 2] += size_wh[1]
        camera = make_camera(R=R, t_m=t_m, K=K, dist=dist.tolist(), image_size_wh=size_wh, fisheye=fisheye)
        return Entry(camera, placed)

    @property
    def has_lens(self) -> bool:
        """Whether there are intrinsics or a distortion."""
        return self.first(*MATRIX, *DISTORTION) is not None

    @property
    def size_wh(self) -> tuple[int, int] | None:
        """Width and height in pixels as the file states them; None where it does not."""
        if name := self.first(*_SIZE):
            sides = self.array(_SIZE, (2,))
        elif self.first("image_width") and self.first("image_height"):
            name = "image_width"
            sides = np.array([self.array((f"image_{side}",), ()) for side in ("width", "height")])
        elif name := self.first("image_shape"):
            # NumPy's shape of an image: rows before columns.
            sides = self.array(("image_shape",), (2,), (3,))[1::-1]
        else:
            return None
        if (sides < 1).any() or (sides != np.round(sides)).any():
            raise self.error(name, "whole numbers of pixels above 0", quoted(sides.tolist()))
        return int(sides[0]), int(sides[1])

    def _intrinsics(self) -> Float[np.ndarray, "3 3"]:
        K = self.array(MATRIX, (3, 3))
        if not (K[0, 0] > 0 and K[1, 1] > 0 and K[1, 0] == 0 and np.array_equal(K[2], [0, 0, 1])):
            expected = "intrinsics [[fx, s, cx], [0, fy, cy], [0, 0, 1]], fx and fy above 0"
            raise self.error(str(self.first(*MATRIX)), expected, quoted(K.tolist()))
        return K

    def _is_fisheye(self) -> bool:
        """Whether the fields name OpenCV's fisheye model."""
        model = self.values.get("model") or self.values.get("distortion_model")
        if isinstance(model, str):
            return model.lower() in {"fisheye", "equidistant", "kannala_brandt"}
        return bool(self.values.get("fisheye") or self.values.get("fisheye_model"))

    def _distortion(self, *, fisheye: bool) -> Float[np.ndarray, " coefficients"]:
        """The distortion coefficients in OpenCV's order; none if the field is missing or empty."""
        name = self.first(*DISTORTION)
        empty = name is None or (isinstance(self.values[name], list) and not self.values[name])
        dist = np.zeros(0) if empty else self.array(DISTORTION, (-1,))
        if fisheye and not dist[FISHEYE_COEFFICIENTS:].any():
            dist = np.pad(dist[:FISHEYE_COEFFICIENTS], (0, 0 if dist.size else FISHEYE_COEFFICIENTS))
        allowed = (FISHEYE_COEFFICIENTS,) if fisheye else PINHOLE_COEFFICIENTS
        if dist.size not in allowed:
            what = "coefficients of a fisheye" if fisheye else "coefficients"
            raise self.error(str(name), f"{', '.join(map(str, allowed))} {what}", f"{dist.size}")
        return dist

    def _rotation(self) -> Float[np.ndarray, "3 3"]:
        """The rotation matrix of a field that holds a Rodrigues vector or a matrix."""
        turn = self.array(ROTATION, (3,), (3, 3))
        if turn.ndim == 1:
            return Rotation.from_rotvec(turn).as_matrix()
        return self.rotation_matrix(turn, str(self.first(*ROTATION)))

    def rotation_matrix(self, turn: Float[np.ndarray, "3 3"], name: str) -> Float[np.ndarray, "3 3"]:
        """A matrix of the field `name`, checked; the nearest rotation if its digits are rounded."""
        off = np.abs(turn @ turn.T - np.eye(3)).max()
        mirrored = np.linalg.det(turn) < 0
        if off > _ROTATION_TOLERANCE or mirrored:
            remedy = "its axes are mirrored" if mirrored else ""
            raise self.error(name, "a rotation matrix", quoted(turn.tolist()), remedy)
        if off < 1e-12:
            return turn
        left, _, right = np.linalg.svd(turn)
        return left @ right


def camera_values(camera: Camera, *, placed: bool = True) -> dict[str, Any]:
    """The keys of a `rig.toml` that describe a camera, in metres; without its place if `placed` is false."""
    distortion, fisheye = lens_model(camera)
    values = {
        "size": [int(side) for side in camera.image_size_wh],
        "K": camera.K.tolist(),
        "model": "fisheye" if fisheye else "opencv",
        "distortion": distortion,
    }
    if placed:
        values["rvec"] = Rotation.from_matrix(camera.T_cam_world[:3, :3]).as_rotvec().tolist()
        values["tvec"] = camera.T_cam_world[:3, 3].tolist()
    return values


def lens_model(camera: Camera) -> tuple[list[float], bool]:
    """The distortion coefficients of one camera, and whether it is a fisheye; a fisheye has four."""
    fisheye = camera.fisheye is not None and bool(camera.fisheye)
    coefficients = camera.dist.tolist()
    return (coefficients[:FISHEYE_COEFFICIENTS] if fisheye else coefficients), fisheye


def stated_unit_m(path: Path, place: str, unit: Any) -> float | None:
    """Length of the unit that a file names, metres; None where it names none."""
    if unit is not None and unit not in list(UNITS_M):
        raise InputError(f"{path}, {place}", expected=f"one of {', '.join(UNITS_M)}", found=f"{unit}")
    return None if unit is None else UNITS_M[unit]


def quoted(value: Any) -> str:
    """A value as text for a message, not longer than 60 characters."""
    text = str(value).replace("\n", " ")
    return text if len(text) <= 60 else f"{text[:60]}..."


def _words(shape: tuple[int, ...]) -> str:
    if not shape:
        return "a number"
    return "numbers" if -1 in shape else f"{' x '.join(map(str, shape))} numbers"
