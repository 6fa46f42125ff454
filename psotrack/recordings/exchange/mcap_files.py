"""MCAP files with ROS 2 messages: a topic of poses per drone, TF, and with a recording the cameras and their images.

    /NAME/pose                      geometry_msgs/PoseWithCovarianceStamped, in the frame `world`
    /tf                             the drones at each time; the cameras, whose z looks ahead, at each whole second and
                                    at the end, so that no player has to know that they stand still
    /CAMERA/camera_info             sensor_msgs/CameraInfo
    /CAMERA/image/compressed        sensor_msgs/CompressedImage, JPEG

Stamps are times on the recording's clock, from 0 on. A drone whose name is no ROS name, such as `0`, has the topic
/drone_0/pose; the metadata record `psotrack` has the names. The folder of a rosbag2 bag can be read, too. The libraries
mcap and mcap-ros2-support are an extra: `pip install '.[ros]'`. The definitions of messages, which MCAP files carry,
are those of the packages std_msgs, geometry_msgs, sensor_msgs and tf2_msgs of ROS 2 (Humble and newer).
"""

from __future__ import annotations

import contextlib
import heapq
import io
import json
import re
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError, SettingsError, install_command
from psotrack.geometry import Camera
from psotrack.recordings import FrameTimes, Recording, VideoInfo, read_frames
from psotrack.recordings.exchange.camera_boxes import Footage, camera_frames
from psotrack.recordings.exchange.timed_paths import joined
from psotrack.support import LARGEST, MODERATE, Advance, Report, first_repeat
from psotrack.trajectories import Trajectories, timed_path

_Point = Float[np.ndarray, "3"]
_Turn = Float[np.ndarray, "4"]
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
    position_m: _Point,
    orientation_wxyz: _Turn,
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
    position_m: _Point,
    orientation_wxyz: _Turn,
) -> dict[str, Any]:
    """Where the coordinate frame `child` is; an unknown orientation, NaN, is the identity."""
    place = {"translation": _vector(position_m), "rotation": _quaternion(orientation_wxyz)}
    return {"header": head, "child_frame_id": child, "transform": place}


def camera_pose(camera: Camera) -> tuple[_Point, _Turn]:
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


def _vector(values: _Point) -> dict[str, float]:
    return dict(zip("xyz", map(float, values), strict=True))


def _quaternion(orientation_wxyz: _Turn) -> dict[str, float]:
    wxyz = orientation_wxyz if np.isfinite(orientation_wxyz).all() else (1.0, 0.0, 0.0, 0.0)
    return dict(zip("wxyz", map(float, wxyz), strict=True))


WORLD, METADATA = "world", "psotrack"
_JPEG_QUALITY = 90
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
#: Bytes of the record at a file's end, with the mark after it.
_FOOTER_BYTES = 37
#: Types of messages whose poses are read.
_READ = (POSE, "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped")
#: Time in nanoseconds, topic, type and content of a message.
_Message = tuple[int, str, str, dict[str, Any]]
#: Time in seconds, position, orientation and the 36 numbers of the covariance of a pose.
_Row = tuple[float, list[float], list[float], np.ndarray]


def write_mcap(path: Path, trajectories: Trajectories, footage: Footage | None, report: Report) -> list[str]:
    """Write poses of the drones, and with a recording its cameras; return what is missing in it, as noun phrases.

    Args:
        path: the file.
        trajectories: the tracks.
        footage: the recording, and whether its images are written; None: poses alone.
        report: shows the progress in frames of the tracks and images.

    Raises:
        SettingsError: the libraries are not installed.
        InputError: a time is below 0, two drones have one topic, or a video cannot be read.
    """
    writer_class = _library("mcap_ros2.writer").Writer
    if (trajectories.time_s < 0).any():
        raise InputError(
            "tracks",
            expected="times from 0 s on, for stamps of ROS",
            found=f"{trajectories.time_s.min():g} s",
        )
    names = _ros_names(trajectories.drones, "drone")
    times = {} if footage is None else camera_frames(footage.recording, trajectories)
    of_ros = dict(zip(times, _ros_names(list(times), "cam"), strict=True))
    _check_different([WORLD, *names, *of_ros.values()])
    lenses, videos = dict[str, Camera](), dict[str, VideoInfo]()
    if footage is not None:
        filmed = [each for each in footage.recording.placed if each.name in times]
        lenses = {each.name: each.camera for each in filmed if each.camera is not None}
        videos = {each.name: each.video for each in filmed if footage.images and each.video is not None}
    total = trajectories.num_frames + sum(times[own].num_frames for own in videos)
    with report("messages", total) as advance, path.open("wb") as stream:
        streams = [_drone_messages(trajectories, names, advance)]
        if footage is not None:
            named = {of_ros[own]: lens for own, lens in lenses.items()}
            streams.insert(0, _camera_messages(named, float(trajectories.time_s[-1])))
        for own, video in videos.items():
            streams.append(_image_messages(of_ros[own], lenses[own], video, times[own], advance))
        writer = writer_class(stream)
        schemas = {name: writer.register_msgdef(name, text) for name, text in DEFINITIONS.items()}
        drones = dict(zip((f"/{name}/pose" for name in names), trajectories.drones, strict=True))
        writer.add_metadata(METADATA, {"version": "1", "drones": json.dumps(drones, ensure_ascii=False)})
        for time_ns, topic, kind, content in heapq.merge(*streams, key=lambda message: message[0]):
            writer.write_message(topic, schemas[kind], content, time_ns, time_ns)
        writer.finish()
    lost = [own for own, lens in lenses.items() if camera_message({}, lens) is None]
    return [f"the lens of {own}, for which ROS has no model" for own in lost]


def read_mcap(path: Path, recording: Recording | None) -> Trajectories:
    """The paths in the poses of an MCAP file: a drone for each topic of poses, with or without covariance, or odometry.

    Args:
        path: the file, or the folder of a bag with one MCAP file.
        recording: the recording, or None if none is known.

    Raises:
        SettingsError: the libraries are not installed.
        InputError: the file cannot be read, is cut short, has no poses, or a topic has two poses of one time.
    """
    if path.is_dir():
        files = sorted(path.glob("*.mcap"))
        if len(files) != 1:
            raise InputError(path, expected="a bag with one MCAP file", found=f"{len(files)} MCAP files")
        path = files[0]
    make_reader = _library("mcap.reader").make_reader
    decoder = _library("mcap_ros2.decoder").DecoderFactory()
    rows: dict[str, list[_Row]] = {}
    names: dict[str, str] = {}
    try:
        # The library also prints what it finds in a damaged file.
        with path.open("rb") as stream, contextlib.redirect_stderr(io.StringIO()):
            reader = make_reader(stream, validate_crcs=True, decoder_factories=[decoder])
            summary = reader.get_summary()
            if summary is None:
                raise EOFError("no summary at its end")
            _check_summary(stream)
            for record in reader.iter_metadata():
                if record.name == METADATA:
                    names = json.loads(record.metadata["drones"])
            kinds = {each.topic: summary.schemas[each.schema_id].name for each in summary.channels.values()}
            topics = [topic for topic, kind in kinds.items() if kind in _READ]
            for _, channel, _, message in reader.iter_decoded_messages(topics=topics) if topics else ():
                rows.setdefault(channel.topic, []).append(_row(message))
    except OSError as error:
        raise InputError(
            path, expected="a file to read", found=(error.strerror or f"{error}").lower()
        ) from error
    except Exception as error:  # The library raises whatever a damaged byte leads to.
        found = f"a damaged or shortened file ({type(error).__name__}: {error})".partition("\n")[0]
        raise InputError(path, expected="an MCAP file", found=found, remedy="copy it again") from error
    if not rows:
        found = ", ".join(sorted(kinds)) or "no topic"
        raise InputError(path, expected="a topic with poses or odometry of ROS 2", found=found)
    paths = [
        _path(f"{path}, topic {topic}", names.get(topic) or _drone_of(topic, rows), each)
        for topic, each in rows.items()
    ]
    return joined(path, paths, recording)


def _check_summary(stream: BinaryIO) -> None:
    """Raise `ValueError` for a summary with another checksum than its own; the library checks those of chunks alone."""
    stream.seek(-_FOOTER_BYTES, io.SEEK_END)
    footer = stream.read(_FOOTER_BYTES)
    stream.seek(int.from_bytes(footer[9:17], "little"))
    # The checksum itself and the eight bytes after it do not count.
    summary, stated = stream.read()[:-12], int.from_bytes(footer[-12:-8], "little")
    if stated and zlib.crc32(summary) != stated:
        raise ValueError("another checksum of the summary than the file says")


def _row(message: Any) -> _Row:
    """Time, position, orientation and covariance of a message; a pose alone states no covariance."""
    stated = hasattr(message.pose, "pose")
    stamp, pose = message.header.stamp, message.pose.pose if stated else message.pose
    place, turn = pose.position, pose.orientation
    return (
        stamp.sec + stamp.nanosec * 1e-9,
        [place.x, place.y, place.z],
        [turn.w, turn.x, turn.y, turn.z],
        np.asarray(message.pose.covariance, float) if stated else np.zeros(36),
    )


def _path(where: str, name: str, rows: list[_Row]) -> Trajectories:
    """The path of a drone from the poses of its topic."""
    rows = sorted(rows, key=lambda row: row[0])
    time_s, position_m, orientation, covariance = (np.array(column) for column in zip(*rows, strict=True))
    again = first_repeat(time_s)
    if again is not None:
        raise InputError(where, expected="one pose per time", found=f"two at {time_s[again]:g} s")
    if (far := np.abs(orientation) > LARGEST).any():
        raise InputError(where, expected=MODERATE, found=f"{orientation[far][0]:g} in an orientation")
    length = np.linalg.norm(orientation, axis=1)
    variance_rad2 = covariance[:, [21, 28, 35]]
    unknown = (variance_rad2 >= UNKNOWN_RAD2).any(axis=1) | (length == 0)
    orientation[~unknown] /= length[~unknown, None]
    orientation[unknown] = np.nan
    block = covariance.reshape(-1, 6, 6)[:, :3, :3]
    stated = block.any(axis=(1, 2)) & (block[:, 0, 0] >= 0)
    block = np.where(stated[:, None, None], (block + block.swapaxes(1, 2)) / 2, np.nan)
    return timed_path(name, time_s, position_m, orientation, block if stated.any() else None)


def _drone_of(topic: str, topics: dict[str, Any]) -> str:
    """Name of the drone of a topic: its first part that no other topic has there, else the topic."""
    first = [each.strip("/").split("/")[0] for each in topics]
    own = topic.strip("/").split("/")[0]
    return own if first.count(own) == 1 else topic.strip("/")


def _ros_names(names: Sequence[str], prefix: str) -> list[str]:
    """Names that ROS allows in topics: letters, digits and _, not beginning with a digit."""
    found = []
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
        found.append(plain if _NAME.match(plain) else f"{prefix}_{plain}")
    return found


def _check_different(names: Sequence[str]) -> None:
    """Raise `InputError` for a drone and another drone, a camera or the world with one name."""
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise InputError(
            "names", expected="drones and cameras that differ as names of ROS", found=f"{twice[0]} twice"
        )


def _drone_messages(trajectories: Trajectories, names: list[str], advance: Advance) -> Iterator[_Message]:
    """A pose for each drone that is seen at a time, and one message of transforms for all."""
    seen, values = trajectories.seen, trajectories.quantities()
    orientation_wxyz = values.get("orientation_wxyz", np.full((*seen.shape, 4), np.nan))
    covariance_m2 = values.get("covariance_m2", np.full((*seen.shape, 3, 3), np.nan))
    times_ns = np.round(trajectories.time_s.astype(float) * 1e9).astype(np.int64).tolist()
    for row, time_ns in enumerate(times_ns):
        head = header(time_ns, WORLD)
        transforms = []
        advance(1)
        for drone in np.flatnonzero(seen[row]).tolist():
            pose = trajectories.position_m[row, drone], orientation_wxyz[row, drone]
            message = pose_message(head, *pose, covariance_m2[row, drone])
            yield time_ns, f"/{names[drone]}/pose", POSE, message
            transforms.append(transform(head, names[drone], *pose))
        if transforms:
            yield time_ns, "/tf", TRANSFORMS, {"transforms": transforms}


def _camera_messages(lenses: dict[str, Camera], last_s: float) -> Iterator[_Message]:
    """Lenses of the cameras at time 0, and their places at each whole second and at the end."""
    for name, lens in lenses.items():
        info = camera_message(header(0, name), lens)
        if info is not None:
            yield 0, f"/{name}/camera_info", CAMERA_INFO, info
    poses = [(name, *camera_pose(lens)) for name, lens in lenses.items()]
    last_ns = round(last_s * 1e9)
    for time_ns in (*range(0, last_ns, 10**9), last_ns):
        head = header(time_ns, WORLD)
        yield time_ns, "/tf", TRANSFORMS, {"transforms": [transform(head, *pose) for pose in poses]}


def _image_messages(
    name: str, lens: Camera, video: VideoInfo, times: FrameTimes, advance: Advance
) -> Iterator[_Message]:
    """The images of a camera, each with the camera's lens; an image whose time is below 0 is left out."""
    times_ns = np.round(times.time_s * 1e9).astype(np.int64).tolist()
    wanted = replace(video, num_frames=min(video.num_frames, len(times_ns)))
    for time_ns, image in zip(times_ns, read_frames(wanted), strict=False):
        advance(1)
        if time_ns < 0:
            continue
        encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
        head = header(time_ns, name)
        info = camera_message(head, lens)
        if info is not None and time_ns > 0:
            yield time_ns, f"/{name}/camera_info", CAMERA_INFO, info
        content = {"header": head, "format": "jpeg", "data": encoded}
        yield time_ns, f"/{name}/image/compressed", IMAGE, content


def _library(name: str) -> ModuleType:
    """A module of the extra `ros`."""
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError as error:
        expected, remedy = "the packages mcap and mcap-ros2-support", install_command("ros")
        raise SettingsError("mcap", expected=expected, found=f"{error}".lower(), remedy=remedy) from error
