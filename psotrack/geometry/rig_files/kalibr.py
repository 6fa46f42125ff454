"""Camera chains of Kalibr (`camchain.yaml`): a map `cam0`, `cam1`, ... per camera.

`intrinsics` are fu, fv, pu, pv of the pinhole model; `distortion_model` is radtan (OpenCV's k1, k2, p1, p2),
equidistant (OpenCV's fisheye) or none; `T_cn_cnm1` maps the camera before to this camera, in metres. The world is the
first camera; `T_cam_imu` and the clock of an inertial unit are not read. Other models (omni, eucm, ds, and distortion
by fov) have no form in OpenCV and are refused.

The format: https://github.com/ethz-asl/kalibr/wiki/yaml-formats, and `kalibr_common/ConfigReader.py`, which says what
Kalibr itself accepts.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from psotrack.geometry import make_camera
from psotrack.geometry.rig_files.entries import Entry, FileRig, Source, collect
from psotrack.geometry.rig_files.fields import CameraFields, image_size, quoted, rotation_matrix
from psotrack.geometry.rig_files.yaml_text import parse_yaml

_FISHEYE = {"radtan": False, "equidistant": True, "equi": True, "none": False}
_REMEDY = "calibrate again with pinhole-radtan or pinhole-equi, or by `psotrack calibrate rig`"


def recognises(text: str) -> bool:
    """Whether a text is a camera chain of Kalibr."""
    return bool(re.search(r"^cam\d+:", text, re.M)) and "camera_model:" in text


def read(source: Source) -> FileRig:
    """Read a camera chain; lengths are metres."""
    cameras = parse_yaml(source)
    names = sorted(
        (key for key in cameras if re.fullmatch(r"cam\d+", str(key))), key=lambda name: int(name[3:])
    )
    return FileRig(collect(source.path, _entries(source, cameras, names)), metres_per_unit=1.0)


def _entries(
    source: Source, cameras: Mapping[str, Any], names: list[str]
) -> Iterator[tuple[str, str, Entry]]:
    T_world: Float[np.ndarray, "4 4"] | None = np.eye(4)
    for index, name in enumerate(names):
        values = cameras[name] if isinstance(cameras[name], dict) else {}
        fields = CameraFields(source.path, name, values)
        if index:
            step = _step(fields) if values.get("T_cn_cnm1") is not None else None
            # After a gap in the chain no place is known.
            T_world = None if step is None or T_world is None else step @ T_world
        yield name, name, _entry(source, fields, T_world)


def _entry(source: Source, fields: CameraFields, T: Float[np.ndarray, "4 4"] | None) -> Entry:
    model = str(fields.values.get("camera_model"))
    if model != "pinhole":
        raise fields.error("camera_model", "pinhole, the model that OpenCV has", model, _REMEDY)
    distortion = str(fields.values.get("distortion_model", "none"))
    if distortion not in _FISHEYE:
        raise fields.error("distortion_model", "radtan, equidistant or none", distortion, _REMEDY)
    fu, fv, pu, pv = fields.array(("intrinsics",), (4,))
    if not (fu > 0 and fv > 0):
        raise fields.error("intrinsics", "focal lengths above 0", f"{fu:g} and {fv:g}")
    dist = np.zeros(0)
    if distortion != "none":
        dist = fields.array(("distortion_coeffs",), (4,))
    pose = np.eye(4) if T is None else T
    camera = make_camera(
        fisheye=_FISHEYE[distortion],
        R=pose[:3, :3],
        t_m=pose[:3, 3],
        K=np.array([[fu, 0.0, pu], [0.0, fv, pv], [0.0, 0.0, 1.0]]),
        dist=dist.tolist(),
        image_size_wh=image_size(fields, source.image_size_wh),
    )
    return Entry(camera, placed=T is not None)


def _step(fields: CameraFields) -> Float[np.ndarray, "4 4"]:
    T = fields.array(("T_cn_cnm1",), (4, 4))
    if not np.allclose(T[3], [0, 0, 0, 1]):
        raise fields.error("T_cn_cnm1", "a last row 0, 0, 0, 1", quoted(T[3].tolist()))
    T[:3, :3] = rotation_matrix(T[:3, :3], fields, "T_cn_cnm1")
    return T
