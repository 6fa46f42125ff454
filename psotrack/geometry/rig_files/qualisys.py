"""Calibrations of Qualisys Track Manager (`.qca.txt`, XML).

Lengths in the image are in units of 1/64 pixel; the distortion coefficients are OpenCV's and have no unit. `transform`
has the camera's centre in millimetres and the matrix R_q whose rows are the camera's axes in the world, with x right,
y up and z backwards: R = diag(1, -1, -1) R_q, t = -R C.

Qualisys's manuals do not describe the file. Pose2Sim's reader (`calibration.py`, `read_qca`) has the same unit of 1/64
pixel, field of view and axes, but divides the distortion by 64 as well. The k1 of its demonstration, -0.046, would then
move the corners by a third of a pixel, too little to be worth stating. Other readers use the coefficients as they are,
in OpenCV's order.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from psotrack.geometry import make_camera
from psotrack.geometry.rig_files.entries import Entry, FileRig, Source, collect
from psotrack.geometry.rig_files.fields import CameraFields, rotation_matrix
from psotrack.geometry.rig_files.xml_text import attributes, number, parse_xml

_logger = logging.getLogger(__name__)

#: Parts of a pixel in which lengths are measured.
_PARTS = 64.0
#: From axes x right, y up, z backwards to x right, y down, z forward.
_TURN = np.diag([1.0, -1.0, -1.0])
_RADIAL = ("radialDistortion1", "radialDistortion2", "radialDistortion3")
# The misspelling is Qualisys's.
_TANGENTIAL = ("tangentalDistortion1", "tangentalDistortion2")


def recognises(text: str) -> bool:
    """Whether a text is a calibration of Qualisys."""
    return "<calibration" in text[:4096] and "<transform" in text


def read(source: Source) -> FileRig:
    """Read a .qca.txt; lengths are millimetres."""
    return FileRig(collect(source.path, _entries(source)), metres_per_unit=1e-3)


def _entries(source: Source) -> Iterator[tuple[str, str, Entry]]:
    for index, element in enumerate(parse_xml(source).iterfind(".//camera")):
        place = f"camera[{index}]"
        name = element.get("serial") or element.get("name")
        if not name:
            raise CameraFields(source.path, place, {}).error("serial", "a serial number", "none")
        place = f"camera {name}"
        if element.get("viewrotation", "0") not in {"0", ""}:
            _logger.warning(
                "%s, %s: its view is turned by %s degrees; the calibration is for images that are not turned",
                source.path,
                place,
                element.get("viewrotation"),
            )
        yield name, place, _entry(source, place, element)


def _entry(source: Source, place: str, element: ElementTree.Element) -> Entry:
    lens = element.find("intrinsic")
    if lens is None:
        return Entry(None, placed=False)
    fields = attributes(source, f"{place}, intrinsic", lens)
    left_top, size = _field_of_view(source, place, element, fields)
    fu, fv, cu, cv = (
        number(fields, name) / _PARTS
        for name in ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
    )
    if not (fu > 0 and fv > 0):
        raise fields.error("focalLengthU", "focal lengths above 0", f"{fu:g} and {fv:g} pixels")
    # The skew's unit is not documented, and all known files have none.
    if "skew" in fields.values and number(fields, "skew"):
        raise fields.error("skew", "0", f"{number(fields, 'skew'):g}")
    K = np.array([[fu, 0.0, cu - left_top[0]], [0.0, fv, cv - left_top[1]], [0.0, 0.0, 1.0]])
    k1, k2, k3 = (number(fields, name) if name in fields.values else 0.0 for name in _RADIAL)
    p1, p2 = (number(fields, name) if name in fields.values else 0.0 for name in _TANGENTIAL)
    R, t, placed = np.eye(3), np.zeros(3), False
    pose = element.find("transform")
    if pose is not None and element.get("calibrated", "true").lower() != "false":
        R, t = _pose(attributes(source, f"{place}, transform", pose))
        placed = True
    dist = [k1, k2, p1, p2, k3]
    return Entry(make_camera(R=R, t_m=t, K=K, dist=dist, image_size_wh=size), placed)


def _field_of_view(
    source: Source, place: str, element: ElementTree.Element, lens: CameraFields
) -> tuple[Float[np.ndarray, "2"], tuple[int, int]]:
    """First pixel of the images on the sensor, and their width and height."""
    view = element.find("fov_video")
    if view is not None:
        fields = attributes(source, f"{place}, fov_video", view)
        left, top, right, bottom = (number(fields, side) for side in ("left", "top", "right", "bottom"))
        if not (right > left and bottom > top):
            raise fields.error("right", "a field of view with a size", f"{left:g} to {right:g}")
        return np.array([left, top]), (int(right - left) + 1, int(bottom - top) + 1)
    if source.image_size_wh is not None:
        return np.zeros(2), source.image_size_wh
    # The last part of a pixel, or the last pixel itself: in either case its number is the size less one.
    width, height = (int(number(lens, f"sensorMax{axis}") // _PARTS) + 1 for axis in "UV")
    return np.zeros(2), (width, height)


def _pose(fields: CameraFields) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    turn = np.array([[number(fields, f"r{row}{column}") for column in (1, 2, 3)] for row in (1, 2, 3)])
    R = _TURN @ rotation_matrix(turn, fields, "r11 to r33")
    centre_mm = np.array([number(fields, axis) for axis in "xyz"])
    return R, -R @ centre_mm
