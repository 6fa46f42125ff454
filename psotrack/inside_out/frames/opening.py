"""Opening of a source of frames, by its kind: a video file, a folder of images, or a stream."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from psotrack.errors import InputError, check_positive
from psotrack.inside_out.frames.image_folder import open_image_folder
from psotrack.inside_out.frames.records import Frame, FrameSource
from psotrack.inside_out.frames.stream import open_stream
from psotrack.recordings import IMAGE_SUFFIXES, probe, read_frames


def open_source(source: Path | str, *, fps: float | None = None, live: bool = False) -> FrameSource:
    """Open the frames of a video file, a folder of images, or a stream.

    Args:
        source: path of a video or a folder; or address of a stream, such as rtsp://camera/1; or, with `live`, number
            of a device.
        fps: frames per second; required for a folder of images, and for a video whose header has a wrong rate.
        live: always use the newest frame of a stream, and leave out the frames before.

    Raises:
        InputError: the source cannot be read or has no frames, or its images differ in size.
        SettingsError: `fps` is missing or not above 0.
    """
    if fps is not None:
        check_positive("--fps", fps)
    if live or "://" in str(source):
        return open_stream(str(source), fps, live)
    path = Path(source)
    if path.is_dir():
        return open_image_folder(path, fps)
    if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file():
        remedy = "name the images' folder, and pass --fps"
        raise InputError(path, expected="a video, or a folder of images", found="one image", remedy=remedy)
    video = probe(path)
    rate = fps or video.fps

    def frames() -> Iterator[Frame]:
        return (Frame(index, index / rate, bgr) for index, bgr in enumerate(read_frames(video)))

    return FrameSource(str(path), video.image_size_wh, video.num_frames, frames, fps=rate)
