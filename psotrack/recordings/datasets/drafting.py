"""Drafts of `recording.toml`: the files of a folder, matched to cameras by their names, with nothing guessed.

A file belongs to a camera by the rules of `psotrack.geometry.camera_names`. Where two files or two cameras fit equally
well, or a video fits no camera, an error asks the user to say so by an option.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Collection, Mapping, Sequence
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
    recording_file_text,
    write_recording_file,
)
from psotrack.recordings.datasets._folders import OF_CAMERA, Found, Kind, kind_of, look_into, videos_in
from psotrack.recordings.datasets.recording_files import recording_of
from psotrack.support import atomic_write

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
        size_wh: width and height of cameras without video, pixels, where the calibration states none or another one.
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
    """A draft of a `recording.toml`; as text, what a user needs to know of it.

    Attributes:
        path: where the file will be.
        content: content of the file.
        recording: the recording that it describes.
        without_files: calibrated cameras of which the folder has no file.
        unused: files that belong to no camera.
    """

    path: Path
    content: RecordingFile
    recording: Recording
    without_files: tuple[str, ...]
    unused: tuple[Path, ...]

    def write(self) -> Path | None:
        """Write the file. Returns the place of the one that was there, which may have been edited; None without one.

        Raises:
            OutputError: a file cannot be written.
        """
        older = None
        if self.path.is_file() and self.path.read_bytes() != recording_file_text(self.content).encode():
            older = self.path.with_name(f"{self.path.name}.bak")
            with atomic_write(older) as temporary:
                temporary.write_bytes(self.path.read_bytes())
        write_recording_file(self.path, self.content)
        return older

    def to_dict(self) -> dict[str, Any]:
        """The draft, fit for JSON."""
        return {
            "recording": str(self.path),
            "calibration": self.content.calibration,
            **self.recording.to_dict(),
            "without_files": list(self.without_files),
            "unused": [str(file) for file in self.unused],
        }

    def __str__(self) -> str:
        lines = []
        if self.without_files:
            lines.append(f"cameras without any file, left out: {', '.join(self.without_files)}")
        if self.unused:
            lines.append(f"files that are not used: {', '.join(file.name for file in self.unused)}")
        unplaced = [each.name for each in self.recording.cameras if each.camera is None]
        if unplaced:
            lines.append(
                f"cameras without place: {', '.join(unplaced)}; `psotrack calibrate rig` makes the rig "
                f"file, then `psotrack init {self.path.parent} --calibration rig.toml --force`"
            )
        count = len(self.content.cameras)
        return "\n".join([*lines, f"{self.path}: {count} camera{'s' if count > 1 else ''}"])


@dataclass
class Matching:
    """The files of a folder, by camera and kind.

    Attributes:
        folder: folder of the files.
        found: files that the user does not name.
        calibration: rig file that has the cameras; None where files give the names, and more may be named.
        known: sizes of the cameras of the rig file by name, pixels; None where it states none.
        cameras: names of the cameras.
        files: the files of each camera by their kinds.
        unused: files that belong to no camera.
        unclear: files of which a user must say whose they are; what was expected, and what their names say.
        rivals: files that fit as well as the unclear ones, likewise.
    """

    folder: Path
    found: list[Found]
    calibration: Path | None
    known: dict[str, tuple[int, int] | None]
    cameras: list[str]
    files: dict[str, dict[Kind, Path | str]] = field(default_factory=dict)
    unused: list[Path] = field(default_factory=list)
    unclear: dict[Path, tuple[str, str]] = field(default_factory=dict)
    rivals: dict[Path, tuple[str, str]] = field(default_factory=dict)

    def taken(self, camera: str, kind: Kind) -> Path | str | None:
        """The file of this kind that a camera has already."""
        return self.files.get(camera, {}).get(kind)

    def put(self, camera: str, kind: Kind, file: Path | str) -> None:
        """Give a file to a camera."""
        self.files.setdefault(camera, {})[kind] = file

    def nameless(self, kind: Kind) -> tuple[str, str]:
        """What was expected of a file with the name of no camera, and what its name says."""
        of_rig = "" if self.calibration is None else f" of {self.calibration.name}"
        expected = f"the {_WORDS[kind]} of a camera{of_rig}, {', '.join(self.cameras)}"
        return expected, "none of these names in its name"

    def questions(self) -> dict[Path, tuple[str, str]]:
        """Files of which a user may say whose they are: unclear ones, and unused ones that some camera lacks."""
        lacking = {kind for kind in OF_CAMERA for name in self.cameras if self.taken(name, kind) is None}
        unused = {file: self.nameless(kind) for file in self.unused if (kind := kind_of(file)) in lacking}
        return self.unclear | self.rivals | unused

    def error(self) -> InputError:
        """Error about the first of the unclear files; its remedy names all of them."""
        files = self.unclear or self.questions()
        first, *others = (shlex.quote(os.path.relpath(file, self.folder)) for file in files)
        path, (expected, found) = next(iter(files.items()))
        remedy = f"say whose it is with --match CAMERA={first}, or leave it out with --leave-out {first}"
        if others:
            remedy += f"; the same for {', '.join(others)}"
        return InputError(path, expected=expected, found=found, remedy=remedy)


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
    matching = match_files(folder, out, options)
    found, calibration = matching.found, matching.calibration
    corners = [each.path for each in found if each.kind == "corners"]
    if len(corners) > 1:
        matching.unclear[corners[1]] = "one table of marker corners", f"{corners[0].name} as well"
    if matching.unclear:
        raise matching.error()
    tables = {
        name: _table(matching, name, out.parent, options)
        for name in matching.cameras
        if name in matching.files
    }
    if not tables:
        raise _nothing(matching)
    references = [_written(each.path, out.parent) for each in found if each.kind == "reference"]
    if options.bodies and not references:
        raise SettingsError("--body", expected=f"a C3D file in {folder}", found="none")
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
    without_files = tuple(name for name in matching.cameras if name not in tables)
    return Draft(out, content, recording_of(out, content), without_files, tuple(matching.unused))


def match_files(folder: Path, out: Path, options: DraftOptions) -> Matching:
    """Match the files of a folder to cameras, as far as the user and their names say.

    Args:
        folder: folder of the files.
        out: path at which the draft will be written.
        options: what the user says about the files.

    Raises:
        InputError: the folder, or the rig file in it, cannot be read.
        SettingsError: an option names a file or camera that does not exist.
    """
    _check_by_hand(folder, options)
    by_hand = [*options.leave_out, *(file for _, file in options.match)]
    found = _without(folder, look_into(folder), [*by_hand, os.path.relpath(out, folder), RECORDING_FILE])
    calibration = options.calibration or _calibration_of(folder, found)
    known = _known_cameras(calibration, options.unit)
    matching = Matching(folder, found, calibration, known, list(known) or _names_of_files(found, options))
    for name, file in options.match:
        _put_by_hand(matching, name, file)
    _match(matching, {folder / name for name in options.leave_out})
    return matching


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


def _names_of_files(found: Sequence[Found], options: DraftOptions) -> list[str]:
    """Names of cameras without a calibration: those that the user gives, and those of videos, images or detections."""
    given = list(dict.fromkeys(name for name, _ in options.match))
    videos, detections = ([each for each in found if each.kind == kind] for kind in ("video", "detections"))
    names: dict[str, str] = {}
    for name in [*given, *map(_name_of, videos or detections)]:
        names.setdefault(camera_key(name), name)
    return list(names.values())


def _name_of(file: Found) -> str:
    """Name of a camera from the name of its file, or of the folder in which its video is alone."""
    stem = file.alone_in or file.name
    return "".join("_" if mark in ",=/\\" else mark for mark in stem)


def _put_by_hand(matching: Matching, name: str, file: str) -> None:
    """Give a file to the camera that the user names."""
    camera = chosen_camera(name, tuple(matching.cameras))
    path = matching.folder / file
    kind = "video" if "://" in file else kind_of(path) if path.exists() else None
    if camera is None:
        expected, found = f"a camera of {matching.calibration}: {', '.join(matching.cameras)}", name
    elif kind is None:
        expected, found = f"a file in {matching.folder}", file
    elif kind not in OF_CAMERA:
        expected, found = f"a {', a '.join(_WORDS[each] for each in OF_CAMERA)}", file
    elif matching.taken(camera, kind) is not None:
        expected, found = f"one {_WORDS[kind]} of camera {camera}", "two"
    else:
        matching.put(camera, kind, file if "://" in file else path)
        return
    raise SettingsError("--match", expected=expected, found=found)


def _match(matching: Matching, left_out: Collection[Path]) -> None:
    """Give each file of a camera to the camera that its name says."""
    by_hand = {file for files in matching.files.values() for file in files.values()}
    for each in matching.found:
        if each.kind in OF_CAMERA and not _match_by_name(matching, each, by_hand):
            if each.is_video_file and not each.alone_in:
                matching.unclear[each.path] = matching.nameless("video")
            else:
                matching.unused.append(each.path)
    for each in matching.found:
        if each.kind == "other":
            _look_for_videos_of_a_camera(matching, each, left_out)
            matching.unused.append(each.path)


def _match_by_name(matching: Matching, each: Found, by_hand: Collection[Path | str]) -> bool:
    """Give a file to the camera that its name says; False if it says none, or one that the user gave another file."""
    names = cameras_of(each.name, matching.cameras)
    if len(names) > 1:
        matching.unclear[each.path] = "the name of one camera", f"{' and '.join(names)} in its name"
    if len(names) != 1:
        return bool(names)
    taken = matching.taken(names[0], each.kind)
    if taken is None:
        matching.put(names[0], each.kind, each.path)
    elif taken in by_hand and not each.is_video_file:
        return False
    else:
        expected = f"one {_WORDS[each.kind]} of camera {names[0]}"
        matching.unclear[each.path] = expected, f"{getattr(taken, 'name', taken)} as well"
        if isinstance(taken, Path) and taken not in by_hand:
            matching.rivals[taken] = expected, f"{each.path.name} as well"
    return True


def _look_for_videos_of_a_camera(matching: Matching, found: Found, left_out: Collection[Path]) -> None:
    """The videos in a folder that has the name of a camera without files are unclear."""
    fitting = [name for name in cameras_of(found.name, matching.cameras) if name not in matching.files]
    videos = [video for video in videos_in(found.path) if video not in left_out]
    if len(fitting) == 1 and videos:
        names = ", ".join(video.name for video in videos)
        fault = f"one video of camera {fitting[0]}", f"{names} in {found.path.name}"
        matching.unclear[videos[0]] = fault
        matching.rivals.update(dict.fromkeys(videos[1:], fault))


def _table(matching: Matching, name: str, base: Path, options: DraftOptions) -> CameraTable:
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
        size = options.size_wh or matching.known.get(name)
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


def _nothing(matching: Matching) -> InputError:
    folder, calibration = matching.folder, matching.calibration
    below = next((path for path in sorted(folder.iterdir()) if videos_in(path)), None)
    expected, given, remedy = "videos, folders of images, or detections", "", ""
    if calibration is not None:
        expected = f"files named like the cameras of {calibration.name}, {', '.join(matching.cameras)}"
        given = f" --calibration {shlex.quote(str(calibration))}"
        remedy = "say which file is whose with --match CAMERA=FILE"
    if below is not None:
        remedy = f"for the videos in {below.name}: psotrack init {shlex.quote(str(below))}{given}"
    return InputError(folder, expected=expected, found="none", remedy=remedy)
