"""Writing and joining of videos.

FFmpeg, inside OpenCV, encodes. FFmpeg reports no failed writes: a video is checked before it gets its name.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from psotrack.errors import InputError, OutputError, SettingsError, check_positive
from psotrack.recordings.image_files import silence_opencv
from psotrack.recordings.video import TruncatedVideoError, VideoInfo, open_capture, packet_times, probe
from psotrack.support import atomic_write

#: MPEG-4 part 2: OpenCV's wheels can encode and decode it, and decoding is faster than with MJPEG.
_CODEC = "XVID"
#: Properties of a writer that takes encoded frames and the flags of key frames.
_CODED = (cv2.VIDEOWRITER_PROP_RAW_VIDEO, 1, cv2.VIDEOWRITER_PROP_KEY_INTERVAL, 2**31 - 1)


class VideoEncoder:
    """Encodes BGR frames into a file by FFmpeg, without FFmpeg's messages: `check_video_written` finds what is missing.

    Args:
        file: the file; its ending says the container.
        codec: four letters.
        fps: frames per second.
        image_size_wh: width and height in pixels.
        settings: pairs of a property of `cv2.VideoWriter` and its value.

    Raises:
        OSError: FFmpeg cannot open the file, or does not have the codec.
    """

    def __init__(
        self,
        file: Path,
        codec: str,
        fps: float,
        image_size_wh: tuple[int, int],
        settings: Sequence[int] = (),
    ) -> None:
        self.num_frames, self._size_wh = 0, image_size_wh
        with silence_opencv():
            # An absolute path, because FFmpeg reads the text before a colon as a protocol.
            self._writer = cv2.VideoWriter(
                os.path.abspath(file),
                cv2.CAP_FFMPEG,
                cv2.VideoWriter.fourcc(*codec),
                fps,
                image_size_wh,
                settings,
            )
        if not self._writer.isOpened():
            raise OSError("a video that FFmpeg cannot open")

    def write(self, bgr: UInt8[np.ndarray, "height width 3"]) -> None:
        """Append one frame, (height, width, 3)."""
        width, height = self._size_wh
        # OpenCV drops such a frame without an error.
        if bgr.shape != (height, width, 3):
            raise SettingsError("frame", expected=f"shape {(height, width, 3)}", found=f"{bgr.shape}")
        with silence_opencv():
            self._writer.write(bgr)
        self.num_frames += 1

    def write_encoded(self, packet: UInt8[np.ndarray, "..."], key_flag: float) -> None:
        """Append one frame that is encoded; the file was opened with the property of raw video."""
        with silence_opencv():
            self._writer.set(cv2.VIDEOWRITER_PROP_KEY_FLAG, key_flag)
            self._writer.write(packet)
        self.num_frames += 1

    def close(self) -> None:
        """Write the end of the file."""
        with silence_opencv():
            self._writer.release()


@contextlib.contextmanager
def encoded_video(
    path: Path, codec: str, fps: float, image_size_wh: tuple[int, int], settings: Sequence[int] = ()
) -> Iterator[VideoEncoder]:
    """An encoder of BGR frames to a video, which appears under its name when it is complete.

    Args:
        path: path of the file; its ending says the container.
        codec, fps, image_size_wh, settings: as for `VideoEncoder`.

    Raises:
        OutputError: the codec does not work here, or the file cannot be written completely.
    """
    with atomic_write(path) as temporary:
        try:
            encoder = VideoEncoder(temporary, codec, fps, image_size_wh, settings)
        except OSError as error:
            raise OutputError(path, expected="a video that can be written", found=str(error)) from error
        try:
            yield encoder
        finally:
            encoder.close()
        check_video_written(path, temporary, encoder.num_frames)


class VideoWriter:
    """Writes BGR frames to an .avi file with lossy compression (MPEG-4).

    The file appears at `path` when the `with` block ends without an error. The container stores the frame rate to 0.001
    per second.

    Args:
        path: path of the file, ending in .avi; its folder is created.
        fps: frames per second.
        image_size_wh: width and height in pixels, even numbers.

    Raises:
        SettingsError: the suffix, the rate or the size is not allowed, or a frame has another size.
        OutputError: the file cannot be written completely, for example because the disk is full.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with VideoWriter(Path(folder) / "cam1i_s.avi", 25.0, (64, 48)) as writer:
        ...         writer.write(np.zeros((48, 64, 3), np.uint8))
        ...     probe(Path(folder) / "cam1i_s.avi").num_frames
        1
    """

    def __init__(self, path: Path | str, fps: float, image_size_wh: tuple[int, int]) -> None:
        path = Path(path)
        if path.suffix.lower() != ".avi":
            raise SettingsError("video", expected="a file name ending in .avi", found=path.name)
        check_positive("fps", fps)
        if any(side < 2 or side % 2 for side in image_size_wh):
            raise SettingsError(
                "image size",
                expected="even numbers of pixels, because the codec halves the resolution of colours",
                found=f"{image_size_wh[0]} x {image_size_wh[1]}",
            )
        self._video = encoded_video(path, _CODEC, fps, image_size_wh)

    def __enter__(self) -> VideoEncoder:
        return self._video.__enter__()

    def __exit__(self, *error: Any) -> None:
        self._video.__exit__(*error)


def join_videos(path: Path | str, parts: Sequence[Path | str]) -> None:
    """Join videos without encoding their frames again; the file appears at `path` when it is complete.

    Decoding the joined video gives the same frames as decoding the parts, and seeking works as in the parts.

    Args:
        path: path of the new file, ending in .avi.
        parts: paths of at least one video of `VideoWriter`, all of one size and one rate.

    Raises:
        InputError: a part cannot be read, ends early, or has another size or rate than the first part.
        OutputError: the file cannot be written completely, for example because the disk is full.
    """
    path = Path(path)
    videos = [probe(part) for part in parts]
    first = videos[0]
    for video in videos:
        if not _has_its_end(video.path):
            raise InputError(video.path, expected="a whole video", found="one that is cut short")
        if (video.fps, video.image_size_wh) != (first.fps, first.image_size_wh):
            raise InputError(
                video.path, expected=f"{_kind(first)} as in {first.path.name}", found=_kind(video)
            )
    with encoded_video(path, _CODEC, first.fps, first.image_size_wh, _CODED) as encoder:
        for video in videos:
            _copy_packets(video, encoder)


def check_video_written(path: Path, temporary: Path, num_frames: int) -> None:
    """Check a finished video before it gets its name: FFmpeg reports no failed writes.

    Args:
        path: the video's final path, for the message.
        temporary: the video.
        num_frames: number of frames that were written.

    Raises:
        OutputError: a frame or the index of frames is missing, or there is no frame.
    """
    if not num_frames:
        raise OutputError(path, expected="at least one frame", found="0 written")
    # The header may count frames that are missing: count the frames themselves.
    found = len(packet_times(temporary))
    if found != num_frames or not _has_its_end(temporary):
        raise OutputError(
            path,
            expected=f"a file with {num_frames} frames",
            found=f"{found} written" if found != num_frames else "an incomplete index of frames",
            remedy="is the disk full? earlier results are unchanged",
        )


def _has_its_end(path: Path) -> bool:
    """Whether a file has the length that its parts state: boxes of MP4, or chunks of AVI, which are called `RIFF`.

    The index of frames is at the end.
    """
    is_mp4 = path.suffix.lower() == ".mp4"
    size, position = path.stat().st_size, 0
    with path.open("rb") as file:
        while position < size:
            file.seek(position)
            head = file.read(16)
            length = int.from_bytes(head[:4], "big") if is_mp4 else 8 + int.from_bytes(head[4:8], "little")
            if is_mp4 and length == 1:
                # A box above 4 GB states its length after its name.
                length = int.from_bytes(head[8:], "big")
            if length < 8 or (not is_mp4 and head[:4] != b"RIFF"):
                return False
            position += length
    return position == size


def _copy_packets(video: VideoInfo, encoder: VideoEncoder) -> None:
    with open_capture(video.path) as capture:
        capture.set(cv2.CAP_PROP_FORMAT, -1)
        for index in range(video.num_frames):
            there, packet = capture.read()
            if not there:
                raise TruncatedVideoError(video, index)
            encoder.write_encoded(packet, capture.get(cv2.CAP_PROP_LRF_HAS_KEY_FRAME))


def _kind(video: VideoInfo) -> str:
    return "{} x {} pixels at {:g} Hz".format(*video.image_size_wh, video.fps)
