"""The folder of overlay videos, one per camera, or one of all cameras with a map; and which of them are finished."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from jaxtyping import Float, Int, UInt8

from psotrack.errors import InputError, OutputError, check_positive
from psotrack.recordings import (
    ImageViews,
    Recording,
    VideoInfo,
    encoded_video,
    read_frames,
    read_frames_at,
    view_in_images,
)
from psotrack.show.flights import TrackedFlight, rows_at
from psotrack.show.overlay.drawing import (
    DrawnTracks,
    Image,
    ImagePlaces,
    MapView,
    draw_drones,
    draw_map,
    drawn_tracks,
    make_map,
    places_in,
    write_text,
)
from psotrack.support import (
    Advance,
    Report,
    atomic_write,
    check_file_name,
    digest_file,
    map_in_processes,
    no_progress,
    read_json,
    refuse_to_overwrite,
    write_json,
)

_Tile = UInt8[np.ndarray, "_ _ 3"]
#: Time for which a drone's trail is shown, seconds.
TRAIL_S = 2.0


@dataclass(frozen=True)
class DrawnCamera:
    """What is drawn into the frames of one camera.

    Attributes:
        name: name of the camera.
        video: its video.
        size_wh: width and height of the drawn frames, pixels.
        places: places of the drones of each file in this camera.
    """

    name: str
    video: VideoInfo
    size_wh: tuple[int, int]
    places: tuple[ImagePlaces, ...]


@dataclass(frozen=True)
class DrawnVideo:
    """A video of one camera, or of several side by side, with a map in the last place.

    Attributes:
        fourcc: codec of the file.
        fps: instants per second.
        tile_wh: width and height of the place of each camera, pixels, even numbers.
        cameras: the cameras.
        tracks: the tracks of each file.
        frame: (instants, cameras), number of the frame of each camera at each instant; -1 for none.
        row: (instants, files), row of each file's tracks at each instant; -1 for none.
        time_s: (instants,), times, seconds.
        view: the map, of the size of a place; None for none.
    """

    fourcc: str
    fps: float
    tile_wh: tuple[int, int]
    cameras: tuple[DrawnCamera, ...]
    tracks: tuple[DrawnTracks, ...]
    frame: Int[np.ndarray, "instants cameras"]
    row: Int[np.ndarray, "instants files"]
    time_s: Float[np.ndarray, " instants"]
    view: MapView | None = None

    @property
    def columns_lines(self) -> tuple[int, int]:
        """Number of places side by side, and one below the other."""
        count = len(self.cameras) + (self.view is not None)
        columns = int(np.ceil(np.sqrt(count)))
        return columns, -(-count // columns)

    def image(self, instant: int, frames: Sequence[_Tile | None]) -> Image:
        """What is shown at an instant, of the cameras' frames."""
        (columns, lines), (width, height) = self.columns_lines, self.tile_wh
        image = np.zeros((lines * height, columns * width, 3), np.uint8)
        row, trail_rows = self.row[instant].tolist(), round(TRAIL_S * self.fps)
        words = f"{self.time_s[instant]:.2f} s"
        tiles = [self._tile(*each, row, trail_rows, words) for each in zip(self.cameras, frames, strict=True)]
        if self.view is not None:
            tiles.append(draw_map(self.view, self.tracks, row, trail_rows))
            write_text(tiles[-1], words)
        for place, tile in enumerate(tiles):
            line, column = divmod(place, columns)
            top = line * height + (height - tile.shape[0]) // 2
            left = column * width + (width - tile.shape[1]) // 2
            image[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
        return image

    def _tile(
        self, camera: DrawnCamera, frame: _Tile | None, row: Sequence[int], trail_rows: int, words: str
    ) -> _Tile:
        """A camera's frame at its drawn size, with what was found in it."""
        if frame is None:
            return np.zeros((*camera.size_wh[::-1], 3), np.uint8)
        image = np.asarray(cv2.resize(frame, camera.size_wh, interpolation=cv2.INTER_AREA), np.uint8)
        scale = camera.size_wh[0] / camera.video.image_size_wh[0]
        for tracks, places, now in zip(self.tracks, camera.places, row, strict=True):
            if now >= 0:
                draw_drones(image, tracks, places, now, scale, trail_rows=trail_rows)
        write_text(image, f"{camera.name}  {words}")
        return image


def write_video(task: tuple[Path, DrawnVideo], advance: Advance) -> None:
    """Write a video; it appears under its name when it is complete.

    Args:
        task: the file, and the video.
        advance: receives the number of written instants.

    Raises:
        InputError: a video ends early.
        OutputError: the video cannot be written.
    """
    path, video = task
    size_wh = tuple(np.multiply(video.columns_lines, video.tile_wh).tolist())
    frames = [
        _frames(camera.video, numbers)
        for camera, numbers in zip(video.cameras, video.frame.T.tolist(), strict=True)
    ]
    with encoded_video(path, video.fourcc, video.fps, size_wh) as encoder:
        for instant, images in enumerate(zip(*frames, strict=True)):
            encoder.write(video.image(instant, images))
            advance(1)


def _frames(video: VideoInfo, numbers: Sequence[int]) -> Iterator[_Tile | None]:
    """The frames with some numbers, which do not decrease; None for -1."""
    following, at, image = read_frames(video), -1, None
    for number in numbers:
        while at < number:
            at, image = at + 1, next(following)
        yield image if number >= 0 else None


#: File beside the videos that says of what they are made.
INPUTS_FILE = "overlay.json"
#: Raise it when the same inputs give other videos than before.
_DRAWING = 2
#: Width of the mosaic as a video and as a picture, pixels.
_VIDEO_WIDTH_PX, _PICTURE_WIDTH_PX = 1920, 1440
#: Size of the video with which a codec is tried, pixels.
_TRIED_WH = (320, 240)


#: Codecs of MP4 files from the best one on: how OpenCV knows them, and their names for people. Browsers and phones play
#: H.264; OpenCV's wheels encode it on few machines.
_CODECS = {"avc1": "H.264", "mp4v": "MPEG-4"}


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
        folder: folder of the videos.
        codec: name of the codec of the videos.
        written: videos that were made.
        kept: videos that were there already.
    """

    folder: Path
    codec: str
    written: tuple[Path, ...]
    kept: tuple[Path, ...]

    def __str__(self) -> str:
        kept = f", {len(self.kept)} were there already" if self.kept else ""
        return f"{self.folder}: {len(self.written)} videos in {self.codec}{kept}"


def write_overlays(
    folder: Path,
    flight: TrackedFlight,
    options: OverlayOptions = OverlayOptions(),
    *,
    jobs: int | None = None,
    report: Report = no_progress,
) -> WrittenOverlays:
    """Draw the tracks of a flight into the videos of its cameras.

    Videos of the same content that are finished are kept; after an interruption, the next call makes the others.

    Args:
        folder: folder of the videos; is made.
        flight: tracks and a recording.
        options: how the videos are made.
        jobs: largest number of processes; None is one per processor.
        report: progress in frames.

    Raises:
        InputError: the recording has no video, or a video cannot be read.
        SettingsError: the scale is not above 0.
        OutputError: the folder has videos of another content and `force` is not set, or a video cannot be written.
    """
    check_positive("scale", options.scale)
    recording, cameras = _filmed(flight)
    for name in cameras:
        check_file_name(name, recording.folder)
    codec, scene = find_codec(), _Scene(flight, recording)
    if options.mosaic:
        videos = {"mosaic.mp4": scene.mosaic(cameras, codec, _VIDEO_WIDTH_PX)}
    else:
        videos = {f"{name}.mp4": scene.of_camera(name, codec, options.scale) for name in cameras}
    kept = _begin(folder, flight, {name: _digest(video) for name, video in videos.items()}, options.force)
    tasks = [(folder / name, video) for name, video in videos.items() if name not in kept]
    if tasks:
        with report("overlay", sum(len(video.time_s) for _, video in tasks)) as advance:
            map_in_processes(write_video, tasks, jobs=jobs or os.cpu_count() or 1, advance=advance)
    written = tuple(path for path, _ in tasks)
    return WrittenOverlays(folder, _CODECS[codec], written, tuple(folder / name for name in kept))


def save_picture(path: Path, flight: TrackedFlight, *, most_cameras: int = 5, force: bool = False) -> None:
    """Save the middle moment of a flight as a picture: its first cameras, and the map from above.

    Args:
        path: path of the PNG file.
        flight: tracks and a recording.
        most_cameras: largest number of cameras.
        force: replace an existing file.

    Raises:
        InputError: the recording has no video, or a video cannot be read.
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    refuse_to_overwrite(path, force)
    recording, cameras = _filmed(flight)
    video = _Scene(flight, recording).mosaic(cameras[:most_cameras], "", _PICTURE_WIDTH_PX)
    instant = len(video.time_s) // 2
    numbers = video.frame[instant].tolist()
    frames = [
        next(read_frames_at(camera.video, [number]))[1] if number >= 0 else None
        for camera, number in zip(video.cameras, numbers, strict=True)
    ]
    _, coded = cv2.imencode(".png", video.image(instant, frames))
    with atomic_write(path) as temporary:
        temporary.write_bytes(coded.tobytes())


def find_codec(codecs: Collection[str] = _CODECS) -> str:
    """The first of some codecs with which a video can be written and read back.

    Raises:
        OutputError: there is none.
    """
    for codec in codecs:
        with tempfile.TemporaryDirectory(prefix="psotrack-") as folder, contextlib.suppress(OutputError):
            with encoded_video(Path(folder) / "tried.mp4", codec, 25.0, _TRIED_WH) as encoder:
                for level in (0, 255):
                    encoder.write(np.full((*_TRIED_WH[::-1], 3), level, np.uint8))
            return codec
    raise OutputError(
        "overlay",
        expected=f"one of the codecs {', '.join(codecs)}",
        found="none",
        remedy=f"is the disk of {tempfile.gettempdir()} full? videos were tried there",
    )


# Which videos are finished


def _begin(folder: Path, flight: TrackedFlight, videos: dict[str, str], force: bool) -> list[str]:
    """Write down of what the videos will be made; returns the names of those that are finished.

    Args:
        folder: the folder.
        flight: the flight.
        videos: digest of each wanted video by its file's name.
        force: whether existing videos are made again.

    Raises:
        InputError: the list cannot be read.
        OutputError: a video of another content exists.
    """
    path = folder / INPUTS_FILE
    said = read_json(path, "the list that `psotrack overlay` writes").get("videos") if path.exists() else None
    before = said if isinstance(said, dict) else {}
    there = [name for name in videos if (folder / name).exists()]
    kept = [name for name in there if not force and before.get(name) == videos[name]]
    others = [name for name in there if name not in kept]
    for name in others:
        refuse_to_overwrite(folder / name, force)
    for name in others:
        # An old video must not count as one of the new content, if this run is interrupted.
        (folder / name).unlink()
    if len(kept) < len(videos):
        tracks = [str(each.path) for each in flight.tracks]
        content = {"videos": before | videos, "recording": flight.name, "tracks": tracks}
        write_json(path, content)
    return kept


def _digest(video: DrawnVideo) -> str:
    """Digest of all that is drawn and of the videos into which it is drawn: of everything that changes the result."""

    def plain(value: Any) -> Any:
        if isinstance(value, Path):
            return digest_file(value) if value.is_file() else None
        if isinstance(value, np.generic):
            return value.item()
        return [value.shape, hashlib.blake2b(value.tobytes()).hexdigest()]

    text = msgspec.json.encode([_DRAWING, video], enc_hook=plain, order="deterministic")
    return hashlib.blake2b(text, digest_size=20).hexdigest()


# What is drawn


def _filmed(flight: TrackedFlight) -> tuple[Recording, list[str]]:
    """The recording of a flight, and its cameras that have a video."""
    recording = flight.recording
    cameras = [] if recording is None else [each.name for each in recording.placed if each.video]
    if recording is None or not cameras:
        where = "overlay" if recording is None else recording.folder
        raise InputError(where, expected="a recording with videos", found="none")
    return recording, cameras


class _Scene:
    """The tracks of a flight in its cameras."""

    def __init__(self, flight: TrackedFlight, recording: Recording) -> None:
        self._flight, self._recording = flight, recording
        self._tracks: tuple[DrawnTracks, ...] = tuple(drawn_tracks(each) for each in flight.tracks)
        self._views: list[ImageViews] = [
            view_in_images(recording, each.trajectories, each.size_m) for each in flight.tracks
        ]

    def of_camera(self, name: str, codec: str, scale: float) -> DrawnVideo:
        """The video of one camera, at the times of its frames."""
        video = self._recording.videos[name]
        size_wh = _even(np.array(video.image_size_wh) * scale)
        time_s = self._recording.exposed[name].time_s[: video.num_frames]
        camera, frame = self._camera(name, size_wh), np.arange(len(time_s))[:, None]
        shown = self._tracks, frame, self._rows_at(time_s), time_s
        return DrawnVideo(codec, video.fps, size_wh, (camera,), *shown)

    def mosaic(self, names: Sequence[str], codec: str, width_px: int) -> DrawnVideo:
        """The video of some cameras at the recording's instants, with the map; images keep their aspect ratios."""
        columns = int(np.ceil(np.sqrt(len(names) + 1)))
        width, height = self._recording.videos[names[0]].image_size_wh
        tile_wh = _even(width_px / columns * np.array([1.0, height / width]))
        timeline = self._recording.timeline()
        cameras = []
        for name in names:
            own_wh = np.array(self._recording.videos[name].image_size_wh)
            cameras.append(self._camera(name, _even(own_wh * (np.array(tile_wh) / own_wh).min())))
        return DrawnVideo(
            codec,
            timeline.rate_hz,
            tile_wh,
            tuple(cameras),
            self._tracks,
            timeline.frame[:, [timeline.cameras.index(name) for name in names]],
            self._rows_at(timeline.time_s),
            timeline.time_s,
            make_map(self._recording.rig, self._tracks, tile_wh),
        )

    def _camera(self, name: str, size_wh: tuple[int, int]) -> DrawnCamera:
        index = self._recording.rig.names.index(name)
        places = tuple(places_in(views, index) for views in self._views)
        return DrawnCamera(name, self._recording.videos[name], size_wh, places)

    def _rows_at(self, time_s: Float[np.ndarray, " times"]) -> Int[np.ndarray, "times files"]:
        """The row of each file's tracks at each time; -1 for none."""
        rows = [rows_at(tracks.trajectories, time_s) for tracks in self._flight.tracks]
        return np.stack(rows, axis=1) if rows else np.zeros((len(time_s), 0), int)


def _even(size_wh: Float[np.ndarray, "2"]) -> tuple[int, int]:
    """Whole, even numbers of pixels: codecs halve the resolution of colours."""
    width, height = (max(2, 2 * round(float(side) / 2)) for side in size_wh)
    return width, height
