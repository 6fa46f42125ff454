"""Packing tracks with everything from which they can be computed again."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec

from psotrack.errors import InputError
from psotrack.foreground.silhouettes import compute, stored_silhouettes
from psotrack.geometry.rig_files import camera_values
from psotrack.pipeline import detection_files_of, usable_for
from psotrack.pipeline.archives.archive_file import (
    Manifest,
    PackedVideo,
    Source,
    TrackRecord,
    read_record,
    write_archive,
)
from psotrack.recordings import (
    ARRAY_FILE,
    RECORDING_FILE,
    CameraRecording,
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
from psotrack.settings import YOLO
from psotrack.support import Report, digest_file, no_progress, refuse_to_overwrite
from psotrack.trajectories import read_trajectories

#: Prefix of the input keys of detections that the method "fused" read beside silhouettes.
_DETECTIONS_OF = "detections of "

#: Files of an archive by their paths in it.
_Files = dict[str, Source]


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
    tracks, out, cache = Path(tracks), Path(out), Path(cache)
    refuse_to_overwrite(out, force)
    record = read_record(tracks)
    settings = record.settings
    used = _recording_of(tracks, record, recording)
    silhouettes = stored_silhouettes(used, settings.silhouettes, cache) if settings.needs_silhouettes else {}
    detections: Mapping[str, Path] = used.detections
    keys = {name: stored.key for name, stored in silhouettes.items()}
    if settings.reads_detections:
        detections = detection_files_of(used, settings.detections)
        prefix = _DETECTIONS_OF if settings.needs_silhouettes else ""
        # `pipeline` (`read_sightings`) makes these keys.
        digests = {name: digest_file(path, algorithm="sha256")[:16] for name, path in detections.items()}
        keys |= {f"{prefix}{name}": digest for name, digest in digests.items()}
    for name in sorted(record.input_keys):
        if keys.get(name) != record.input_keys[name]:
            raise _other_recording(tracks, record, recording, f"other content of {name}")
    if silhouettes:
        compute(used, settings.silhouettes, cache=cache, all_videos=False, report=report)

    files: _Files = {f"tracks{tracks.suffix}": tracks, "tracks.json": tracks.with_suffix(".json")}
    if (ambiguity := tracks.with_suffix(".ambiguity.csv")).is_file():
        files["tracks.ambiguity.csv"] = ambiguity
    changes: dict[str, Any] = {}
    if settings.init not in ("auto", "truth"):
        changes["init"] = f"start/{Path(settings.init).name}"
        files[changes["init"]] = Path(settings.init)
    if record.volume.get("speed_from") != "given":
        changes["motion.max_speed_m_s"] = None
    if settings.reads_detections:
        changes["detections"] = YOLO

    cameras = [
        replace(
            recording.by_name[each.name],
            silhouettes=silhouettes.get(each.name),
            detections=detections.get(each.name),
        )
        for each in used.cameras
    ]
    filmed = [each for each in used.cameras if each.video is not None]
    packed_videos = {each.name: _packed_video(each, silhouettes.get(each.name), videos) for each in filmed}
    content, more = _recording_file(replace(recording, cameras=tuple(cameras)), packed_videos)
    manifest = Manifest(
        psotrack=version("psotrack"),
        sequence=record.sequence,
        tracks=f"tracks{tracks.suffix}",
        settings=msgspec.to_builtins(settings.changed(changes)),
        frames=record.frames_asked,
        causal=record.causal,
        most_drones=record.most_drones,
        videos=packed_videos,
    )
    files = {RECORDING_FILE: recording_file_text(content).encode(), **files, **more}
    return write_archive(out, manifest, files, force=force, report=report)


def _packed_video(camera: CameraRecording, stored: StoredSilhouettes | None, with_video: bool) -> PackedVideo:
    """What the manifest says of the video of a camera."""
    video = camera.video
    assert video is not None
    return PackedVideo(
        name=video.path.name,
        frames=video.num_frames,
        digest=digest_video(video) if stored is None else stored.made_of["content"],
        packed_as=f"videos/{camera.name}{'' if video.images else video.path.suffix}" if with_video else None,
    )


def _recording_file(
    recording: Recording, packed_videos: Mapping[str, PackedVideo]
) -> tuple[RecordingFile, _Files]:
    """The content of `recording.toml`, and the files that it names."""
    files: _Files = {}
    tables = {}
    for each in recording.cameras:
        packed = packed_videos.get(each.name)
        tables[each.name], named = _camera_table(each, None if packed is None else packed.packed_as)
        files |= named
    reference = markers = None
    if recording.reference is not None:
        known = recording.reference
        names = [f"reference/{index}/{path.name}" for index, path in enumerate(known.files)]
        files |= dict(zip(names, known.files, strict=True))
        bodies = {name: tuple(labels) for name, labels in known.bodies.items()}
        reference = ReferenceTable(files=tuple(names), time_offset_s=known.offset_s, bodies=bodies)
    if recording.marker_corners is not None:
        markers = MarkersTable(corners="marker_corners.csv")
        files["marker_corners.csv"] = recording.marker_corners
    world, bounds_m = WorldTable(), recording.bounds_m
    if bounds_m is not None:
        world = WorldTable(bounds_m=(bounds_m[0::2], bounds_m[1::2]))
    content = RecordingFile(version=1, cameras=tables, world=world, reference=reference, markers=markers)
    return content, files


def _camera_table(camera: CameraRecording, video_path: str | None) -> tuple[CameraTable, _Files]:
    """The table of a camera, and the files that it names.

    Args:
        camera: a camera with lens, place and times.
        video_path: path of its video in the archive; None where the archive does not hold it.
    """
    video, stored, times = camera.video, camera.silhouettes, camera.times
    assert camera.camera is not None
    assert times is not None
    table = {**camera_values(camera.camera, placed=False), "line_time_s": camera.line_time_s}
    # A Rodrigues vector would change the last digits of the rotation.
    T_cam_world = camera.camera.T_cam_world
    table |= {"R": T_cam_world[:3, :3].tolist(), "tvec": T_cam_world[:3, 3].tolist()}
    files: _Files = {}
    if video is not None and video_path is not None:
        table["video"] = video_path
        files |= _video_files(video_path, video)
    if stored is not None:
        table["silhouettes"] = f"silhouettes/{camera.name}"
        files |= _array_files(table["silhouettes"], stored.path)
    for key, path in (("ignore", camera.ignore), ("detections", camera.detections)):
        if path is not None:
            table[key] = f"{key}/{camera.name}{path.suffix}"
            files[table[key]] = path
    if times.listed_s is not None:
        table["timestamps"] = f"timestamps/{camera.name}.csv"
        files[table["timestamps"]] = _timestamps(times)
    else:
        table |= {"fps": times.fps, "time_offset_s": times.time_offset_s or None}
        if stored is None and video_path is None:
            table["frames"] = times.num_frames
    return CameraTable(**table), files


def _recording_of(tracks: Path, record: TrackRecord, opened: Recording) -> Recording:
    """The recording with the cameras and frames from which tracks were computed.

    Raises:
        InputError: the tracks do not fit their record, or the recording has other cameras or another rate.
    """
    rows = read_trajectories(tracks).num_frames
    if not record.causal and rows != record.frames:
        expected = f"{record.frames} frames, as {tracks.with_suffix('.json').name} says"
        raise InputError(tracks, expected=expected, found=f"{rows}")
    for name in record.cameras:
        if name not in opened.rig.names:
            raise _other_recording(tracks, record, opened, f"no camera {name}")
    used = usable_for(opened, record.settings, cameras=record.cameras)
    if record.frames_asked is not None and record.frames_asked <= used.num_frames:
        used = used.usable(num_frames=record.frames_asked, videos=False)
    timeline = used.at_rate(record.settings.rate_hz).timeline()
    if timeline.num_instants < record.frames or not math.isclose(timeline.rate_hz, record.rate_hz):
        found = f"{timeline.num_instants} frames at {timeline.rate_hz:g} Hz"
        raise _other_recording(tracks, record, opened, found)
    return used


def _other_recording(tracks: Path, record: TrackRecord, opened: Recording, has: str) -> InputError:
    return InputError(
        tracks,
        expected=f"tracks of {opened.folder}",
        found=f"tracks of {record.sequence} with {len(record.cameras)} cameras and {record.frames} frames at "
        f"{record.rate_hz:g} Hz, while {opened.name} has {has}",
        remedy="name the recording that was tracked, or track again with this version",
    )


def _video_files(path: str, video: VideoInfo) -> _Files:
    if not video.images:
        return {path: video.path}
    return {f"{path}/{index:08d}{image.suffix}": image for index, image in enumerate(video.images)}


def _array_files(path: str, folder: Path) -> _Files:
    """The description of stored silhouettes and their chunks, which lie in folders; other files are of the store."""
    files = sorted(each for each in folder.rglob("*") if each.is_file())
    return {
        f"{path}/{each.relative_to(folder).as_posix()}": each
        for each in files
        if each.parent != folder or each.name == ARRAY_FILE
    }


def _timestamps(times: FrameTimes) -> bytes:
    rows = (f"{frame},{time_s!r}" for frame, time_s in enumerate(times.listed_s or ()))
    return "\n".join(["frame,time_s", *rows, ""]).encode()
