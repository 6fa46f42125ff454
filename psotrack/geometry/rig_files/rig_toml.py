"""`rig.toml`, the package's own format: a table `[cameras.NAME]` per camera.

    version = 1

    [cameras.left]
    size = [1920, 1080]
    K = [[1160.2, 0.0, 961.0], [0.0, 1160.9, 541.2], [0.0, 0.0, 1.0]]
    model = "opencv"                           # or "fisheye"
    distortion = [-0.28, 0.09, 0.0, 0.0, 0.01] # OpenCV's order: 0, 4, 5, 8, 12 or 14 numbers; 4 of a fisheye
    rvec = [1.2, -0.4, 0.3]                    # x_cam = R X + t, R as Rodrigues vector; or R = [[...], [...], [...]]
    tvec = [0.1, 0.2, 5.0]                     # metres

Numbers are written with all their digits: reading gives the same bits, and of `rvec` the same matrix within 1e-15. A
camera whose place is not known has no `rvec`, `R` and `tvec`. `recording.toml` has the same keys beside its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

from psotrack.errors import InputError
from psotrack.geometry import Camera, Rig
from psotrack.geometry.rig_files.entries import Entry, FileRig, Source
from psotrack.geometry.rig_files.fields import CameraFields, entry_from_fields, lens_model
from psotrack.support import atomic_write, nearest, read_toml, toml_key, toml_value

#: Newest version of the layout.
VERSION = 1
#: Keys of a camera's lens and place.
KEYS = ("size", "K", "model", "distortion", "rvec", "R", "tvec")
#: Keys that a camera has in addition in a recording.toml.
RECORDING_KEYS = (
    "video", "images", "silhouettes", "ignore", "detections", "frames", "fps", "time_offset_s", "timestamps",
    "line_time_s",
)  # fmt: skip
_MODELS = ("opencv", "fisheye")


def camera_of_table(
    path: Path, name: str, table: Mapping[str, Any], image_size_wh: tuple[int, int] | None = None
) -> Entry:
    """The camera that a table `[cameras.NAME]` describes; keys of a recording are left alone.

    Args:
        path: path of the file, for messages.
        name: name of the camera.
        table: the table.
        image_size_wh: width and height in pixels, if the table has no `size`.

    Returns:
        The camera, in metres; without a camera if the table has no `K`, not placed if it has no `rvec` and `tvec`.

    Raises:
        InputError: a key is unknown, missing or wrong.
    """
    fields = CameraFields(path, f"cameras.{name}", table)
    for key in table:
        if key not in (*KEYS, *RECORDING_KEYS):
            near = nearest(key, KEYS)
            remedy = f"did you mean {near}?" if near else ""
            raise fields.error(key, f"one of {', '.join(KEYS)}", key, remedy)
    model = table.get("model", "opencv")
    if model not in _MODELS:
        raise fields.error("model", " or ".join(_MODELS), str(model))
    if table.get("distortion") is not None and not isinstance(table["distortion"], list):
        raise fields.error("distortion", "a list of numbers", str(table["distortion"]))
    if table.get("K") is None and any(key in table for key in ("distortion", "rvec", "R", "tvec")):
        raise fields.error("K", "3 x 3 numbers", "none")
    if "rvec" in table and "R" in table:
        raise fields.error("R", "rvec or R", "both")
    turn = [key for key in ("rvec", "R") if key in table]
    if bool(turn) != ("tvec" in table):
        missing, other = ("tvec", turn[0]) if turn else ("rvec", "tvec")
        raise fields.error(missing, f"3 numbers, as for {other}", "none")
    return entry_from_fields(fields, image_size_wh)


def recognises(data: Mapping[str, Any]) -> bool:
    """Whether the tables of a TOML file are a rig.toml's."""
    cameras = data.get("cameras")
    tables = (
        [table for table in cameras.values() if isinstance(table, dict)] if isinstance(cameras, dict) else []
    )
    own = {"K", "model", "distortion", "rvec", "R", "tvec"}
    return any(own & table.keys() for table in tables) or (bool(tables) and "version" in data)


def read(source: Source) -> FileRig:
    """Read a rig.toml; lengths are metres."""
    data = read_toml(source.path)
    version = data.get("version", VERSION)
    if version != VERSION:
        raise InputError(
            f"{source.path}, version",
            expected=f"{VERSION}",
            found=f"{version}",
            remedy="use a newer psotrack",
        )
    cameras = data.get("cameras")
    if not isinstance(cameras, dict) or not cameras:
        raise InputError(source.path, expected="a table [cameras.NAME] per camera", found="none")
    for name, table in cameras.items():
        if not isinstance(table, dict):
            raise InputError(f"{source.path}, cameras.{name}", expected="a table", found=f"{table}")
    entries = {
        name: camera_of_table(source.path, name, table, source.image_size_wh)
        for name, table in cameras.items()
    }
    return FileRig(entries, metres_per_unit=1.0)


def write(path: Path, rig: Rig, *, placed: bool = True) -> None:
    """Write a rig.toml; with `placed` false, only the lenses."""
    blocks = [f"version = {VERSION}"]
    for index, name in enumerate(rig.names):
        lines = [f"[cameras.{toml_key(name)}]"]
        lines += [
            f"{key} = {toml_value(value)}" for key, value in _fields(rig.cameras[index], placed).items()
        ]
        blocks.append("\n".join(lines))
    with atomic_write(path) as temporary:
        temporary.write_text("\n\n".join(blocks) + "\n", encoding="utf-8")


def _fields(camera: Camera, placed: bool) -> dict[str, Any]:
    distortion, fisheye = lens_model(camera)
    fields: dict[str, Any] = {
        "size": [int(side) for side in camera.image_size_wh],
        "K": camera.K.tolist(),
        "model": "fisheye" if fisheye else "opencv",
        "distortion": distortion,
    }
    if placed:
        fields["rvec"] = Rotation.from_matrix(camera.T_cam_world[:3, :3]).as_rotvec().tolist()
        fields["tvec"] = camera.T_cam_world[:3, 3].tolist()
    return fields
