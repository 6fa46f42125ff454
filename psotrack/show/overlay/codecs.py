"""Codecs with which OpenCV can write MP4 files on this machine."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from psotrack.errors import OutputError
from psotrack.recordings import encoded_video


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
                with encoded_video(path, codec.fourcc, 25.0, _TRIED_WH) as encoder:
                    for level in (0, 255):
                        encoder.write(np.full((*_TRIED_WH[::-1], 3), level, np.uint8))
                return codec
    raise OutputError(
        "overlay",
        expected=f"one of the codecs {', '.join(codec.name for codec in codecs)}",
        found="none",
        remedy=f"is the disk of {tempfile.gettempdir()} full? videos were tried there",
    )
