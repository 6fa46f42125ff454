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
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from psotrack.geometry.rig_files.fields import CameraFields
from psotrack.geometry.rig_files.guarded_text import attributes, number, parse_xml

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


def read(path: Path, text: str) -> Iterator[CameraFields]:
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
        lens = _lens(path, place, element)
        values = lens | _pose(path, place, element) if lens else {}
        yield CameraFields(path, place, values, name, unit_m=1e-3)


def _lens(path: Path, place: str, element: ElementTree.Element) -> dict[str, Any]:
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


def _pose(path: Path, place: str, element: ElementTree.Element) -> dict[str, Any]:
    """Rotation and translation; none of a camera that was not calibrated."""
    pose = element.find("transform")
    if pose is None or element.get("calibrated", "true").lower() == "false":
        return {}
    fields = attributes(path, f"{place}, transform", pose)
    turn = np.array([[number(fields, f"r{row}{column}") for column in (1, 2, 3)] for row in (1, 2, 3)])
    R = _TURN @ fields.rotation_matrix(turn, "r11 to r33")
    return {"R": R, "t": -R @ [number(fields, axis) for axis in "xyz"]}
