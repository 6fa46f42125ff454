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
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from psotrack.geometry.rig_files.fields import CameraFields, quoted
from psotrack.geometry.rig_files.guarded_text import parse_yaml

_MODELS = {"radtan": "opencv", "equidistant": "fisheye", "equi": "fisheye", "none": "opencv"}
_REMEDY = "calibrate again with pinhole-radtan or pinhole-equi, or by `psotrack calibrate rig`"


def recognises(text: str) -> bool:
    """Whether a text is a camera chain of Kalibr."""
    return bool(re.search(r"^cam\d+:", text, re.M)) and "camera_model:" in text


def read(path: Path, text: str) -> Iterator[CameraFields]:
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
