"""Frames from a folder of images."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from psotrack.errors import SettingsError
from psotrack.inside_out.frames.records import Frame, FrameSource
from psotrack.recordings import is_picture_folder, open_pictures, read_frames


def open_image_folder(folder: Path, fps: float | None) -> FrameSource:
    """Open the images of a folder, in natural order, as frames at `fps` frames per second.

    Raises:
        InputError: the folder cannot be read or has no images; or, when frames are read, image sizes differ.
        SettingsError: `fps` is None.
    """
    if fps is None and is_picture_folder(folder):
        raise SettingsError(
            "--fps",
            expected=f"the rate at which the images in {folder} were taken, because images do not state it",
            found="no --fps",
            remedy="add it in frames per second, such as --fps 25",
        )
    video = open_pictures(folder, fps)
    rate = video.fps

    def frames() -> Iterator[Frame]:
        return (Frame(number, number / rate, bgr) for number, bgr in enumerate(read_frames(video)))

    return FrameSource(str(folder), video.image_size_wh, video.num_frames, frames, fps=rate)
