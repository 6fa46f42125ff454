"""Packing tracks with everything from which they can be computed again."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec

from psotrack.errors import InputError
from psotrack.foreground.silhouettes import SEAL_FILE, compute, stored_silhouettes
from psotrack.geometry import Camera
from psotrack.geometry.rig_files import lens_model
from psotrack.pipeline import detection_files_of, usable_for
from psotrack.pipeline.archives.manifest import Manifest, PackedVideo
from psotrack.pipeline.archives.sealed_zip import Source, write_sealed
from psotrack.recordings import (
    ARRAY_FILE,
    MADE_OF,
    RECORDING_FILE,
    CameraTable,
    FrameTimes,
    MarkersTable,
    Recording,
    RecordingFile,
    ReferenceTable,
    StoredSilhouettes,
    VideoInfo,
    WorldTable,
    digest_video,
    recording_file_text,
)
from psotrack.recordings.datasets import reference_files
from psotrack.settings import YOLO, TrackSettings
from psotrack.support import Report, digest_file, no_progress, refuse_to_overwrite
from psotrack.trajectories import read_trajectories

#: Prefix of the input keys of detections that the method "fused" read beside silhouettes.
_DETECTIONS_OF = "detections of "


class _TrackRecord(msgspec.Struct, frozen=True):
    """What packing reads of the record of a run; a record has more."""

    sequence: str
    cameras: list[str]
    frames: int
    rate_hz: float
    settings: TrackSettings
    input_keys: dict[str, str]
    camera_times: dict[str, dict[str, Any]] = {}
    volume: dict[str, Any] = {}
    causal: bool = False
    most_drones: int | None = None


@dataclass(frozen=True)
class _Run:
    """A run of tracking, and the recording as the run used it.

    Attributes:
        tracks: file of the tracks.
        record: record of the run.
        opened: the recording as it was opened.
        used: the recording with the cameras and frames of the run.
        frames: number of instants that the run used, from the start; None for all.
    """

    tracks: Path
    record: _TrackRecord
    opened: Recording
    used: Recording
    frames: int | None

    @property
    def settings(self) -> TrackSettings:
        """Settings of the run, with the largest speed that the run found."""
        return self.record.settings


def pack_tracks(
    tracks: Path | str,
    recording: Recording,
    out: Path | str,
    *,
    cache: Path | str,
    videos: bool = False,
    force: bool = False,
    report: Report = no_progress,
) -> Manifest:
    """Pack tracks with their record, cameras, detections, silhouettes and reference into one file.

    The archive is written whole or not at all, and equal input gives equal bytes. Silhouettes are taken from the store,
    and made where they are missing.

    Args:
        tracks: file of the tracks; its record, the same name with the suffix .json, lies beside it.
        recording: the recording from which the tracks were computed, as it was opened.
        out: path of the archive.
        cache: folder of the stored silhouettes.
        videos: whether to pack the videos as well. If not, the archive has the digest of each video.
        force: replace an existing file.
        report: shows the progress.

    Returns:
        The manifest of the archive.

    Raises:
        InputError: a file cannot be read, or the tracks were computed from another recording.
        SettingsError: the silhouettes cannot be made.
        OutputError: the archive exists and `force` is not set, or it cannot be written.
    """
    tracks, out = Path(tracks), Path(out)
    refuse_to_overwrite(out, force)
    run = _run_of(tracks, recording)
    settings, used = run.settings, run.used
    silhouettes = (
        stored_silhouettes(used, settings.silhouettes, Path(cache)) if settings.needs_silhouettes else {}
    )
    detections = used.detections or {}
    if settings.reads_detections:
        detections = detection_files_of(used, settings.detections)
    _check_inputs(run, silhouettes, detections)
    if silhouettes:
        compute(used, settings.silhouettes, cache=cache, all_videos=False, report=report)
    packing = _Packing(run, silhouettes, detections, videos)
    files, content = packing.files()
    manifest = Manifest(
        psotrack=version("psotrack"),
        sequence=run.record.sequence,
        tracks=f"tracks{tracks.suffix}",
        settings=_open_settings(run, files),
        frames=run.frames,
        causal=run.record.causal,
        most_drones=run.record.most_drones,
        videos={name: packing.video(name, video) for name, video in run.used.videos.items()},
    )
    text = recording_file_text(content).encode()
    return write_sealed(out, manifest, {RECORDING_FILE: text, **files}, force=force, report=report)


def _run_of(tracks: Path, opened: Recording) -> _Run:
    """The run that a file of tracks comes from.

    Raises:
        InputError: the file or its record cannot be read, or the recording has other cameras or another length.
    """
    rows = read_trajectories(tracks)
    record = _read_record(tracks.with_suffix(".json"))
    if not record.causal and rows.num_frames != record.frames:
        raise InputError(
            tracks,
            expected=f"{record.frames} frames, as {tracks.with_suffix('.json').name} says",
            found=f"{rows.num_frames}",
        )
    missing = [name for name in record.cameras if name not in opened.rig.names]
    if missing:
        raise _other_recording(tracks, record, opened, f"no camera {missing[0]}")
    whole = usable_for(opened, record.settings, cameras=record.cameras)
    frames = _frames_used(record, whole)
    if frames == 0:
        found = f"{whole.at_rate(record.settings.rate_hz).num_frames} frames at {whole.fps:g} Hz"
        raise _other_recording(tracks, record, opened, found)
    used = whole if frames is None else whole.usable(num_frames=frames, videos=False)
    return _Run(tracks, record, opened, used, frames)


def _read_record(path: Path) -> _TrackRecord:
    try:
        return msgspec.json.decode(path.read_bytes(), type=_TrackRecord)
    except OSError as error:
        found = (error.strerror or f"{error}").lower()
        raise InputError(
            path, expected="the record of the tracks, which `track` writes", found=found
        ) from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        expected = "a record of `track` with settings of this version"
        raise InputError(path, expected=expected, found=f"{error}", remedy="track again") from error


def _frames_used(record: _TrackRecord, whole: Recording) -> int | None:
    """Number of instants that a run used of a recording; None for all, and 0 where the recording has other instants."""

    def fits(frames: int | None) -> bool:
        part = whole if frames is None else whole.usable(num_frames=frames, videos=False)
        timeline = part.at_rate(record.settings.rate_hz).timeline()
        counts = {name: each["frames"] for name, each in record.camera_times.items()}
        return (
            timeline.num_instants == record.frames
            and math.isclose(timeline.rate_hz, record.rate_hz, rel_tol=1e-9)
            and part.rig.names == tuple(record.cameras)
            and all(part.frame_times[name].num_frames == count for name, count in counts.items())
        )

    if fits(None):
        return None
    # `Recording.at_rate` rounds the number of instants, so that several numbers may give the run's number.
    ratio = 1.0 if record.settings.rate_hz is None else whole.fps / record.settings.rate_hz
    first, last = (math.floor((record.frames + off) * ratio) for off in (-1, 1))
    numbers = range(max(1, first), min(last + 1, whole.num_frames) + 1)
    return next((frames for frames in numbers if fits(frames)), 0)


def _other_recording(tracks: Path, record: _TrackRecord, opened: Recording, found: str) -> InputError:
    return InputError(
        tracks,
        expected=f"tracks of {opened.folder}",
        found=f"tracks of {record.sequence} with {len(record.cameras)} cameras and {record.frames} frames at "
        f"{record.rate_hz:g} Hz, while {opened.name} has {found}",
        remedy="name the recording that was tracked",
    )


def _check_inputs(
    run: _Run, silhouettes: Mapping[str, StoredSilhouettes], detections: Mapping[str, Path]
) -> None:
    """Raise `InputError` unless the run's silhouettes and detections were those of the recording."""
    known = {name: each.key for name, each in silhouettes.items()}
    if run.settings.reads_detections:
        prefix = _DETECTIONS_OF if run.settings.needs_silhouettes else ""
        # `pipeline` (`read_sightings`) makes these keys.
        known |= {
            f"{prefix}{name}": digest_file(path, algorithm="sha256")[:16] for name, path in detections.items()
        }
    for name, key in run.record.input_keys.items():
        own = known.get(name) or known.get(name.removeprefix(_DETECTIONS_OF))
        if own != key:
            found = "with other content, or read in another way" if own else "that does not exist"
            raise InputError(
                run.tracks,
                expected=f"tracks of {run.opened.folder}",
                found=f"tracks of {run.record.sequence}, for which {name} was a camera {found}",
                remedy="name the recording that was tracked, or track again with this version",
            )


def _open_settings(run: _Run, files: Mapping[str, Source]) -> dict[str, Any]:
    """Settings that compute the tracks again from the archive."""
    changes: dict[str, Any] = {}
    if run.record.volume.get("speed_from") != "given":
        changes["motion.max_speed_m_s"] = None
    if run.settings.reads_detections:
        changes["detections"] = YOLO
    start = next((name for name in files if name.startswith("start/")), None)
    if start is not None:
        changes["init"] = start
    return msgspec.to_builtins(run.settings.changed(changes))


@dataclass(frozen=True)
class _Packing:
    """The files of an archive, and the `recording.toml` that names them.

    Attributes:
        run: the run.
        silhouettes: stored silhouettes by camera name.
        detections: files of detections by camera name.
        with_videos: whether the videos are packed.
    """

    run: _Run
    silhouettes: Mapping[str, StoredSilhouettes]
    detections: Mapping[str, Path]
    with_videos: bool

    def files(self) -> tuple[dict[str, Source], RecordingFile]:
        """The files by their paths in the archive, and the content of `recording.toml`."""
        used, opened, run = self.run.used, self.run.opened, self.run
        files: dict[str, Source] = {f"tracks{run.tracks.suffix}": run.tracks}
        files["tracks.json"] = run.tracks.with_suffix(".json")
        ambiguity = run.tracks.with_suffix(".ambiguity.csv")
        if ambiguity.is_file():
            files["tracks.ambiguity.csv"] = ambiguity
        if run.settings.init not in ("auto", "truth"):
            files[f"start/{Path(run.settings.init).name}"] = Path(run.settings.init)
        tables = {name: self._table(name, camera, files) for name, camera in _cameras(used)}
        reference = None
        if references := reference_files(opened):
            names = [f"reference/{path.name}" for path in references]
            if len(set(names)) < len(names):
                names = [f"reference/{index}/{path.name}" for index, path in enumerate(references)]
            files |= dict(zip(names, references, strict=True))
            reference = ReferenceTable(
                files=tuple(names),
                time_offset_s=opened.reference_offset_s,
                bodies={name: tuple(labels) for name, labels in opened.bodies.items()},
            )
        markers = None
        if opened.marker_corners is not None:
            files["marker_corners.csv"] = opened.marker_corners
            markers = MarkersTable(corners="marker_corners.csv")
        bounds_m = opened.bounds_m
        world = WorldTable()
        if bounds_m is not None:
            x0, x1, y0, y1, z0, z1 = bounds_m
            world = WorldTable(bounds_m=((x0, y0, z0), (x1, y1, z1)))
        content = RecordingFile(version=1, cameras=tables, world=world, reference=reference, markers=markers)
        return files, content

    def video(self, name: str, video: VideoInfo) -> PackedVideo:
        """What the manifest says of the video of a camera."""
        stored = self.silhouettes.get(name)
        return PackedVideo(
            name=video.path.name,
            frames=video.num_frames,
            digest=digest_video(video) if stored is None else stored.made_of["content"],
            packed_as=_video_path(name, video) if self.with_videos else None,
        )

    def _table(self, name: str, camera: Camera, files: dict[str, Source]) -> CameraTable:
        """The table of a camera; the files that it names are added to `files`."""
        opened = self.run.opened
        video = opened.videos.get(name) if self.with_videos else None
        ignore, detections = opened.ignore.get(name), self.detections.get(name)
        stored, times = self.silhouettes.get(name), opened.frame_times[name]
        table: dict[str, Any] = {}
        if video is not None:
            table["video"] = _video_path(name, video)
            files |= dict(_video_files(table["video"], video))
        if stored is not None:
            table["silhouettes"] = f"silhouettes/{name}"
            files |= dict(_array_files(table["silhouettes"], stored))
        if ignore is not None:
            table["ignore"] = f"ignore/{name}{ignore.suffix}"
            files[table["ignore"]] = ignore
        if detections is not None:
            table["detections"] = f"detections/{name}.csv"
            files[table["detections"]] = detections
        if times.listed_s is not None:
            table["timestamps"] = f"timestamps/{name}.csv"
            files[table["timestamps"]] = _timestamps(times)
        else:
            table |= {"fps": times.fps, "time_offset_s": times.time_offset_s or None}
            if video is None and stored is None:
                table["frames"] = times.num_frames
        distortion, fisheye = lens_model(camera)
        width, height = (int(side) for side in camera.image_size_wh)
        table |= {
            "size": (width, height),
            "line_time_s": opened.line_time_s.get(name, 0.0),
            "K": camera.K.tolist(),
            "model": "fisheye" if fisheye else "opencv",
            "distortion": tuple(distortion),
            # A Rodrigues vector would change the last digits of the rotation.
            "R": camera.T_cam_world[:3, :3].tolist(),
            "tvec": camera.T_cam_world[:3, 3].tolist(),
        }
        return CameraTable(**table)


def _cameras(recording: Recording) -> Iterator[tuple[str, Camera]]:
    for index, name in enumerate(recording.rig.names):
        yield name, recording.rig.cameras[index]


def _video_path(name: str, video: VideoInfo) -> str:
    """Path of a video in the archive; of the folder of its pictures where the frames are pictures."""
    return f"videos/{name}" if video.images else f"videos/{name}{video.path.suffix}"


def _video_files(path: str, video: VideoInfo) -> Iterator[tuple[str, Source]]:
    if not video.images:
        yield path, video.path
    for index, image in enumerate(video.images):
        yield f"{path}/{index:08d}{image.suffix}", image


def _array_files(path: str, stored: StoredSilhouettes) -> Iterator[tuple[str, Source]]:
    """The files of stored silhouettes, which say what they were made of."""
    description = json.loads((stored.path / ARRAY_FILE).read_text(encoding="utf-8"))
    # Silhouettes in a store of an older version do not say it.
    description["attributes"][MADE_OF] = dict(stored.made_of)
    yield f"{path}/{ARRAY_FILE}", json.dumps(description, indent=1, sort_keys=True).encode()
    for folder, folders, names in os.walk(stored.path):
        folders.sort()
        for name in sorted(names):
            file = Path(folder, name)
            # The description that is packed may differ, and the archive has digests of its own.
            if file not in (stored.path / ARRAY_FILE, stored.path / SEAL_FILE):
                yield f"{path}/{file.relative_to(stored.path).as_posix()}", file


def _timestamps(times: FrameTimes) -> bytes:
    rows = (f"{frame},{time_s!r}" for frame, time_s in enumerate(times.listed_s or ()))
    return "\n".join(["frame,time_s", *rows, ""]).encode()
