"""`recording.toml`: the file of a recording, which names the videos, the calibration and the reference of any rig.

Only the file itself is read and checked here. `psotrack.recordings.datasets.open_recording` opens the files that it
names.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from psotrack.errors import InputError
from psotrack.geometry import camera_key
from psotrack.recordings.timing import check_rate
from psotrack.support import Positive, atomic_write, check_file_name, convert, read_toml, toml_text

#: Name of the file in a folder.
RECORDING_FILE = "recording.toml"

Vector = tuple[float, float, float]
Pixels = Annotated[int, msgspec.Meta(ge=1)]
Text = Annotated[str, msgspec.Meta(min_length=1)]

#: Pairs of keys of a camera of which only one may be there.
_EXCLUSIVE = (
    ("video", "images"),
    ("timestamps", "fps"),
    ("timestamps", "time_offset_s"),
    *((key, "frames") for key in ("video", "images", "silhouettes", "timestamps")),
    ("rvec", "R"),
)


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of the tables of the file: immutable, unknown keys are refused."""


class CameraTable(_Table, frozen=True, kw_only=True):
    """Table `[cameras.NAME]`: what is known of one camera.

    Attributes:
        video: a video file, a folder of pictures, the address of a stream, or the number or path of a device.
        images: pattern of image files, which are the frames in natural order.
        silhouettes: folder of stored silhouettes.
        ignore: image file, white where nothing counts as foreground.
        detections: file of detections, in the layout of the dataset's dl_data.
        size: width and height of the images, pixels.
        frames: number of frames of a camera of which only detections are known.
        fps: frames per second.
        time_offset_s: time of frame 0 on the recording's clock, seconds.
        timestamps: CSV file with the columns `frame` and `time_s`.
        line_time_s: time from the exposure of one row to the exposure of the next row, seconds.
        K: intrinsics, three rows of three numbers, pixels.
        model: lens model.
        distortion: coefficients in OpenCV's order.
        rvec: Rodrigues vector of the rotation from world to camera.
        R: the same rotation as a matrix, three rows of three numbers.
        tvec: translation from world to camera, metres.
    """

    video: Text | int | None = None
    images: Text | None = None
    silhouettes: Text | None = None
    ignore: Text | None = None
    detections: Text | None = None
    size: tuple[Pixels, Pixels] | None = None
    frames: Annotated[int, msgspec.Meta(ge=1)] | None = None
    fps: Positive | None = None
    time_offset_s: float | None = None
    timestamps: Text | None = None
    line_time_s: float = 0.0
    K: tuple[Vector, Vector, Vector] | None = None
    model: Literal["opencv", "fisheye"] | None = None
    distortion: tuple[float, ...] | None = None
    rvec: Vector | None = None
    R: tuple[Vector, Vector, Vector] | None = None
    tvec: Vector | None = None


class WorldTable(_Table, frozen=True, kw_only=True):
    """Table `[world]`.

    Attributes:
        bounds_m: lowest and highest corner of the space in which drones are looked for, metres.
    """

    bounds_m: tuple[Vector, Vector] | None = None


class ReferenceTable(_Table, frozen=True, kw_only=True):
    """Table `[reference]`.

    Attributes:
        files: pose CSV, TUM or C3D files.
        time_offset_s: time on the recording's clock at which the clock of the reference shows 0, seconds.
        bodies: labels of the markers of each drone in the C3D file, where the labels do not say it themselves.
    """

    files: tuple[Text, ...]
    time_offset_s: float = 0.0
    bodies: Mapping[Text, tuple[Text, ...]] = {}


class MarkersTable(_Table, frozen=True, kw_only=True):
    """Table `[markers]`.

    Attributes:
        corners: table of marker corners.
    """

    corners: Text


class RecordingFile(_Table, frozen=True, kw_only=True):
    """Content of a `recording.toml`; paths are as written in the file.

    Attributes:
        version: version of the layout.
        calibration: rig file.
        calibration_unit: unit of lengths in the rig file, where its format leaves the unit open.
        cameras: table of each camera, by name.
        world: table `[world]`.
        reference: table `[reference]`; None without a reference.
        markers: table `[markers]`; None without markers.
    """

    version: Literal[1]
    calibration: Text | None = None
    calibration_unit: Literal["m", "cm", "mm"] | None = None
    cameras: Mapping[str, CameraTable]
    world: WorldTable = WorldTable()
    reference: ReferenceTable | None = None
    markers: MarkersTable | None = None


def read_recording_file(path: Path | str) -> RecordingFile:
    """Read and check the tables of a `recording.toml`; the files that it names are not opened.

    Raises:
        InputError: the file cannot be read, or a key is unknown, missing or wrong. The message names file, table and
            key.
    """
    path = Path(path)
    data = read_toml(path)
    _check_keys(path, data)
    tables = data.get("cameras")
    if not isinstance(tables, dict) or not tables:
        found = "none" if tables is None or tables == {} else "another value"
        raise file_error(path, "cameras", "a table [cameras.NAME] for each camera", found)
    _check_names(path, tables)
    # Each table is converted by itself, because msgspec's messages do not name the key of a mapping.
    cameras = {name: _read_camera(path, name, table) for name, table in tables.items()}
    content = convert({**data, "cameras": {}}, RecordingFile, f"{path}, ")
    if content.calibration_unit is not None and content.calibration is None:
        raise file_error(path, "calibration", "a rig file, because there is a calibration_unit", "none")
    _check_bounds(path, content.world)
    return msgspec.structs.replace(content, cameras=cameras)


def _read_camera(path: Path, name: str, table: Any) -> CameraTable:
    place = f"cameras.{name}"
    if not isinstance(table, dict):
        raise file_error(path, place, f"a table [{place}]", f"{table!r}")
    camera = convert(table, CameraTable, f"{path}, {place}.")
    for one, other in _EXCLUSIVE:
        if table.get(one) is not None and table.get(other) is not None:
            raise file_error(path, place, f"{one} or {other}", "both")
    if camera.fps is not None:
        check_rate(f"{path}, {place}.fps", camera.fps)
    if camera.video is None and camera.fps is None and camera.timestamps is None:
        why = (
            ", because the camera has no video" if camera.images is None else " of the images, or timestamps"
        )
        raise file_error(path, f"{place}.fps", f"frames per second{why}", "none")
    return camera


def _check_keys(path: Path, data: Mapping[str, Any]) -> None:
    """Raise `InputError` for keys of a camera at the top of the file, where they belong to no camera."""
    names = [field.name for field in msgspec.structs.fields(RecordingFile)]
    for key in data:
        if key not in names and key in CameraTable.__struct_fields__:
            remedy = "write it below [cameras.NAME] of the camera that it belongs to"
            raise file_error(path, key, f"one of {', '.join(names)}", key, remedy)


def _check_names(path: Path, tables: Mapping[str, Any]) -> None:
    """Raise `InputError` for a name that cannot be the name of a file, and for two spellings of one name."""
    spellings: dict[str, str] = {}
    for name in tables:
        check_file_name(name, f"{path}, cameras")
        # Options have lists of names, and pairs of a name and a value.
        if set(name) & set(",="):
            raise file_error(path, "cameras", "names without commas and equals signs", repr(name))
        key = camera_key(name)
        if key in spellings:
            raise file_error(
                path, f"cameras.{name}", "each camera once", f"{spellings[key]} as well, the same name"
            )
        spellings[key] = name


def _check_bounds(path: Path, world: WorldTable) -> None:
    if world.bounds_m is not None:
        low, high = world.bounds_m
        if any(a >= b for a, b in zip(low, high, strict=True)):
            expected = "the lowest corner, then the highest corner"
            raise file_error(path, "world.bounds_m", expected, f"{list(low)} and {list(high)}")


def file_error(path: Path, place: str, expected: str, found: str, remedy: str = "") -> InputError:
    """Error about a place in a `recording.toml`; an empty place is the whole file."""
    where = f"{path}, {place}" if place else path
    return InputError(where, expected=expected, found=found, remedy=remedy)


def write_recording_file(path: Path | str, content: RecordingFile) -> None:
    """Write a `recording.toml`; `read_recording_file` reads the same content.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic_write(path) as temporary:
        temporary.write_text(recording_file_text(content), encoding="utf-8")


def recording_file_text(content: RecordingFile) -> str:
    """Text of a `recording.toml`."""
    tables: dict[tuple[str, ...], dict[str, Any]] = {(): _values(content)}
    tables |= {("cameras", name): _values(camera) for name, camera in content.cameras.items()}
    for name in ("world", "reference", "markers"):
        table = getattr(content, name)
        if table is not None and (values := _values(table)):
            tables[(name,)] = values
    if content.reference is not None and content.reference.bodies:
        tables["reference", "bodies"] = dict(content.reference.bodies)
    return toml_text(tables)


def _values(table: _Table) -> dict[str, Any]:
    """The keys whose values are not the defaults; tables are left out."""
    fields = {field.name: field.default for field in msgspec.structs.fields(type(table))}
    values = {name: getattr(table, name) for name in fields}
    return {
        name: value
        for name, value in values.items()
        if value is not None and value != fields[name] and not isinstance(value, Mapping | _Table)
    }
