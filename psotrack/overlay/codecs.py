"""Codecs with which OpenCV can write MP4 files on this machine, and the writing."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from psotrack.errors import OutputError
from psotrack.recordings import VideoEncoder, check_video_written
from psotrack.support import atomic_write


@dataclass(frozen=True)
class Codec:
    """A codec of MP4 files.

    Attributes:
        name: name for people.
        fourcc: the four characters by which OpenCV knows the codec.
    """

    name: str
    fourcc: str


#: Codecs from the best one on. Browsers and phones play H.264; OpenCV's wheels encode it on few machines.
_CODECS = (Codec("H.264", "avc1"), Codec("MPEG-4", "mp4v"))
#: Size of the video with which a codec is tried, pixels.
_TRIED_WH = (320, 240)


def find_codec(codecs: Sequence[Codec] = _CODECS) -> Codec:
    """The first of some codecs with which a video can be written and read back.

    Raises:
        OutputError: there is none.
    """
    for codec in codecs:
        with tempfile.TemporaryDirectory(prefix="psotrack-") as folder:
            path = Path(folder) / "tried.mp4"
            with contextlib.suppress(OutputError):
                with video_writer(path, codec, 25.0, _TRIED_WH) as encoder:
                    for level in (0, 255):
                        encoder.write(np.full((*_TRIED_WH[::-1], 3), level, np.uint8))
                return codec
    raise OutputError(
        "overlay",
        expected=f"one of the codecs {', '.join(codec.name for codec in codecs)}",
        found="none",
        remedy=f"is the disk of {tempfile.gettempdir()} full? videos were tried there",
    )


@contextlib.contextmanager
def video_writer(path: Path, codec: Codec, fps: float, size_wh: tuple[int, int]) -> Iterator[VideoEncoder]:
    """An encoder of BGR frames to a video, which appears under its name when it is complete.

    Args:
        path: path of the file, ending in .mp4.
        codec: the codec.
        fps: frames per second.
        size_wh: width and height of the frames, even numbers.

    Raises:
        OutputError: the codec does not work here, or the file cannot be written completely.
    """
    with atomic_write(path) as temporary:
        try:
            encoder = VideoEncoder(temporary, codec.fourcc, fps, size_wh)
        except OSError as error:
            found = "that OpenCV cannot encode it"
            raise OutputError(path, expected=f"a video in {codec.name}", found=found) from error
        try:
            yield encoder
        finally:
            encoder.close()
        check_video_written(path, temporary, encoder.num_frames)
