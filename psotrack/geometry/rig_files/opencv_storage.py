"""Files of OpenCV's `FileStorage` in YAML, XML or JSON, and ROS's camera_info in YAML.

The forms that are read:

- a sequence `cameras` of maps with `name`, `image_size`, `K`, `D`, `R` (a 3 x 3 matrix or a Rodrigues vector) and `t`;
- a map per camera with the same fields, by name;
- a single camera, as OpenCV's samples and ROS write it: `camera_matrix`, `distortion_coefficients`, `image_width`, ...;
- a stereo rig, as OpenCV's sample writes it: `M1`, `D1`, `M2`, `D2` in intrinsics.yml and `R`, `T` in extrinsics.yml,
  or all in one file. The world is the first camera; x_2 = R x_1 + T.

All map world to camera, x_cam = R X + t. The unit of lengths is open; files that psotrack writes state it as `unit`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np

from psotrack.geometry import Rig
from psotrack.geometry.rig_files.fields import (
    DISTORTION,
    MATRIX,
    ROTATION,
    TRANSLATION,
    CameraFields,
    lens_model,
    stated_unit_m,
)
from psotrack.geometry.rig_files.guarded_text import as_matrix, parse_xml, parse_yaml
from psotrack.support import atomic_write, read_text, whole_number

#: Field of one camera of two: M1, cameraMatrix2, K_left, D_right.
_OF_TWO = re.compile(
    r"(?:(?P<matrix>M|K|camera_?matrix|intrinsics?)|(?P<dist>D|dist|dist_?coeffs?|distortion(?:_coefficients)?))"
    r"_?(?P<which>1|2|left|right|l|r)",
    re.IGNORECASE,
)
_SECOND = {"2", "right", "r"}
_SIZES = ("image_size", "imageSize", "size", "image_width", "image_height")


def recognises(text: str) -> bool:
    """Whether a text begins as OpenCV's files do."""
    return text.startswith(("%YAML", "{")) or "<opencv_storage" in text[:200]


def read(path: Path, text: str) -> Iterator[CameraFields]:
    """Read a file of OpenCV; the unit is the file's `unit`, if there is one."""
    content = parse(path, text)
    unit_m = stated_unit_m(path, "unit", content.get("unit"))
    for name, place, values in _cameras(path, content):
        yield CameraFields(path, place, values, name, unit_m)


def parse(path: Path, text: str) -> dict[str, Any]:
    """The top level of a file storage, as dictionaries, lists, arrays, numbers and text.

    Raises:
        InputError: the file is not valid YAML, XML or JSON.
    """
    if not text.lstrip().startswith("<"):
        return parse_yaml(path, text)
    content = _of_element(parse_xml(path, text))
    return content if isinstance(content, dict) else {}


def with_partner(path: Path, content: Mapping[str, Any]) -> dict[str, Any]:
    """The content of a file with that of its partner, by `intri` and `extri` in the names of lenses and poses."""
    match = re.search("intri|extri", path.name, re.IGNORECASE)
    if match is None:
        return dict(content)
    other = "ex" if match[0].lower() == "intri" else "in"
    shaped = other.upper() if match[0].isupper() else other.capitalize() if match[0].istitle() else other
    found = path.with_name(f"{path.name[: match.start()]}{shaped}{path.name[match.start() + 2 :]}")
    return (parse(found, read_text(found)) if found.exists() else {}) | dict(content)


def write(path: Path, rig: Rig) -> None:
    """Write a sequence of cameras as YAML, in metres."""
    with atomic_write(path) as temporary:
        # To memory, because OpenCV reports no failed writes.
        storage = cv2.FileStorage(
            "", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML
        )
        storage.write("unit", "m")
        storage.startWriteStruct("cameras", cv2.FILE_NODE_SEQ)
        for index, name in enumerate(rig.names):
            camera = rig.cameras[index]
            storage.startWriteStruct("", cv2.FILE_NODE_MAP)
            # In quotes, because OpenCV would read the names true and null as values.
            storage.write("name", json.dumps(name, ensure_ascii=False))
            distortion, fisheye = lens_model(camera)
            if fisheye:
                storage.write("fisheye", 1)
            # Vectors become columns, because OpenCV 4 has no arrays with camera axis.
            arrays = {
                "image_size": camera.image_size_wh.astype(np.int32)[:, None],
                "K": camera.K,
                "D": np.array(distortion)[:, None],
                "R": camera.T_cam_world[:3, :3],
                "t": camera.T_cam_world[:3, 3:],
            }
            for key, array in arrays.items():
                if array.size:
                    storage.write(key, np.ascontiguousarray(array))
            storage.endWriteStruct()
        storage.endWriteStruct()
        temporary.write_text(storage.releaseAndGetString(), encoding="utf-8")


def _cameras(path: Path, content: dict[str, Any]) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Name, place in the file and fields of each camera."""
    cameras = content.get("cameras")
    if isinstance(cameras, list):
        for index, item in enumerate(cameras):
            values = item if isinstance(item, dict) else {}
            if values.get("name") is None:
                raise CameraFields(path, f"cameras[{index}]", values).error("name", "a name", "none")
            yield str(values["name"]), f"cameras[{index}]", values
        return
    by_name = cameras if isinstance(cameras, dict) else content
    maps = {name: value for name, value in by_name.items() if _is_camera(value)}
    for name, value in maps.items():
        yield name, f"cameras.{name}" if by_name is cameras else name, value
    if maps:
        return
    both = with_partner(path, content)
    if any(_OF_TWO.fullmatch(key) for key in both):
        yield from _stereo(both)
        return
    fields = CameraFields(path, "camera", content)
    if fields.first(*MATRIX) is None:
        raise fields.error(" or ".join(MATRIX[:3]), "3 x 3 numbers", "none")
    name = content.get("camera_name")
    yield name if isinstance(name, str) and name else path.stem, "camera", content


def _stereo(content: Mapping[str, Any]) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Two cameras; the poses of the second are `R` and `T`, which OpenCV calls the rotation and translation between."""
    cameras: tuple[dict[str, Any], dict[str, Any]] = {}, {}
    names = ["cam1", "cam2"]
    for key, value in content.items():
        match = _OF_TWO.fullmatch(key)
        if match and not isinstance(value, str):
            which = match["which"].lower()
            second = which in _SECOND
            cameras[second]["K" if match["matrix"] else "D"] = value
            names[second] = (
                f"cam{which}" if which.isdigit() else {"l": "left", "r": "right"}.get(which, which)
            )
    pose = {key: content[key] for key in (*ROTATION, *TRANSLATION) if content.get(key) is not None}
    if pose:
        cameras[0].update(R=np.eye(3), t=np.zeros(3))
        cameras[1].update(pose)
    shared = {key: content[key] for key in _SIZES if key in content}
    for name, values in zip(names, cameras, strict=True):
        yield name, f"camera {name}", values | shared


def _is_camera(value: Any) -> bool:
    return isinstance(value, dict) and any(name in value for name in (*MATRIX, *DISTORTION))


def _of_element(element: ElementTree.Element) -> Any:
    """Content of an element of OpenCV's XML."""
    children = list(element)
    if children and all(child.tag == "_" for child in children):
        return [_of_element(child) for child in children]
    if children:
        return as_matrix({child.tag: _of_element(child) for child in children})
    text = (element.text or "").strip()
    if text.startswith('"'):
        return text.strip('"')
    try:
        numbers = [float(word) if (whole := whole_number(word)) is None else whole for word in text.split()]
    except ValueError:
        return text
    # A matrix of one number has a sequence of one number.
    return numbers[0] if len(numbers) == 1 and element.tag != "data" else numbers or None
