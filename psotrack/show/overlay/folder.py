"""The folder of overlay videos: which videos are wanted, which are finished, and of which inputs they are."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from psotrack.errors import InputError, OutputError, check_positive
from psotrack.recordings import FrameTimes, Recording, nearest_frames
from psotrack.show.flights import (
    FlightTracks,
    ImageEllipses,
    TrackedFlight,
    boxes_in_images,
    colour_rgb,
    ellipses_in_images,
    statuses,
)
from psotrack.show.overlay.codecs import Codec, find_codec
from psotrack.show.overlay.drawing import ImageTracks
from psotrack.show.overlay.map_view import MapTracks, make_map
from psotrack.show.overlay.videos import CameraOverlay, CameraVideoTask, MosaicTask, write_video
from psotrack.support import (
    Report,
    atomic_write,
    check_file_name,
    digest_record,
    map_in_processes,
    no_progress,
    read_text,
    refuse_to_overwrite,
)
from psotrack.trajectories import Trajectories

#: File beside the videos that says of which inputs they are.
INPUTS_FILE = "overlay.json"
#: Raise it when the same inputs give other videos than before.
_DRAWING = 1
#: How much white is mixed into the colours, which stand before images.
_LIGHTER = 0.2
#: Width of the mosaic, pixels.
_MOSAIC_WIDTH_PX = 1920


@dataclass(frozen=True)
class OverlayOptions:
    """How overlay videos are made.

    Attributes:
        mosaic: one video of all cameras with a map from above, instead of a video per camera.
        scale: size of the videos per size of the cameras' videos; the mosaic's size is its own.
        force: replace existing videos.
    """

    mosaic: bool = False
    scale: float = 1.0
    force: bool = False


@dataclass(frozen=True)
class WrittenOverlays:
    """What was written.

    Attributes:
        codec: codec of the videos.
        written: videos that were made.
        kept: videos that were there already.
    """

    codec: Codec
    written: tuple[Path, ...]
    kept: tuple[Path, ...]


def write_overlays(
    folder: Path,
    flight: TrackedFlight,
    options: OverlayOptions = OverlayOptions(),
    *,
    jobs: int | None = None,
    report: Report = no_progress,
) -> WrittenOverlays:
    """Draw the tracks of a flight into the videos of its cameras.

    Videos of the same inputs that are finished are kept; after an interruption, the next call makes the others.

    Args:
        folder: folder of the videos; is made.
        flight: tracks and a recording.
        options: how the videos are made.
        jobs: largest number of processes; None is one per processor.
        report: progress in frames.

    Raises:
        InputError: the recording has no video, or a video cannot be read.
        SettingsError: the scale is not above 0.
        OutputError: the folder has videos of other inputs and `force` is not set, or a video cannot be written.
    """
    check_positive("scale", options.scale)
    recording = flight.recording
    cameras = [] if recording is None else [name for name in recording.rig.names if name in recording.videos]
    if recording is None or not cameras:
        where = "overlay" if recording is None else recording.folder
        raise InputError(where, expected="a recording with videos", found="none")
    for name in cameras:
        check_file_name(name, recording.folder)
    codec = find_codec()
    videos = {
        f"{name}.mp4": _digest(flight, recording, codec, options, cameras if name == "mosaic" else [name])
        for name in (["mosaic"] if options.mosaic else cameras)
    }
    kept = _begin(folder, flight, videos, options.force)
    wanted = [name for name in videos if name not in kept]
    if wanted:
        tasks = _tasks(folder, flight, recording, codec, options, wanted)
        with report("overlay", sum(len(task.time_s) for task in tasks)) as advance:
            map_in_processes(write_video, tasks, jobs=jobs or os.cpu_count() or 1, advance=advance)
    return WrittenOverlays(
        codec, tuple(folder / name for name in wanted), tuple(folder / name for name in kept)
    )


def _begin(folder: Path, flight: TrackedFlight, videos: dict[str, str], force: bool) -> list[str]:
    """Write down of which inputs the videos will be; returns the videos that are finished.

    Args:
        folder: the folder.
        flight: the flight.
        videos: digest of the inputs of each wanted video by its file's name.
        force: whether existing videos are made again.

    Raises:
        InputError: the list of inputs cannot be read.
        OutputError: a video of other inputs exists.
    """
    before = _digests(folder / INPUTS_FILE)
    there = [name for name in videos if (folder / name).exists()]
    kept = [name for name in there if not force and before.get(name) == videos[name]]
    for name in there:
        if name in kept:
            continue
        if not force and name in before:
            raise OutputError(
                folder / name,
                expected=f"a video of {', '.join(str(tracks.path) for tracks in flight.tracks) or 'no tracks'}",
                found=f"one of other inputs (see {INPUTS_FILE})",
                remedy="pass --force to replace it",
            )
        refuse_to_overwrite(folder / name, force)
    for name in there:
        # An old video must not count as one of the new inputs, if this run is interrupted.
        if name not in kept:
            (folder / name).unlink()
    if len(kept) < len(videos):
        content = {
            "recording": flight.name,
            "tracks": [str(tracks.path) for tracks in flight.tracks],
            "videos": before | videos,
        }
        with atomic_write(folder / INPUTS_FILE) as temporary:
            temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return kept


def _digests(path: Path) -> dict[str, str]:
    """Digests of the inputs of a folder's videos by their names."""
    if not path.exists():
        return {}
    try:
        videos = json.loads(read_text(path))["videos"]
        return {str(name): str(digest) for name, digest in videos.items()}
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(
            path, expected="the list that `psotrack overlay` writes", found="another content"
        ) from None


def _digest(
    flight: TrackedFlight,
    recording: Recording,
    codec: Codec,
    options: OverlayOptions,
    cameras: Sequence[str],
) -> str:
    """Digest of what a video of some cameras is made of."""
    index = [recording.rig.names.index(name) for name in cameras]
    rig = recording.rig.cameras
    infos = [recording.videos[name] for name in cameras]
    return digest_record(
        {
            "drawing": _DRAWING,
            "codec": codec.fourcc,
            "scale": options.scale,
            "instants": recording.num_frames,
            "cameras": list(cameras),
            "rig": [np.asarray(value)[index].tolist() for value in (rig.K, rig.dist, rig.T_cam_world)],
            "videos": [[str(info.path), info.num_frames, info.fps] for info in infos],
            "tracks": [
                [each.label, _digest_tracks(each.trajectories), each.size_m.tolist()]
                for each in flight.tracks
            ],
        }
    )


def _digest_tracks(trajectories: Trajectories) -> list[str]:
    """Digests of what is drawn of tracks; the files of some formats are folders."""
    arrays = (
        trajectories.time_s,
        trajectories.position_m,
        statuses(trajectories),
        np.zeros(0) if trajectories.covariance_m2 is None else trajectories.covariance_m2,
    )
    digests = [hashlib.blake2b(np.ascontiguousarray(array).tobytes()).hexdigest() for array in arrays]
    return [*trajectories.drones, *digests]


# What is drawn


def _tasks(
    folder: Path,
    flight: TrackedFlight,
    recording: Recording,
    codec: Codec,
    options: OverlayOptions,
    wanted: Sequence[str],
) -> list[CameraVideoTask | MosaicTask]:
    boxes_px = [boxes_in_images(recording, each.trajectories, each.size_m) for each in flight.tracks]
    ellipses = [ellipses_in_images(recording, each.trajectories) for each in flight.tracks]
    names = [_names(flight, number) for number in range(len(flight.tracks))]
    rgb = [
        tuple(colour_rgb(colour, _LIGHTER) for colour in flight.colours(number))
        for number in range(len(flight.tracks))
    ]

    def overlay_of(camera: str, size_wh: tuple[int, int] | None) -> CameraOverlay:
        video, index = recording.videos[camera], recording.rig.names.index(camera)
        scaled = size_wh or _even(np.array(video.image_size_wh) * options.scale)
        tracks = [
            ImageTracks(
                names[number],
                rgb[number],
                statuses(each.trajectories),
                boxes_px[number][:, :, index],
                _of_camera(ellipses[number], "middle_px", each, index),
                _of_camera(ellipses[number], "shape_px2", each, index),
            )
            for number, each in enumerate(flight.tracks)
        ]
        return CameraOverlay(camera, video, scaled, scaled[0] / video.image_size_wh[0], tuple(tracks))

    if not options.mosaic:
        return [
            _camera_task(folder / name, codec, flight, recording, overlay_of(name.removesuffix(".mp4"), None))
            for name in wanted
        ]
    cameras = [name for name in recording.rig.names if name in recording.videos]
    columns = int(np.ceil(np.sqrt(len(cameras) + 1)))
    width, height = recording.videos[cameras[0]].image_size_wh
    tile_wh = _even(_MOSAIC_WIDTH_PX / columns * np.array([1.0, height / width]))
    overlays = tuple(overlay_of(camera, tile_wh) for camera in cameras)
    timeline = recording.timeline()
    tracks = zip(names, rgb, flight.tracks, strict=True)
    return [
        MosaicTask(
            folder / "mosaic.mp4",
            codec,
            overlays,
            timeline.frame[:, [timeline.cameras.index(camera) for camera in cameras]],
            _rows_at(flight, timeline.time_s),
            timeline.time_s,
            timeline.rate_hz,
            make_map(flight, tile_wh),
            tuple(
                MapTracks(own, colours, statuses(each.trajectories), each.trajectories.position_m)
                for own, colours, each in tracks
            ),
        )
    ]


def _camera_task(
    path: Path, codec: Codec, flight: TrackedFlight, recording: Recording, overlay: CameraOverlay
) -> CameraVideoTask:
    time_s = recording.exposed[overlay.name].time_s[: overlay.video.num_frames]
    return CameraVideoTask(path, codec, overlay, _rows_at(flight, time_s), time_s)


def _rows_at(flight: TrackedFlight, time_s: Float[np.ndarray, " times"]) -> Int[np.ndarray, "times files"]:
    """The row of each file's tracks that is nearest to each time; -1 where none is near."""
    rows = np.full((len(time_s), len(flight.tracks)), -1)
    for number, tracks in enumerate(flight.tracks):
        own_s = tracks.trajectories.time_s
        if len(own_s) > 1:
            rows[:, number], _ = nearest_frames(FrameTimes.listed(own_s, tracks.path), time_s)
        else:
            rows[:, number] = np.where(np.isclose(time_s, own_s[0]), 0, -1)
    return rows


def _of_camera(
    ellipses: ImageEllipses | None, field: str, tracks: FlightTracks, index: int
) -> Float[np.ndarray, "..."]:
    """A field of ellipses in one camera; NaN of its shape for tracks without covariances."""
    if ellipses is not None:
        return getattr(ellipses, field)[:, :, index]
    sides = (2, 2) if field == "shape_px2" else (2,)
    return np.full((tracks.trajectories.num_frames, tracks.trajectories.num_drones, *sides), np.nan)


def _names(flight: TrackedFlight, number: int) -> tuple[str, ...]:
    tracks = flight.tracks[number]
    if len(flight.tracks) == 1:
        return tracks.trajectories.drones
    return tuple(f"{tracks.label} {drone}" for drone in tracks.trajectories.drones)


def _even(size_wh: Float[np.ndarray, "2"]) -> tuple[int, int]:
    """Whole, even numbers of pixels: codecs halve the resolution of colours."""
    width, height = (max(2, 2 * round(float(side) / 2)) for side in size_wh)
    return width, height
