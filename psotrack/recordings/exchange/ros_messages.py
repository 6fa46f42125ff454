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

_PARTS = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform"
    ),
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "sensor_msgs/RegionOfInterest": (
        "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify"
    ),
}
_WHOLE = {
    POSE: (
        "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose",
        ("std_msgs/Header", "builtin_interfaces/Time", "geometry_msgs/PoseWithCovariance", "geometry_msgs/Pose",
         "geometry_msgs/Point", "geometry_msgs/Quaternion"),
    ),
    TRANSFORMS: (
        "geometry_msgs/TransformStamped[] transforms",
        ("geometry_msgs/TransformStamped", "std_msgs/Header", "builtin_interfaces/Time", "geometry_msgs/Transform",
         "geometry_msgs/Vector3", "geometry_msgs/Quaternion"),
    ),
    CAMERA_INFO: (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n"
        "float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi",
        ("std_msgs/Header", "builtin_interfaces/Time", "sensor_msgs/RegionOfInterest"),
    ),
    IMAGE: (
        "std_msgs/Header header\nstring format\nuint8[] data",
        ("std_msgs/Header", "builtin_interfaces/Time"),
    ),
}  # fmt: skip

#: Definition of each message with those of its parts.
DEFINITIONS = {
    name: "\n".join([text, *(f"{'=' * 80}\nMSG: {part}\n{_PARTS[part]}" for part in parts)]) + "\n"
    for name, (text, parts) in _WHOLE.items()
}


def header(time_ns: int, frame: str) -> dict[str, Any]:
    """A header with a time and the name of a coordinate frame."""
    return {"stamp": {"sec": time_ns // 10**9, "nanosec": time_ns % 10**9}, "frame_id": frame}


def pose_message(
    head: dict[str, Any],
    position_m: Float[np.ndarray, "3"],
    orientation_wxyz: Float[np.ndarray, "4"] | None,
    covariance_m2: Float[np.ndarray, "3 3"] | None,
) -> dict[str, Any]:
    """A pose. A covariance of zeros is an unknown covariance, as in ROS; see `UNKNOWN_RAD2` for the orientation."""
    covariance = np.zeros((6, 6))
    if covariance_m2 is not None and np.isfinite(covariance_m2).all():
        covariance[:3, :3] = covariance_m2
    if not _is_known(orientation_wxyz):
        covariance[[3, 4, 5], [3, 4, 5]] = UNKNOWN_RAD2
    pose = {"position": _vector(position_m), "orientation": _quaternion(orientation_wxyz)}
    return {"header": head, "pose": {"pose": pose, "covariance": covariance.ravel().tolist()}}


def transform(
    head: dict[str, Any],
    child: str,
    position_m: Float[np.ndarray, "3"],
    orientation_wxyz: Float[np.ndarray, "4"] | None,
) -> dict[str, Any]:
    """Where the coordinate frame `child` is; an unknown orientation is the identity."""
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


def _is_known(orientation_wxyz: Float[np.ndarray, "4"] | None) -> bool:
    return orientation_wxyz is not None and bool(np.isfinite(orientation_wxyz).all())


def _vector(values: Float[np.ndarray, "3"]) -> dict[str, float]:
    return dict(zip("xyz", map(float, values), strict=True))


def _quaternion(orientation_wxyz: Float[np.ndarray, "4"] | None) -> dict[str, float]:
    wxyz = (
        orientation_wxyz
        if orientation_wxyz is not None and _is_known(orientation_wxyz)
        else (1.0, 0.0, 0.0, 0.0)
    )
    return dict(zip("wxyz", map(float, wxyz), strict=True))
