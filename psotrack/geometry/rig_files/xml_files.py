"""Calibrations in XML: of Qualisys Track Manager (`.qca.txt`), and of Vicon (`.xcp`).

**Qualisys.** Lengths in the image are in units of 1/64 pixel; the distortion coefficients are OpenCV's and have no
unit. `transform` has the camera's centre in millimetres and the matrix R_q whose rows are the camera's axes in the
world, with x right, y up and z backwards: R = diag(1, -1, -1) R_q, t = -R C.

Qualisys's manuals do not describe the file. Pose2Sim's reader (`calibration.py`, `read_qca`) has the same unit of 1/64
pixel, field of view and axes, but divides the distortion by 64 as well. The k1 of its demonstration, -0.046, would then
move the corners by a third of a pixel, too little to be worth stating. Other readers use the coefficients as they are,
in OpenCV's order.

**Vicon.** A `KeyFrame` has the camera's centre C in millimetres (`POSITION`), the rotation from world to camera as
quaternion (x, y, z, w) (`ORIENTATION`), with x right, y down and z forward, the focal length in pixels, and the lens:

- `VICON_RADIAL` "k1 k2": a point at distance r of the principal point, in pixels, belongs at r (1 + k1 r² + k2 r⁴);
- `VICON_RADIAL2` "ViconRadial2 cx cy k1 k2 k3": the same about (cx, cy), with r in pixels or in focal lengths.

The order and the direction of the quaternion are those of Pose2Sim's reader (`calibration.py`, `calib_vicon_fun`: the
scalar last, and a matrix from world to camera after its two transpositions), as is fy = focal length / aspect ratio.

The formulae map distorted to undistorted points, the opposite of OpenCV's. `fit_distortion` finds OpenCV's
coefficients.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.geometry import LENGTH_TOLERANCE, LensNumbers, distort
from psotrack.geometry.rig_files.fields import CameraFields, quoted
from psotrack.geometry.rig_files.guarded_text import attributes, number, parse_xml

_logger = logging.getLogger(__name__)

#: Parts of a pixel in which lengths are measured.
_PARTS = 64.0
#: From axes x right, y up, z backwards to x right, y down, z forward.
_TURN = np.diag([1.0, -1.0, -1.0])
_RADIAL = ("radialDistortion1", "radialDistortion2", "radialDistortion3")
# The misspelling is Qualisys's.
_TANGENTIAL = ("tangentalDistortion1", "tangentalDistortion2")
_logger = logging.getLogger(__name__)

#: A smaller |k1| is per square pixel: in focal lengths it would be no distortion at all, below 0.1 px in every image.
_PER_PIXEL = 1e-4
#: Largest error of OpenCV's coefficients that is accepted without a word, pixels.
_ACCEPTED_PX = 0.1
#: Points of the grid along each side of the image.
_GRID = 41
#: Largest error of five coefficients for which the rational model is not tried, pixels.
_EXACT_PX = 0.01


def is_qualisys(text: str) -> bool:
    """Whether a text is a calibration of Qualisys."""
    return "<calibration" in text[:4096] and "<transform" in text


def read_qualisys(path: Path, text: str) -> Iterator[CameraFields]:
    """Read a .qca.txt; lengths are millimetres."""
    for index, element in enumerate(parse_xml(path, text).iterfind(".//camera")):
        name = element.get("serial") or element.get("name")
        if not name:
            raise CameraFields(path, f"camera[{index}]", {}).error("serial", "a serial number", "none")
        place = f"camera {name}"
        if element.get("viewrotation", "0") not in {"0", ""}:
            _logger.warning(
                "%s, %s: its view is turned by %s degrees; the calibration is for images that are not turned",
                path, place, element.get("viewrotation"),
            )  # fmt: skip
        lens = _qualisys_lens(path, place, element)
        values = lens | _qualisys_pose(path, place, element) if lens else {}
        yield CameraFields(path, place, values, name, unit_m=1e-3)


def _qualisys_lens(path: Path, place: str, element: ElementTree.Element) -> dict[str, Any]:
    lens = element.find("intrinsic")
    if lens is None:
        return {}
    fields = attributes(path, f"{place}, intrinsic", lens)
    (left, top), size = _field_of_view(path, place, element, fields)
    names = ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
    fu, fv, cu, cv = (number(fields, name) / _PARTS for name in names)
    # The skew's unit is not documented, and all known files have none.
    if "skew" in fields.values and number(fields, "skew"):
        raise fields.error("skew", "0", f"{number(fields, 'skew'):g}")
    k1, k2, k3, p1, p2 = (
        number(fields, name) if name in fields.values else 0.0 for name in (*_RADIAL, *_TANGENTIAL)
    )
    return {
        "size": size,
        "K": [[fu, 0.0, cu - left], [0.0, fv, cv - top], [0.0, 0.0, 1.0]],
        "D": [k1, k2, p1, p2, k3],
    }


def _field_of_view(
    path: Path, place: str, element: ElementTree.Element, lens: CameraFields
) -> tuple[tuple[float, float], tuple[int, int]]:
    """First pixel of the images on the sensor, and their width and height."""
    view = element.find("fov_video")
    if view is None:
        # The last part of a pixel, or the last pixel itself: in either case its number is the size less one.
        width, height = (int(number(lens, f"sensorMax{axis}") // _PARTS) + 1 for axis in "UV")
        return (0.0, 0.0), (width, height)
    fields = attributes(path, f"{place}, fov_video", view)
    left, top, right, bottom = (number(fields, side) for side in ("left", "top", "right", "bottom"))
    return (left, top), (int(right - left) + 1, int(bottom - top) + 1)


def _qualisys_pose(path: Path, place: str, element: ElementTree.Element) -> dict[str, Any]:
    """Rotation and translation; none of a camera that was not calibrated."""
    pose = element.find("transform")
    if pose is None or element.get("calibrated", "true").lower() == "false":
        return {}
    fields = attributes(path, f"{place}, transform", pose)
    turn = np.array([[number(fields, f"r{row}{column}") for column in (1, 2, 3)] for row in (1, 2, 3)])
    R = _TURN @ fields.rotation_matrix(turn, "r11 to r33")
    return {"R": R, "t": -R @ [number(fields, axis) for axis in "xyz"]}


def is_vicon(text: str) -> bool:
    """Whether a text is a calibration of Vicon."""
    return "<Cameras" in text[:4096] and "DEVICEID" in text


def read_vicon(path: Path, text: str) -> Iterator[CameraFields]:
    """Read an .xcp; lengths are millimetres. If it has video cameras, cameras for markers are left out."""
    cameras = parse_xml(path, text).findall("Camera")
    videos = [one for one in cameras if _is_video(one)]
    if videos and len(videos) < len(cameras):
        _logger.warning("%s: %d cameras that record no video are left out", path, len(cameras) - len(videos))
    for index, element in enumerate(videos or cameras):
        name = element.get("DEVICEID")
        if not name:
            raise CameraFields(path, f"Camera[{index}]", {}).error("DEVICEID", "a number", "none")
        place = f"Camera {name}"
        yield CameraFields(path, place, _values(path, place, element), name, unit_m=1e-3)


def _is_video(element: ElementTree.Element) -> bool:
    return "video" in element.get("TYPE", "").lower() or element.get("ISDV") == "1"


def _values(path: Path, place: str, element: ElementTree.Element) -> dict[str, Any]:
    """Lens and place of a camera; none of a camera that was not calibrated."""
    frames = element.findall("KeyFrames/KeyFrame")
    if not frames:
        return {}
    if len(frames) > 1:
        _logger.warning("%s, %s: it moves; its first place is used", path, place)
    outer = attributes(path, place, element)
    fields = attributes(path, f"{place}, KeyFrame", frames[0])
    width, height = outer.array(("SENSOR_SIZE",), (2,))
    aspect = number(outer, "PIXEL_ASPECT_RATIO") if "PIXEL_ASPECT_RATIO" in outer.values else 1.0
    focal = number(fields, "FOCAL_LENGTH")
    if not (focal > 0 and aspect > 0 and width >= 1 and height >= 1):
        raise fields.error("FOCAL_LENGTH", "focal length, aspect and size above 0", f"{focal:g}")
    cx, cy = fields.array(("PRINCIPAL_POINT",), (2,))
    K = np.array([[focal, 0.0, cx], [0.0, focal / aspect, cy], [0.0, 0.0, 1.0]])
    size = (int(width), int(height))
    quaternion = fields.array(("ORIENTATION",), (4,))
    if abs(np.linalg.norm(quaternion) - 1) > LENGTH_TOLERANCE:
        raise fields.error("ORIENTATION", "a quaternion of length 1", quoted(quaternion.tolist()))
    R = Rotation.from_quat(quaternion).as_matrix()
    t = -R @ fields.array(("POSITION",), (3,))
    return {"size": size, "K": K, "D": _distortion(fields, K, size), "R": R, "t": t}


def _distortion(fields: CameraFields, K: Float[np.ndarray, "3 3"], size: tuple[int, int]) -> list[float]:
    """OpenCV's coefficients for the radial correction of a key frame."""
    name, centre, radial = "VICON_RADIAL", K[:2, 2], np.zeros(0)
    if isinstance(text := fields.values.get("VICON_RADIAL2"), str):
        name = "VICON_RADIAL2"
        values = _words(fields, text.split()[1:])
        if len(values) not in (4, 5):
            raise fields.error(name, "cx, cy and two or three coefficients", quoted(text))
        centre, radial = values[:2], values[2:]
    elif name in fields.values:
        radial = fields.array((name,), (2,))
    if not radial.any():
        return []
    # `fit_distortion` measures distances in focal lengths.
    if abs(radial[0]) < _PER_PIXEL:
        radial = radial * K[0, 0] ** (2.0 * np.arange(1, len(radial) + 1))
    fit = fit_distortion(K, size, centre, radial)
    if fit is None:
        expected = "a correction that keeps the order of points up to the corners"
        raise fields.error(name, expected, quoted(radial.tolist()))
    coefficients, error_px = fit
    if error_px > _ACCEPTED_PX:
        _logger.warning(
            "%s, %s: OpenCV's lens model differs from Vicon's by up to %.2g pixels",
            fields.path, fields.place, error_px,
        )  # fmt: skip
    return coefficients.tolist()


def _words(fields: CameraFields, words: list[str]) -> Float[np.ndarray, " words"]:
    try:
        return np.array([float(word) for word in words])
    except ValueError:
        raise fields.error("VICON_RADIAL2", "numbers after the name", quoted(" ".join(words))) from None


def fit_distortion(
    K: Float[np.ndarray, "3 3"],
    image_size_wh: tuple[int, int],
    centre_px: Float[np.ndarray, "2"],
    radial: Float[np.ndarray, " coefficients"],
) -> tuple[Float[np.ndarray, " opencv"], float] | None:
    """Fit OpenCV's coefficients to the correction r (1 + k1 r² + k2 r⁴ + ...) of distorted points.

    Least squares on a grid of pixels: first of k1, k2, p1, p2, k3, and if that leaves more than a hundredth of a pixel,
    of the rational model.

    Args:
        K: intrinsics, pixels.
        image_size_wh: width and height of the images, pixels.
        centre_px: centre of the correction, pixels.
        radial: k1, k2, ...; r is the distance of a distorted point from the centre, in units of the focal length fx.

    Returns:
        5 or 8 coefficients in OpenCV's order and the largest error in the image, pixels; None if the correction is not
        monotone within the image, so that no lens has it.
    """
    width, height = image_size_wh
    u, v = np.meshgrid(np.linspace(-0.5, width - 0.5, _GRID), np.linspace(-0.5, height - 0.5, _GRID))
    distorted = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]], axis=-1).reshape(-1, 2)
    centre = np.array([(centre_px[0] - K[0, 2]) / K[0, 0], (centre_px[1] - K[1, 2]) / K[1, 1]])
    arm = distorted - centre
    powers = np.arange(1, len(radial) + 1)
    # A centre far outside of the image has no finite squares.
    with np.errstate(over="ignore", invalid="ignore"):
        r2 = (arm**2).sum(axis=-1)
        gain = 1 + (radial * r2[:, None] ** powers).sum(axis=-1)
        slope = 1 + ((2 * powers + 1) * radial * r2[:, None] ** powers).sum(axis=-1)
    if not (np.isfinite(slope) & (slope > 0)).all():
        return None
    points = centre + arm * gain[:, None]
    fit = _fitted(K, points, distorted, 5)
    if fit[1] > _EXACT_PX:
        fit = min(fit, _fitted(K, points, distorted, 8), key=lambda each: each[1])
    return fit


def _fitted(
    K: Float[np.ndarray, "3 3"],
    points: Float[np.ndarray, "n 2"],
    distorted: Float[np.ndarray, "n 2"],
    num_coefficients: int,
) -> tuple[Float[np.ndarray, " opencv"], float]:
    """OpenCV's first coefficients by least squares in the image, and their largest error, pixels."""
    from scipy.optimize import least_squares  # takes 0.2 s

    focal_px = K[[0, 1], [0, 1]][:, None]

    def off_px(dist: Float[np.ndarray, " opencv"]) -> Float[np.ndarray, " residuals"]:
        off = np.stack(distort(LensNumbers(dist), *points.T)) - distorted.T
        return (off * focal_px).ravel()

    dist = np.zeros(num_coefficients)
    with contextlib.suppress(ValueError):  # no finite distances: no distortion, whose error is large
        dist = least_squares(off_px, dist, method="lm").x
    return dist, float(np.linalg.norm(off_px(dist).reshape(2, -1), axis=0).max())
