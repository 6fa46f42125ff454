"""Files of OpenCV's `FileStorage` in YAML, XML or JSON, ROS's camera_info in YAML, and YAML of EasyMocap and Kalibr.

The forms that are read:

- a sequence `cameras` of maps with `name`, `image_size`, `K`, `D`, `R` (a 3 x 3 matrix or a Rodrigues vector) and `t`;
- a map per camera with the same fields, by name;
- a single camera, as OpenCV's samples and ROS write it: `camera_matrix`, `distortion_coefficients`, `image_width`, ...;
- a stereo rig, as OpenCV's sample writes it: `M1`, `D1`, `M2`, `D2` in intrinsics.yml and `R`, `T` in extrinsics.yml,
  or all in one file. The world is the first camera; x_2 = R x_1 + T.

All map world to camera, x_cam = R X + t. The unit of lengths is open; files that psotrack writes state it as `unit`.

**EasyMocap**: intri.yml with the lenses and extri.yml with the poses, side by side.

intri.yml has `names` and for each name `K_NAME` and `dist_NAME`, in newer versions `H_NAME` and `W_NAME` too; extri.yml
has `R_NAME` (a Rodrigues vector), `Rot_NAME` (a matrix) and `T_NAME`: x_cam = R X + T in metres. Either file may be
named. Where a camera has both `R_NAME` and `Rot_NAME`, `R_NAME` counts, as for EasyMocap. A width or height that is not
above 0 is not known.

The format: `easymocap/mytools/camera_utils.py` of https://github.com/zju3dv/EasyMocap (`read_camera`, `write_camera`);
its `apps/calibration/Readme.md` states the board's squares in metres.

**Kalibr**: camera chains (`camchain.yaml`), a map `cam0`, `cam1`, ... per camera.

`intrinsics` are fu, fv, pu, pv of the pinhole model; `distortion_model` is radtan (OpenCV's k1, k2, p1, p2),
equidistant (OpenCV's fisheye) or none; `T_cn_cnm1` maps the camera before to this camera, in metres. The world is the
first camera; `T_cam_imu` and the clock of an inertial unit are not read. Other models (omni, eucm, ds, and distortion
by fov) have no form in OpenCV and are refused.

The format: https://github.com/ethz-asl/kalibr/wiki/yaml-formats, and `kalibr_common/ConfigReader.py`, which says what
Kalibr itself accepts.
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
from jaxtyping import Float

from psotrack.errors import InputError
from psotrack.geometry import Rig
from psotrack.geometry.rig_files.fields import (
    DISTORTION,
    MATRIX,
    ROTATION,
    TRANSLATION,
    CameraFields,
    lens_model,
    quoted,
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
#: Field of a camera -> the same field in this package's reader.
_FIELDS = {"K": "K", "dist": "D", "D": "D", "Rot": "R", "R": "rvec", "T": "t"}
_MODELS = {"radtan": "opencv", "equidistant": "fisheye", "equi": "fisheye", "none": "opencv"}
_REMEDY = "calibrate again with pinhole-radtan or pinhole-equi, or by `psotrack calibrate rig`"


def is_opencv(text: str) -> bool:
    """Whether a text begins as OpenCV's files do."""
    return text.startswith(("%YAML", "{")) or "<opencv_storage" in text[:200]


def read_opencv(path: Path, text: str) -> Iterator[CameraFields]:
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


def write_opencv(path: Path, rig: Rig) -> None:
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
            # In quotes, because OpenCV would read_opencv the names true and null as values.
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


def is_easymocap(text: str) -> bool:
    """Whether a text is one of EasyMocap's two files."""
    return bool(
        re.search(r"^names:", text, re.M) and re.search(r"^(K|Rot|R|T)_[^\s:]+: *!!opencv", text, re.M)
    )


def read_easymocap(path: Path, text: str) -> Iterator[CameraFields]:
    """Read intri.yml and extri.yml; lengths are metres."""
    content = with_partner(path, parse(path, text))
    # Names of all cameras, of lenses and of poses, in the file's order.
    names = dict.fromkeys(match[1] for key in content if (match := re.fullmatch(r"(?:K|Rot|R|T)_(.+)", key)))
    if not any(f"K_{name}" in content for name in names):
        expected = "intri.yml with the lenses beside it"
        raise InputError(path, expected=expected, found="a file of poses alone")
    for name in names:
        yield CameraFields(path, f"camera {name}", _easymocap_values(content, name), name, unit_m=1.0)


def _easymocap_values(content: Mapping[str, Any], name: str) -> dict[str, Any]:
    """The fields of a camera; none for a camera whose place is known, but not its lens."""
    values = {
        ours: content[f"{theirs}_{name}"]
        for theirs, ours in _FIELDS.items()
        if content.get(f"{theirs}_{name}") is not None
    }
    width, height = content.get(f"W_{name}"), content.get(f"H_{name}")
    if isinstance(width, int | float) and isinstance(height, int | float) and min(width, height) > 0:
        values["size"] = [width, height]
    if "rvec" in values:
        values.pop("R", None)
    return values if "K" in values else {}


def is_kalibr(text: str) -> bool:
    """Whether a text is a camera chain of Kalibr."""
    return bool(re.search(r"^cam\d+:", text, re.M)) and "camera_model:" in text


def read_kalibr(path: Path, text: str) -> Iterator[CameraFields]:
    """Read a camera chain; lengths are metres."""
    cameras = parse_yaml(path, text)
    names = [key for key in cameras if re.fullmatch(r"cam\d+", key)]
    T_world: Float[np.ndarray, "4 4"] | None = np.eye(4)
    for index, name in enumerate(sorted(names, key=lambda name: int(name[3:]))):
        values = cameras[name] if isinstance(cameras[name], dict) else {}
        fields = CameraFields(path, name, values)
        if index:
            step = _step(fields) if values.get("T_cn_cnm1") is not None else None
            # After a gap in the chain no place is known.
            T_world = None if step is None or T_world is None else step @ T_world
        values = values | _lens(fields)
        if T_world is not None:
            values |= {"R": T_world[:3, :3], "t": T_world[:3, 3]}
        yield CameraFields(path, name, values, name, unit_m=1.0)


def _lens(fields: CameraFields) -> dict[str, Any]:
    model = str(fields.values.get("camera_model"))
    if model != "pinhole":
        raise fields.error("camera_model", "pinhole, the model that OpenCV has", model, _REMEDY)
    distortion = str(fields.values.get("distortion_model", "none"))
    if distortion not in _MODELS:
        raise fields.error("distortion_model", "radtan, equidistant or none", distortion, _REMEDY)
    fu, fv, pu, pv = fields.array(("intrinsics",), (4,))
    dist = np.zeros(0) if distortion == "none" else fields.array(("distortion_coeffs",), (4,))
    return {"K": [[fu, 0, pu], [0, fv, pv], [0, 0, 1]], "D": dist, "model": _MODELS[distortion]}


def _step(fields: CameraFields) -> Float[np.ndarray, "4 4"]:
    T = fields.array(("T_cn_cnm1",), (4, 4))
    if not np.allclose(T[3], [0, 0, 0, 1]):
        raise fields.error("T_cn_cnm1", "a last row 0, 0, 0, 1", quoted(T[3].tolist()))
    T[:3, :3] = fields.rotation_matrix(T[:3, :3], "T_cn_cnm1")
    return T
