"""Drafts of `recording.toml`: the files of a folder, matched to cameras by their names, with nothing guessed.

A file belongs to a camera by the rules of `psotrack.geometry.camera_names`. Where two files or two cameras fit equally
well, or a video fits no camera, the user is asked to say so.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from psotrack.errors import InputError, SettingsError
from psotrack.geometry import camera_key, cameras_of, chosen_camera
from psotrack.geometry.rig_files import read_cameras
from psotrack.recordings import (
    RECORDING_FILE,
    CameraTable,
    MarkersTable,
    Recording,
    RecordingFile,
    ReferenceTable,
)
from psotrack.recordings.datasets._folder_content import OF_CAMERA, Found, Kind, kind_of, look_into, videos_in
from psotrack.recordings.datasets.recording_files import recording_of

_WORDS: Mapping[Kind, str] = {
    "video": "video",
    "ignore": "image of what is ignored",
    "detections": "file of detections",
    "timestamps": "file of frame times",
}


@dataclass(frozen=True)
class DraftOptions:
    """What a user says about the files of a folder.

    Attributes:
        calibration: rig file; None takes the one in the folder, if there is one.
        unit: unit of lengths in the rig file, "m", "cm" or "mm", where its format leaves the unit open.
        match: file, folder of images or address of a stream by the name of its camera.
        leave_out: names of files of the folder that are not used.
        fps: frames per second of cameras without a video and without frame times.
        size_wh: width and height of cameras without video whose size the calibration does not state, pixels.
        bodies: labels of the markers of each drone in the C3D file; empty: by the labels.
    """

    calibration: Path | None = None
    unit: Literal["m", "cm", "mm"] | None = None
    match: Sequence[tuple[str, str]] = ()
    leave_out: Sequence[str] = ()
    fps: float | None = None
    size_wh: tuple[int, int] | None = None
    bodies: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class Draft:
    """A draft of a `recording.toml`.

    Attributes:
        content: content of the file.
        recording: the recording that it describes.
        without_files: calibrated cameras of which the folder has no file.
        unused: files that belong to no camera.
    """

    content: RecordingFile
    recording: Recording
    without_files: tuple[str, ...]
    unused: tuple[Path, ...]


@dataclass
class _Matching:
    """Files by camera and kind, while they are matched."""

    folder: Path
    cameras: list[str]
    files: dict[str, dict[Kind, Path | str]] = field(default_factory=dict)
    unused: list[Path] = field(default_factory=list)

    def put(self, camera: str, kind: Kind, file: Path | str) -> None:
        """Give a file to a camera."""
        of_camera = self.files.setdefault(camera, {})
        if kind in of_camera:
            expected, found = f"one {_WORDS[kind]} of camera {camera}", f"{_short(of_camera[kind])} as well"
            raise _unclear(self.folder, file, expected, found)
        of_camera[kind] = file


def draft_recording(folder: Path | str, out: Path | str, options: DraftOptions | None = None) -> Draft:
    """Draft the `recording.toml` of the files in a folder.

    Args:
        folder: folder of the files.
        out: path at which the draft will be written; paths in it are relative to its folder.
        options: what the user says about the files.

    Raises:
        InputError: it is not clear which file belongs to which camera, a file cannot be used, or there is no file of
            any camera. The message says what to do.
        SettingsError: an option names a file or camera that does not exist.
    """
    folder, out, options = Path(folder), Path(out), options or DraftOptions()
    _check_by_hand(folder, options)
    by_hand = [*options.leave_out, *(file for _, file in options.match)]
    found = _without(folder, look_into(folder), [*by_hand, os.path.relpath(out, folder), RECORDING_FILE])
    calibration = options.calibration or _calibration_of(folder, found)
    known = _known_cameras(calibration, options.unit)
    matching = _Matching(folder, list(known) or _names_of_files(folder, found, options))
    for name, file in options.match:
        _put_by_hand(matching, name, file, calibration)
    _match(matching, found, calibration)
    tables = {
        name: _table(matching, name, known.get(name), out.parent, options)
        for name in matching.cameras
        if name in matching.files
    }
    if not tables:
        raise _nothing(folder, matching, calibration)
    references = [_written(each.path, out.parent) for each in found if each.kind == "reference"]
    if options.bodies and not references:
        raise SettingsError("--body", expected=f"a C3D file in {folder}", found="none")
    corners = [each.path for each in found if each.kind == "corners"]
    if len(corners) > 1:
        raise _unclear(folder, corners[1], "one table of marker corners", f"{corners[0].name} as well")
    content = RecordingFile(
        version=1,
        calibration=None if calibration is None else _written(calibration, out.parent),
        calibration_unit=options.unit,
        cameras=tables,
        reference=ReferenceTable(files=tuple(references), bodies=options.bodies) if references else None,
        markers=MarkersTable(corners=_written(corners[0], out.parent)) if corners else None,
    )
    # Paths with `..` in them lead through the folder of the draft.
    out.parent.mkdir(parents=True, exist_ok=True)
    return Draft(
        content,
        recording_of(out, content),
        tuple(name for name in matching.cameras if name not in tables),
        tuple(matching.unused),
    )


def _check_by_hand(folder: Path, options: DraftOptions) -> None:
    """Raise `SettingsError` for a file that is left out but does not exist, and for a file that is matched twice."""
    for name in options.leave_out:
        if not (folder / name).exists():
            raise SettingsError("--leave-out", expected=f"a file in {folder}", found=name)
    files = [file for _, file in options.match]
    for file in files:
        if files.count(file) > 1:
            raise SettingsError(
                "--match", expected="each file once", found=f"{file} {files.count(file)} times"
            )


def _without(folder: Path, found: list[Found], names: Sequence[str]) -> list[Found]:
    """The files but those that the user names: what is left out, and what is matched by hand."""
    named = {os.path.abspath(folder / name) for name in names if "://" not in name}
    return [each for each in found if os.path.abspath(each.path) not in named]


def _calibration_of(folder: Path, found: Sequence[Found]) -> Path | None:
    """The rig file of a folder, or None."""
    paths = [each.path for each in found if each.kind == "calibration"]
    if len(paths) > 1:
        raise InputError(
            folder,
            expected="one rig file",
            found=", ".join(path.name for path in paths),
            remedy="name the one to use with --calibration FILE",
        )
    return paths[0] if paths else None


def _known_cameras(calibration: Path | None, unit: str | None) -> dict[str, tuple[int, int] | None]:
    """Sizes of the cameras of a rig file by name, None where it states none."""
    if calibration is None:
        if unit is not None:
            raise SettingsError(
                "--units", expected="a rig file, in the folder or by --calibration", found="none"
            )
        return {}
    return {name: fields.size_wh for name, fields in read_cameras(calibration).items()}


def _names_of_files(folder: Path, found: Sequence[Found], options: DraftOptions) -> list[str]:
    """Names of cameras without a calibration: those that the user gives, and those of videos, images or detections."""
    given = list(dict.fromkeys(name for name, _ in options.match))
    videos, detections = ([each for each in found if each.kind == kind] for kind in ("video", "detections"))
    keys = {camera_key(name): name for name in given}
    names = []
    for file in videos or detections:
        name = _name_of(file)
        if camera_key(name) in keys and keys[camera_key(name)] not in given:
            raise _unclear(
                folder, file.path, "files of different cameras", f"{keys[camera_key(name)]} as well"
            )
        keys.setdefault(camera_key(name), name)
        names.append(keys[camera_key(name)])
    return list(dict.fromkeys([*given, *names]))


def _name_of(file: Found) -> str:
    """Name of a camera from the name of its file, or of the folder in which its video is alone."""
    stem = file.alone_in or file.name
    return "".join("_" if mark in ",=/\\" else mark for mark in stem)


def _put_by_hand(matching: _Matching, name: str, file: str, calibration: Path | None) -> None:
    """Give a file to the camera that the user names."""
    camera = chosen_camera(name, tuple(matching.cameras))
    if camera is None:
        expected = f"a camera of {calibration}: {', '.join(matching.cameras)}"
        raise SettingsError("--match", expected=expected, found=name)
    if "://" in file:
        matching.put(camera, "video", file)
        return
    path = matching.folder / file
    if not path.exists():
        raise SettingsError("--match", expected=f"a file in {matching.folder}", found=file)
    kind = kind_of(path)
    if kind not in OF_CAMERA:
        expected = f"a {', a '.join(_WORDS[each] for each in OF_CAMERA)}"
        raise SettingsError("--match", expected=expected, found=file)
    try:
        matching.put(camera, kind, path)
    except InputError:
        expected = f"one {_WORDS[kind]} of camera {camera}"
        raise SettingsError("--match", expected=expected, found="two") from None


def _match(matching: _Matching, found: Sequence[Found], calibration: Path | None) -> None:
    """Give each file of a camera to the camera that its name says."""
    for kind in OF_CAMERA:
        given = [name for name in matching.cameras if kind in matching.files.get(name, {})]
        for each in found:
            if each.kind != kind:
                continue
            fitting = cameras_of(each.name, matching.cameras)
            if len(fitting) > 1:
                raise _unclear(
                    matching.folder,
                    each.path,
                    "the name of one camera",
                    f"{' and '.join(fitting)} in its name",
                )
            if fitting and fitting[0] not in given:
                matching.put(fitting[0], kind, each.path)
            elif kind == "video" and (fitting or (each.path.is_file() and not each.alone_in)):
                raise _video_of_no_camera(matching, each.path, calibration, fitting)
            else:
                matching.unused.append(each.path)
    for each in found:
        if each.kind == "other":
            _check_folder_of_camera(matching, each)
            matching.unused.append(each.path)


def _check_folder_of_camera(matching: _Matching, found: Found) -> None:
    """Raise `InputError` for a folder with the name of a camera without files that holds several videos."""
    fitting = [name for name in cameras_of(found.name, matching.cameras) if name not in matching.files]
    videos = videos_in(found.path)
    if len(fitting) == 1 and videos:
        raise InputError(
            found.path,
            expected=f"one video of camera {fitting[0]}",
            found=", ".join(video.name for video in videos),
            remedy=f"say which with --match {shlex.quote(f'{fitting[0]}={found.path.name}/{videos[0].name}')}",
        )


def _table(
    matching: _Matching, name: str, size_wh: tuple[int, int] | None, base: Path, options: DraftOptions
) -> CameraTable:
    """Table of one camera."""
    files = matching.files[name]
    fps = size = None
    video = files.get("video")
    pictures = isinstance(video, Path) and video.is_dir()
    if (video is None or pictures) and "timestamps" not in files:
        fps = options.fps
        if fps is None:
            expected = f"frames per second of camera {name}, which has no video"
            raise InputError(matching.folder, expected=expected, found="none", remedy="pass --fps")
    if not isinstance(video, Path):
        size = size_wh or options.size_wh
        if size is None:
            expected = f"width and height of the images of camera {name}, which has no video"
            raise InputError(matching.folder, expected=expected, found="none", remedy="pass --size")
    written: dict[str, Any] = {kind: _written(file, base) for kind, file in files.items()}
    return CameraTable(size=size, fps=fps, **written)


def _written(file: Path | str, base: Path) -> str:
    """A path as it is written: relative to the folder of the draft, with slashes."""
    if isinstance(file, str):
        return file
    try:
        return Path(os.path.relpath(file, base)).as_posix()
    except ValueError:  # another drive
        return file.absolute().as_posix()


def _video_of_no_camera(
    matching: _Matching, path: Path, calibration: Path | None, fitting: Sequence[str]
) -> InputError:
    if fitting:
        video = _short(matching.files[fitting[0]]["video"])
        return _unclear(matching.folder, path, f"one video of camera {fitting[0]}", f"{video} as well")
    where = "" if calibration is None else f" of {calibration.name}"
    expected = f"the video of a camera{where}, {', '.join(matching.cameras)}"
    return _unclear(matching.folder, path, expected, "none of these names in its name")


def _unclear(folder: Path, file: Path | str, expected: str, found: str) -> InputError:
    name = shlex.quote(file if isinstance(file, str) else os.path.relpath(file, folder))
    remedy = f"say whose it is with --match CAMERA={name}, or leave it out with --leave-out {name}"
    where = file if isinstance(file, Path) else folder
    return InputError(where, expected=expected, found=found, remedy=remedy)


def _short(file: Path | str) -> str:
    return file if isinstance(file, str) else file.name


def _nothing(folder: Path, matching: _Matching, calibration: Path | None) -> InputError:
    below = next((path for path in sorted(folder.iterdir()) if videos_in(path)), None)
    if below is not None:
        given = "" if calibration is None else f" --calibration {shlex.quote(str(calibration))}"
        remedy = f"for the videos in {below.name}: psotrack init {shlex.quote(str(below))}{given}"
    else:
        remedy = "say which file is whose with --match CAMERA=FILE" if calibration else ""
    expected = "videos, folders of images, or detections"
    if calibration is not None:
        names = ", ".join(matching.cameras)
        expected = f"files named like the cameras of {calibration.name}, {names}"
    return InputError(folder, expected=expected, found="none", remedy=remedy)
