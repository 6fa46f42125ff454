"""Recordings that a `recording.toml` describes: the files that it names are opened and checked against each other."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgspec

from psotrack.errors import InputError
from psotrack.geometry import Camera, chosen_camera
from psotrack.geometry.rig_files import (
    KEYS,
    UNITS_M,
    Entry,
    camera_values,
    entries_of,
    fields_of_table,
    read_cameras,
    rescale_lenses,
)
from psotrack.recordings import (
    MOST_INSTANTS,
    RECORDING_FILE,
    CameraRecording,
    CameraTable,
    FrameTimes,
    Recording,
    RecordingFile,
    StoredSilhouettes,
    VideoInfo,
    check_rate,
    file_error,
    find_images,
    frame_times,
    open_pictures,
    probe,
    probe_images,
    probe_silhouettes,
    read_detections,
    read_mask,
    read_recording_file,
    read_timestamps,
    warn_of_missing_numbers,
)
from psotrack.recordings.datasets._poses import read_reference

_logger = logging.getLogger(__name__)
#: Rate of pictures until their timestamps are read.
_UNKNOWN_HZ = 1.0
#: Largest deviation of a rate from a thousandth of another one at which the unit of time was mistaken, not the rate.
_SLIP_SHARE = 0.05
#: How addresses of streams begin that OpenCV reads, with FFmpeg or with GStreamer.
_SCHEMES = ("rtsp", "rtsps", "http", "https", "rtmp", "rtp", "udp", "tcp", "srt", "gstreamer")


def read_recording_toml(path: Path | str, bodies: Mapping[str, Sequence[str]] | None = None) -> Recording:
    """Read a recording from its `recording.toml`.

    Args:
        path: path of the file.
        bodies: labels of the markers of each drone in the C3D file of the reference, instead of those of the file.

    Raises:
        InputError: the file is wrong, or one of the files that it names cannot be used; the message names it.
    """
    path, content = Path(path), read_recording_file(path)
    if bodies:
        if content.reference is None:
            raise file_error(path, "reference", "a C3D file, because markers of drones are named", "none")
        named = {name: tuple(labels) for name, labels in bodies.items()}
        reference = msgspec.structs.replace(content.reference, bodies=named)
        content = msgspec.structs.replace(content, reference=reference)
    return recording_of(path, content)


def recording_of(path: Path, content: RecordingFile) -> Recording:
    """The recording that the content of a `recording.toml` describes.

    Args:
        path: path of the file, which need not exist; other paths are relative to its folder.
        content: content of the file.

    Raises:
        InputError: one of the files that the content names cannot be used; the message names it.
    """
    folder = path.parent
    named = [_Named(path, name, table) for name, table in content.cameras.items()]
    opened = [table.open() for table in named]
    _check_videos(path, opened)
    sizes_wh = {table.name: table.size_wh(each.video) for table, each in zip(named, opened, strict=True)}
    calibrated = _calibrated(path, content, sizes_wh)
    corners = None if content.markers is None else content.markers.corners
    recording = Recording(
        name=path.resolve().parent.name if path.name == RECORDING_FILE else path.stem,
        folder=folder,
        cameras=tuple(
            replace(each, camera=_camera(table, each, sizes_wh[table.name], calibrated.get(table.name)))
            for table, each in zip(named, opened, strict=True)
        ),
        bounds_m=_bounds(content),
        marker_corners=None if corners is None else _existing(folder, corners, path, "markers.corners"),
    )
    if content.reference is None:
        return recording
    files = [_existing(folder, file, path, "reference.files") for file in content.reference.files]
    reference = read_reference(
        files, recording.timeline(), content.reference.bodies, content.reference.time_offset_s
    )
    return replace(recording, reference=reference)


@dataclass(frozen=True)
class _Named:
    """A table `[cameras.NAME]` and where it stands.

    Attributes:
        path: path of the file.
        name: name of the camera.
        table: the table.
    """

    path: Path
    name: str
    table: CameraTable

    def error(self, key: str, expected: str, found: str, remedy: str = "") -> InputError:
        """Error whose message names the key."""
        return file_error(self.path, f"cameras.{self.name}.{key}", expected, found, remedy)

    def file(self, key: str) -> Path | None:
        """The file that a key names, which must exist; None where the key is not there."""
        written = getattr(self.table, key)
        place = f"cameras.{self.name}.{key}"
        return None if written is None else _existing(self.path.parent, str(written), self.path, place)

    def size_wh(self, video: VideoInfo | None) -> tuple[int, int] | None:
        """Width and height of the images, pixels; None where only the calibration may know it."""
        return self.table.size if video is None else video.image_size_wh

    def open(self) -> CameraRecording:
        """Open the files of the camera, whose lens and place are not looked for."""
        table = self.table
        stream = self._stream()
        video = self._video() if stream is None else None
        size_wh = self.size_wh(video)
        if table.size not in (None, size_wh):
            raise self.error("size", f"{_size_text(size_wh)} as in the video", _size_text(table.size))
        detections, stored = self.file("detections"), self.file("silhouettes")
        silhouettes = None if stored is None else probe_silhouettes(stored)
        times = self._times(video, silhouettes, detections) if stream is None else None
        if video is not None and times is not None and not video.is_finished:
            # The program that wrote video and times was stopped: the one that is longer is cut.
            video = replace(video, num_frames=min(video.num_frames, times.num_frames))
            _logger.warning(
                "%s: the video was not finished; its first %d frames are used", video.path, video.num_frames
            )
        ignore = self.file("ignore")
        if ignore is not None:
            height, width = read_mask(ignore).shape
            if size_wh not in (None, (width, height)):
                expected = f"{_size_text(size_wh)} as camera {self.name}"
                raise InputError(ignore, expected=expected, found=_size_text((width, height)))
        if size_wh is not None and times is not None:
            # The rows of an image cannot take longer than the time from frame to frame.
            longest_s = 1 / (times.fps * size_wh[1])
            if abs(table.line_time_s) > longest_s:
                expected = f"at most {longest_s:.2g} s, a frame's time for {size_wh[1]} rows"
                raise self.error("line_time_s", expected, f"{table.line_time_s:g}")
        return CameraRecording(
            self.name, None, video, stream, times, table.line_time_s, detections, silhouettes, ignore
        )

    def _stream(self) -> str | None:
        """Address of a stream, or "device" and number or path of a device; None for a file."""
        video = self.table.video
        if isinstance(video, int):
            if video < 0:
                raise self.error("video", "the number of a device, from 0", f"{video}")
            return f"device {video}"
        if video is None:
            return None
        if video.startswith("/dev/"):
            return f"device {video}"
        scheme, separator, rest = video.partition("://")
        if not separator:
            return None
        if scheme not in _SCHEMES:
            schemes = "://, ".join(_SCHEMES)
            expected = f"a file, the number of a device, or an address that begins with {schemes}://"
            raise self.error("video", expected, f"{scheme}://")
        try:
            parts = urlsplit(video)
            is_whole = bool(parts.hostname or rest.startswith("@")) and parts.port != 0
        except ValueError:
            is_whole = False
        if not (bool(rest) if scheme == "gstreamer" else is_whole):
            raise self.error("video", "an address with a host, and a port below 65536 if any", video)
        return video

    def _video(self) -> VideoInfo | None:
        table, folder = self.table, self.path.parent
        if table.images is not None:
            where = f"{self.path}, cameras.{self.name}.images"
            images = find_images(folder, table.images, where)
            if table.timestamps is None:
                warn_of_missing_numbers(images[0].parent, images)
            return probe_images(images, self._rate(len(images)))
        file = self.file("video")
        if file is None:
            return None
        if file.suffix.lower() == ".zip":
            raise self.error("video", "a video", f"an archive, {table.video}", "unpack it first")
        if file.is_dir():
            if table.fps is None and table.timestamps is None:
                raise self.error("fps", "frames per second of the pictures, or timestamps", "none")
            video = open_pictures(file, table.fps or _UNKNOWN_HZ)
            return replace(video, fps=self._rate(video.num_frames))
        video = probe(file)
        if table.fps is not None:
            return video.at_rate(table.fps)
        if table.timestamps is None:
            check_rate(file, video.fps, f"write the rate as fps below [cameras.{self.name}]")
        return video

    def _rate(self, num_frames: int) -> float:
        """Frames per second of pictures, which do not state it."""
        if self.table.timestamps is not None:
            return read_timestamps(self.path.parent / self.table.timestamps, num_frames).fps
        assert self.table.fps is not None, "the schema asks for fps or timestamps of images"
        return self.table.fps

    def _times(
        self, video: VideoInfo | None, silhouettes: StoredSilhouettes | None, detections: Path | None
    ) -> FrameTimes:
        """Times of the frames of a camera; without video it lasts as long as its silhouettes, or as `frames` says, or
        until its last detection.
        """
        table, listed = self.table, self.file("timestamps")
        if listed is not None:
            return _listed_times(listed, video, silhouettes)
        offset_s, where = table.time_offset_s or 0.0, f"{self.path}, cameras.{self.name}.frames"
        if video is not None:
            return frame_times(video, offset_s)
        num_frames = 0
        if silhouettes is not None:
            num_frames = silhouettes.num_frames
        elif table.frames is not None:
            num_frames = table.frames
        elif detections is not None:
            num_frames, where = int(read_detections(detections).frame.max(initial=-1)) + 1, f"{detections}"
        assert table.fps is not None, "the schema asks for fps of a camera without video"
        if num_frames > MOST_INSTANTS:
            raise InputError(where, expected=f"at most {MOST_INSTANTS} frames", found=f"{num_frames}")
        return FrameTimes(num_frames, table.fps, offset_s)


def _listed_times(file: Path, video: VideoInfo | None, silhouettes: StoredSilhouettes | None) -> FrameTimes:
    """Times of a file, checked against the video or the silhouettes."""
    times = read_timestamps(file, video.num_frames if video is not None and video.is_finished else None)
    if video is not None and not video.images:
        _check_seconds(file, times, video)
    if video is None and silhouettes is not None:
        if times.num_frames < silhouettes.num_frames:
            expected = f"times of the {silhouettes.num_frames} frames of the silhouettes"
            raise InputError(file, expected=expected, found=f"{times.num_frames}")
        return times.cut(silhouettes.num_frames)
    return times


def _check_videos(path: Path, cameras: Sequence[CameraRecording]) -> None:
    """Raise `InputError` for a video of two cameras, and warn of a camera that films alone."""
    owners: dict[Path, str] = {}
    for each in cameras:
        if each.video is None:
            continue
        file = (each.video.images[0] if each.video.images else each.video.path).resolve()
        if file in owners:
            found = f"that of {owners[file]}, {file.name}"
            raise file_error(path, f"cameras.{each.name}", "a video of its own", found)
        owners[file] = each.name
    spans = {
        each.name: each.times.time_s[[0, -1]] for each in cameras if each.times and each.times.num_frames
    }
    for name, (begin_s, end_s) in spans.items():
        others = [span for other, span in spans.items() if other != name]
        if others and not any(begin_s <= last_s and first_s <= end_s for first_s, last_s in others):
            _logger.warning(
                "%s, cameras.%s: no other camera films while it does, from %.3f to %.3f s; see time_offset_s and "
                "timestamps",
                path, name, begin_s, end_s,
            )  # fmt: skip


def _check_seconds(file: Path, times: FrameTimes, video: VideoInfo) -> None:
    """Raise `InputError` for times in milliseconds: a thousandth of the video's own rate is no coincidence."""
    if abs(video.fps / times.fps / 1000 - 1) < _SLIP_SHARE:
        raise InputError(
            file,
            expected=f"times in seconds, of about {video.fps:g} frames per second as in {video.path.name}",
            found=f"{times.fps:g} frames per second",
            remedy="divide the times by 1000 if they are milliseconds",
        )


def _calibrated(
    path: Path, content: RecordingFile, sizes_wh: Mapping[str, tuple[int, int] | None]
) -> dict[str, Entry]:
    """The cameras of the rig file whose image size is known, by their names in the recording."""
    if content.calibration is None:
        return {}
    stated = read_cameras(_existing(path.parent, content.calibration, path, "calibration"))
    known = {name: chosen_camera(name, tuple(stated)) for name in content.cameras}
    _check_names(path, content, known, tuple(stated))
    sizes = {own: sizes_wh[name] or stated[own].size_wh for name, own in known.items() if own}
    entries = entries_of(
        {own: stated[own] for own, size_wh in sizes.items() if size_wh},
        {own: size_wh for own, size_wh in sizes.items() if size_wh},
        metres_per_unit=UNITS_M[content.calibration_unit] if content.calibration_unit else None,
    )
    rescaled = rescale_lenses(
        path.parent / content.calibration,
        {name: each for name, own in known.items() if own in entries and (each := entries[own].camera)},
        sizes_wh,
    )
    return {
        name: replace(entries[own], camera=rescaled.get(name))
        for name, own in known.items()
        if own in entries
    }


def _check_names(
    path: Path, content: RecordingFile, known: Mapping[str, str | None], stated: Sequence[str]
) -> None:
    """Check whose the cameras of the rig file are: two cameras are not one of them, and not all are unknown.

    Raises:
        InputError: the names do not fit; a camera without a place is only a warning.
    """
    taken: dict[str, str] = {}
    for name, entry in known.items():
        if entry is not None and entry in taken:
            expected = "cameras with names as in the calibration"
            raise file_error(path, f"cameras.{name}", expected, f"{entry} for {taken[entry]} as well")
        if entry is not None:
            taken[entry] = name
    alone = [name for name, entry in known.items() if entry is None and content.cameras[name].K is None]
    unused = [entry for entry in stated if entry not in taken]
    rig_file = Path(content.calibration or "").name
    remedy = "`psotrack init --force --match CAMERA=FILE` maps them"
    if alone and not taken:
        expected = f"a camera of the recording, {', '.join(known)}, in {rig_file}"
        raise file_error(path, "calibration", expected, f"only {', '.join(stated)}", remedy)
    if alone and unused:
        _logger.warning(
            "%s: no place of camera %s in %s, whose %s is of no camera of the recording; %s",
            path, ", ".join(alone), rig_file, ", ".join(unused), remedy,
        )  # fmt: skip


def _camera(
    named: _Named, opened: CameraRecording, own_wh: tuple[int, int] | None, calibrated: Entry | None
) -> Camera | None:
    """A camera from its own keys and, where it has none, from the rig file; None where its place is not known."""
    known: dict[str, Any] = {}
    if calibrated is not None and calibrated.camera is not None:
        known = camera_values(calibrated.camera, placed=calibrated.placed)
    # A size of the rig file that differs from the video's is an error of `Recording.usable`.
    size_wh = known.get("size") or own_wh
    if opened.video is None and own_wh not in (None, size_wh and tuple(size_wh)):
        raise named.error(
            "size", f"{_size_text(size_wh)} as calibrated, or of this shape", _size_text(own_wh)
        )
    if size_wh is None and opened.stream is None:
        raise named.error("size", "width and height of the images, because the camera has no video", "none")
    own = msgspec.json.decode(msgspec.json.encode(named.table))
    keys = known | {key: own[key] for key in KEYS if own.get(key) is not None}
    if own.get("R") is not None:
        keys.pop("rvec", None)
    if size_wh is None or not keys.keys() - {"size"}:
        return None
    entry = fields_of_table(named.path, named.name, {**keys, "size": list(size_wh)}).entry(None, 1.0)
    return entry.camera if entry.placed else None


def _bounds(content: RecordingFile) -> tuple[float, float, float, float, float, float] | None:
    if content.world.bounds_m is None:
        return None
    (x0, y0, z0), (x1, y1, z1) = content.world.bounds_m
    return x0, x1, y0, y1, z0, z1


def _existing(folder: Path, written: str, path: Path, place: str) -> Path:
    """Path of a file that a key names, relative to the folder of the recording."""
    file = folder / written
    if not file.exists():
        raise file_error(path, place, "a file that exists", f"none at {file}")
    return file


def _size_text(size_wh: tuple[int, int] | None) -> str:
    return "no size" if size_wh is None else f"{size_wh[0]} x {size_wh[1]} pixels"
