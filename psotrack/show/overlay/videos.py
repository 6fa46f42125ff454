"""One video per camera, or one of all cameras with a map: tasks that worker processes do."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from psotrack.recordings import VideoInfo, encoded_video, read_frames
from psotrack.show.overlay.drawing import DrawnTracks, ImagePlaces, draw_drones, write_text
from psotrack.show.overlay.map_view import MapView, draw_map
from psotrack.support import Advance

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

    def image(
        self, instant: int, frames: Sequence[UInt8[np.ndarray, "_ _ 3"] | None]
    ) -> UInt8[np.ndarray, "height width 3"]:
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
        self,
        camera: DrawnCamera,
        frame: UInt8[np.ndarray, "_ _ 3"] | None,
        row: Sequence[int],
        trail_rows: int,
        words: str,
    ) -> UInt8[np.ndarray, "_ _ 3"]:
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


def _frames(video: VideoInfo, numbers: Sequence[int]) -> Iterator[UInt8[np.ndarray, "_ _ 3"] | None]:
    """The frames with some numbers, which do not decrease; None for -1."""
    following, at, image = read_frames(video), -1, None
    for number in numbers:
        while at < number:
            at, image = at + 1, next(following)
        yield image if number >= 0 else None
