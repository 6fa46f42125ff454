"""One video per camera, or one of all cameras: tasks that worker processes do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from psotrack.recordings import VideoInfo, encoded_video, read_frames
from psotrack.show.overlay.codecs import Codec
from psotrack.show.overlay.drawing import ImageTracks, draw_tracks, write_heading
from psotrack.show.overlay.map_view import MapTracks, MapView, draw_map
from psotrack.support import Advance

#: Time for which a drone's trail is shown, seconds.
TRAIL_S = 2.0


@dataclass(frozen=True)
class CameraOverlay:
    """What is drawn into the frames of one camera.

    Attributes:
        name: name of the camera.
        video: its video.
        size_wh: width and height of the drawn frames, pixels, even numbers.
        scale: pixels of the drawn frames per pixel of the video.
        tracks: the tracks of each file in this camera.
    """

    name: str
    video: VideoInfo
    size_wh: tuple[int, int]
    scale: float
    tracks: tuple[ImageTracks, ...]

    def drawn(
        self,
        frame: UInt8[np.ndarray, "height width 3"],
        row: Int[np.ndarray, " files"],
        trail_rows: int,
        words: str,
    ) -> UInt8[np.ndarray, "rows columns 3"]:
        """A frame at its drawn size, with what was found in it."""
        image = frame
        if frame.shape[1::-1] != self.size_wh:
            image = np.asarray(cv2.resize(frame, self.size_wh, interpolation=cv2.INTER_AREA), np.uint8)
        for own, now in zip(self.tracks, row.tolist(), strict=True):
            if now >= 0:
                draw_tracks(image, own, now, self.scale, trail_rows)
        write_heading(image, f"{self.name}  {words}")
        return image


@dataclass(frozen=True)
class CameraVideoTask:
    """Task of writing the video of one camera.

    Attributes:
        path: the file.
        codec: its codec.
        camera: the camera.
        row: (frames, files), row of each file's tracks for each frame of the video; -1 for none.
        time_s: (frames,), times of the frames, seconds.
    """

    path: Path
    codec: Codec
    camera: CameraOverlay
    row: Int[np.ndarray, "frames files"]
    time_s: Float[np.ndarray, " frames"]


@dataclass(frozen=True)
class MosaicTask:
    """Task of writing the video of all cameras, with the map.

    Attributes:
        path: the file.
        codec: its codec.
        cameras: the cameras; their frames have one size.
        frame: (instants, cameras), number of the frame of each camera at each instant; -1 for none.
        row: (instants, files), row of each file's tracks at each instant; -1 for none.
        time_s: (instants,), times, seconds.
        fps: instants per second.
        view: the map, of the size of the cameras' frames.
        tracks: the tracks of each file on the map.
    """

    path: Path
    codec: Codec
    cameras: tuple[CameraOverlay, ...]
    frame: Int[np.ndarray, "instants cameras"]
    row: Int[np.ndarray, "instants files"]
    time_s: Float[np.ndarray, " instants"]
    fps: float
    view: MapView
    tracks: tuple[MapTracks, ...]


def write_video(task: CameraVideoTask | MosaicTask, advance: Advance) -> None:
    """Write a video; it appears under its name when it is complete.

    Raises:
        InputError: a video ends early.
        OutputError: the video cannot be written.
    """
    if isinstance(task, MosaicTask):
        _write_mosaic(task, advance)
        return
    camera = task.camera
    trail_rows = round(TRAIL_S * camera.video.fps)
    with encoded_video(task.path, task.codec.fourcc, camera.video.fps, camera.size_wh) as encoder:
        for number, frame in enumerate(read_frames(camera.video, into_one=True)):
            words = f"{task.time_s[number]:.2f} s"
            encoder.write(camera.drawn(frame, task.row[number], trail_rows, words))
            advance(1)


def _write_mosaic(task: MosaicTask, advance: Advance) -> None:
    width, height = task.cameras[0].size_wh
    columns = int(np.ceil(np.sqrt(len(task.cameras) + 1)))
    lines = -(-(len(task.cameras) + 1) // columns)
    readers = [_FramesInOrder(camera.video) if camera.video.num_frames else None for camera in task.cameras]
    trail_rows = round(TRAIL_S * task.fps)
    with encoded_video(task.path, task.codec.fourcc, task.fps, (columns * width, lines * height)) as encoder:
        for instant in range(len(task.time_s)):
            words = f"{task.time_s[instant]:.2f} s"
            whole = np.zeros((lines * height, columns * width, 3), np.uint8)
            tiles = [
                camera.drawn(reader.read(number), task.row[instant], trail_rows, words)
                if reader is not None and (number := int(task.frame[instant, index])) >= 0
                else np.zeros((height, width, 3), np.uint8)
                for index, (camera, reader) in enumerate(zip(task.cameras, readers, strict=True))
            ]
            map_image = draw_map(task.view, task.tracks, task.row[instant].tolist(), trail_rows)
            write_heading(map_image, words)
            for place, tile in enumerate([*tiles, map_image]):
                line, column = divmod(place, columns)
                whole[line * height : (line + 1) * height, column * width : (column + 1) * width] = tile
            encoder.write(whole)
            advance(1)


class _FramesInOrder:
    """The frames of a video by increasing numbers; a number may come again."""

    def __init__(self, video: VideoInfo) -> None:
        self._frames: Iterator[tuple[int, UInt8[np.ndarray, "height width 3"]]] = enumerate(
            read_frames(video)
        )
        self._number = -1
        self._frame = np.zeros((0, 0, 3), np.uint8)

    def read(self, number: int) -> UInt8[np.ndarray, "height width 3"]:
        """A copy of a frame."""
        while self._number < number:
            self._number, self._frame = next(self._frames)
        return self._frame.copy()
