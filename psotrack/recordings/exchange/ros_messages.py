"""The ROS 2 messages of an export: their definitions, as MCAP files carry them, and their content as plain values.

The definitions are those of the packages std_msgs, geometry_msgs, sensor_msgs and tf2_msgs of ROS 2 (Humble and newer).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.geometry import Camera

POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMAGE = "sensor_msgs/msg/CompressedImage"

#: Variance of each angle of an orientation that is not known, rad²: the message has no other way to say so.
UNKNOWN_RAD2 = 1e9

#: Lines of the definition of each message, and of the types of its fields.
_LINES = {
    POSE: ("std_msgs/Header header", "geometry_msgs/PoseWithCovariance pose"),
    TRANSFORMS: ("geometry_msgs/TransformStamped[] transforms",),
    CAMERA_INFO: (
        "std_msgs/Header header", "uint32 height", "uint32 width", "string distortion_model", "float64[] d",
        "float64[9] k", "float64[9] r", "float64[12] p", "uint32 binning_x", "uint32 binning_y",
        "sensor_msgs/RegionOfInterest roi",
    ),
    IMAGE: ("std_msgs/Header header", "string format", "uint8[] data"),
    "std_msgs/Header": ("builtin_interfaces/Time stamp", "string frame_id"),
    "builtin_interfaces/Time": ("int32 sec", "uint32 nanosec"),
    "geometry_msgs/PoseWithCovariance": ("geometry_msgs/Pose pose", "float64[36] covariance"),
    "geometry_msgs/Pose": ("geometry_msgs/Point position", "geometry_msgs/Quaternion orientation"),
    "geometry_msgs/Point": ("float64 x", "float64 y", "float64 z"),
    "geometry_msgs/Vector3": ("float64 x", "float64 y", "float64 z"),
    "geometry_msgs/Quaternion": ("float64 x", "float64 y", "float64 z", "float64 w"),
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header", "string child_frame_id", "geometry_msgs/Transform transform",
    ),
    "geometry_msgs/Transform": ("geometry_msgs/Vector3 translation", "geometry_msgs/Quaternion rotation"),
    "sensor_msgs/RegionOfInterest": (
        "uint32 x_offset", "uint32 y_offset", "uint32 height", "uint32 width", "bool do_rectify",
    ),
}  # fmt: skip


def _definition(message: str) -> str:
    """Definition of a message with those of its parts."""
    names = [message]
    # Names are found while the list is read.
    for name in names:
        kinds = [line.split()[0].removesuffix("[]") for line in _LINES[name]]
        names += dict.fromkeys(kind for kind in kinds if kind in _LINES and kind not in names)
    parts = [f"{'=' * 80}\nMSG: {name}\n" + "\n".join(_LINES[name]) for name in names[1:]]
    return "\n".join([*_LINES[message], *parts]) + "\n"


#: Definition of each message with those of its parts.
DEFINITIONS = {name: _definition(name) for name in (POSE, TRANSFORMS, CAMERA_INFO, IMAGE)}


def header(time_ns: int, frame: str) -> dict[str, Any]:
    """A header with a time and the name of a coordinate frame."""
    return {"stamp": {"sec": time_ns // 10**9, "nanosec": time_ns % 10**9}, "frame_id": frame}


def pose_message(
    head: dict[str, Any],
    position_m: Float[np.ndarray, "3"],
    orientation_wxyz: Float[np.ndarray, "4"],
    covariance_m2: Float[np.ndarray, "3 3"],
) -> dict[str, Any]:
    """A pose; orientation and covariance are NaN where they are not known.

    A covariance of zeros is an unknown covariance, as in ROS; see `UNKNOWN_RAD2` for the orientation.
    """
    covariance = np.zeros((6, 6))
    if np.isfinite(covariance_m2).all():
        covariance[:3, :3] = covariance_m2
    if not np.isfinite(orientation_wxyz).all():
        covariance[[3, 4, 5], [3, 4, 5]] = UNKNOWN_RAD2
    pose = {"position": _vector(position_m), "orientation": _quaternion(orientation_wxyz)}
    return {"header": head, "pose": {"pose": pose, "covariance": covariance.ravel().tolist()}}


def transform(
    head: dict[str, Any],
    child: str,
    position_m: Float[np.ndarray, "3"],
    orientation_wxyz: Float[np.ndarray, "4"],
) -> dict[str, Any]:
    """Where the coordinate frame `child` is; an unknown orientation, NaN, is the identity."""
    place = {"translation": _vector(position_m), "rotation": _quaternion(orientation_wxyz)}
    return {"header": head, "child_frame_id": child, "transform": place}


def camera_pose(camera: Camera) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4"]]:
    """Centre of a camera in the world, metres, and its orientation, camera to world, w first; z looks ahead."""
    R = np.asarray(camera.T_cam_world)[:3, :3]
    return np.asarray(camera.centre_world), Rotation.from_matrix(R.T).as_quat(scalar_first=True)


def camera_message(head: dict[str, Any], camera: Camera) -> dict[str, Any] | None:
    """Intrinsics and lens of a camera; None for a lens that the message cannot hold.

    ROS has plumb_bob (5 coefficients), rational_polynomial (8) and equidistant (the fisheye model, 4), all without
    skew; thin prisms and tilted sensors have no place.
    """
    dist, K = np.asarray(camera.dist, float), np.asarray(camera.K, float)
    if K[0, 1] != 0:
        return None
    if camera.fisheye is not None and bool(camera.fisheye):
        model, d = "equidistant", np.resize(dist[:4], 4)
    elif not dist[5:].any():
        model, d = "plumb_bob", np.pad(dist[:5], (0, 5 - len(dist[:5])))
    elif not dist[8:].any():
        model, d = "rational_polynomial", dist[:8]
    else:
        return None
    width, height = np.asarray(camera.image_size_wh).astype(int).tolist()
    return {
        "header": head,
        "height": height,
        "width": width,
        "distortion_model": model,
        "d": d.tolist(),
        "k": K.ravel().tolist(),
        "r": np.eye(3).ravel().tolist(),
        "p": np.hstack([K, np.zeros((3, 1))]).ravel().tolist(),
        "binning_x": 0,
        "binning_y": 0,
        "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
    }


def _vector(values: Float[np.ndarray, "3"]) -> dict[str, float]:
    return dict(zip("xyz", map(float, values), strict=True))


def _quaternion(orientation_wxyz: Float[np.ndarray, "4"]) -> dict[str, float]:
    wxyz = orientation_wxyz if np.isfinite(orientation_wxyz).all() else (1.0, 0.0, 0.0, 0.0)
    return dict(zip("wxyz", map(float, wxyz), strict=True))
