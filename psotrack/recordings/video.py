"""Reading of videos.

FFmpeg, inside OpenCV, decodes. FFmpeg trusts the header, and drops frames that it cannot decode; in this module either
is an error that names the file. Frame rates are as exact as in the container: 29 instead of 29.97 would lose a second
in half a minute.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from psotrack.errors import InputError, SettingsError, check_positive
from psotrack.recordings.image_files import check_pixels, depth_of, read_image
from psotrack.recordings.opencv_messages import silence_opencv
from psotrack.recordings.timing import MOST_INSTANTS
from psotrack.support import digest_file, digest_record

#: Largest number of images of which the depth is read.
_READ_IMAGES = 5
#: To reach a frame, OpenCV decodes from the last key frame that is at least this number of frames before it.
_SEEK_BEFORE = 17
#: Number of frames from which on a seek is faster than decoding: the usual distance of key frames.
_WORTH_SEEKING = 250


@dataclass(frozen=True)
class VideoInfo:
    """Properties of a video file, or of image files that are its frames.

    Attributes:
        path: path of the file; of the images' folder where the frames are image files.
        num_frames: number of frames according to the header, above 0; reduce it with `dataclasses.replace` to use only
            the first frames.
        fps: frames per second, as exact as in the container.
        image_size_wh: width and height of the frames in pixels.
        images: the image files that are the frames, in order; empty for a video file.
        depth_bits: number of bits that the values of images of 16 bits use; frames have the upper 8 of them.
        is_finished: False for a video whose program was stopped before it wrote the number of frames into the header,
            and the index with which frames are sought.
    """

    path: Path
    num_frames: int
    fps: float
    image_size_wh: tuple[int, int]
    images: tuple[Path, ...] = ()
    depth_bits: int = 16
    is_finished: bool = True


def probe(path: Path | str) -> VideoInfo:
    """Read the header of a video. No frame is decoded, so that only `read_frames` notices a file that is cut short.

    The frames of a video that was not finished are counted. Its last frame is not used, because it may be incomplete.

    Raises:
        InputError: the file does not exist, is empty, is not a video, or has no frames.
    """
    path = Path(path)
    with open_capture(path) as capture:
        num_frames = round(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        fps = capture.get(cv2.CAP_PROP_FPS)
        width = round(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        height = round(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
    check_pixels(path, width, height)
    is_finished = num_frames >= 1
    if not is_finished:
        num_frames = count_packets(path) - 1
    if num_frames < 1:
        raise InputError(path, expected="a video with frames", found="no frames")
    if num_frames > MOST_INSTANTS:
        expected = f"a video of at most {MOST_INSTANTS} frames"
        raise InputError(path, expected=expected, found=f"{num_frames} in its header")
    if not (math.isfinite(fps) and fps > 0):
        raise InputError(path, expected="a video with a frame rate", found=f"{fps:g} frames per second")
    return VideoInfo(path, num_frames, fps, (width, height), is_finished=is_finished)


def check_end(video: VideoInfo) -> None:
    """Raise `InputError` if a video has fewer frames than its header says, or its last image is no frame of it.

    The last frame is sought; only where it cannot be reached, the encoded frames are counted.
    """
    if video.images:
        path = video.images[video.num_frames - 1]
        _check_size(path, video, read_image(path))
        return
    with open_capture(video.path) as capture, silence_opencv():
        capture.set(cv2.CAP_PROP_POS_FRAMES, video.num_frames - 1)
        reached = capture.grab()
    if not reached and (count := count_packets(video.path)) < video.num_frames:
        raise TruncatedVideoError(video, count)


def probe_images(images: Sequence[Path | str], fps: float) -> VideoInfo:
    """A video whose frames are image files. Few images are read; `read_frames` notices bad other images.

    Args:
        images: at least one image file, in the order of the frames.
        fps: frames per second.

    Raises:
        InputError: one of the images that are read is no image.
        SettingsError: the rate is not above 0.
    """
    check_positive("fps", fps)
    paths = tuple(map(Path, images))
    height, width, _ = read_image(paths[0]).shape
    read = paths[:: max(1, -(-len(paths) // _READ_IMAGES))]
    return VideoInfo(paths[0].parent, len(paths), fps, (width, height), paths, depth_of(read))


def digest_video(video: VideoInfo) -> str:
    """Digest of a video's content, as hexadecimal digits; of all its images where the frames are image files.

    Raises:
        InputError: a file cannot be read.
    """
    if not video.images:
        return digest_file(video.path, expected="a readable video")
    return digest_record([digest_file(path, expected="a readable image") for path in video.images])


def read_frames(
    video: VideoInfo, step: int = 1, *, into_one: bool = False
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Yield frames 0, step, 2 step, ... below `video.num_frames`, in order: BGR, (height, width, 3), uint8.

    The codec must decode the frames in between, but they are not converted to BGR.

    Args:
        video: the video.
        step: distance between two frames.
        into_one: whether each frame of a video file is written over the one before, which is faster.

    Raises:
        InputError: the file ends or is damaged before its last frame, or a frame has another size.
        SettingsError: `step` is below 1.
    """
    if step < 1:
        raise SettingsError("step", expected="1 or more", found=f"{step}")
    if video.images:
        for path in video.images[: video.num_frames : step]:
            frame = read_image(path, video.depth_bits)
            _check_size(path, video, frame)
            yield frame
        return
    place: UInt8[np.ndarray, "height width 3"] | None = None
    with open_capture(video.path) as capture:
        for index in range(video.num_frames):
            if not capture.grab():
                raise TruncatedVideoError(video, index)
            if index % step:
                continue
            decoded, frame = capture.retrieve(place)
            place = frame if into_one else None
            if not decoded:
                raise TruncatedVideoError(video, index)
            _check_size(video.path, video, frame, f" in frame {index}")
            yield frame


def read_frames_at(
    video: VideoInfo, numbers: Sequence[int]
) -> Iterator[tuple[int, UInt8[np.ndarray, "height width 3"]]]:
    """Yield chosen frames of a video and their numbers: BGR, (height, width, 3), uint8.

    Frames far ahead are sought, frames nearby are reached by decoding. Of a video that was not finished, which has no
    index, all frames up to the last chosen one are decoded.

    Args:
        video: the video.
        numbers: numbers of frames, ascending, below `video.num_frames`.

    Raises:
        InputError: the file ends or is damaged before a frame, or a frame has another size.
    """
    if video.images:
        for number in numbers:
            frame = read_image(video.images[number], video.depth_bits)
            _check_size(video.images[number], video, frame)
            yield number, frame
        return
    following = 0
    with open_capture(video.path) as capture:
        for number in numbers:
            if number - following > _WORTH_SEEKING and video.is_finished:
                with silence_opencv():
                    if capture.set(cv2.CAP_PROP_POS_FRAMES, number):
                        following = round(capture.get(cv2.CAP_PROP_POS_FRAMES))
            while following <= number:
                if not capture.grab():
                    raise TruncatedVideoError(video, following)
                following += 1
            decoded, frame = capture.retrieve()
            if not decoded:
                raise TruncatedVideoError(video, number)
            _check_size(video.path, video, frame, f" in frame {number}")
            yield number, frame


def read_near(
    video: VideoInfo, places: Sequence[int]
) -> Iterator[tuple[int, UInt8[np.ndarray, "height width 3"]]]:
    """Yield frames near some places, and their numbers, without decoding the video up to there.

    A frame of a video file is one shortly after the key frame that is nearest to the place. Places with the same key
    frame yield one frame, so a video with few key frames yields few. A frame that cannot be decoded is left out, and so
    are all frames of a video that was not finished, because it has no index.

    Args:
        video: the video.
        places: numbers of frames, ascending.
    """
    if video.images:
        for place in places:
            yield place, read_image(video.images[place], video.depth_bits)
        return
    if not places or not video.is_finished:
        return
    key_frames = np.array(_key_frames(video))
    if not len(key_frames):
        return
    nearest = np.abs(key_frames + _SEEK_BEFORE - np.array(places)[:, None]).argmin(axis=1)
    with open_capture(video.path) as capture:
        for key_frame in np.unique(key_frames[nearest]).tolist():
            number = min(key_frame + _SEEK_BEFORE, video.num_frames - 1)
            with silence_opencv():
                capture.set(cv2.CAP_PROP_POS_FRAMES, number)
                decoded, frame = capture.read()
            if decoded and frame.shape[1::-1] == video.image_size_wh:
                yield number, frame


def _key_frames(video: VideoInfo) -> list[int]:
    """Numbers of the frames that can be decoded without others, found without decoding."""
    with open_capture(video.path) as capture:
        capture.set(cv2.CAP_PROP_FORMAT, -1)
        frames = itertools.takewhile(lambda index: capture.grab(), range(video.num_frames))
        return [index for index in frames if capture.get(cv2.CAP_PROP_LRF_HAS_KEY_FRAME)]


def _check_size(
    path: Path, video: VideoInfo, frame: UInt8[np.ndarray, "height width 3"], where: str = ""
) -> None:
    width, height = video.image_size_wh
    if frame.shape != (height, width, 3):
        expected = f"{width} x {height} pixels"
        if video.images:
            expected += f" as in {video.images[0].name}"
        raise InputError(path, expected=expected, found=f"{frame.shape[1]} x {frame.shape[0]}{where}")


@contextlib.contextmanager
def open_capture(path: Path) -> Iterator[cv2.VideoCapture]:
    """A video that FFmpeg has opened, without FFmpeg's messages; it is closed at the end of the block.

    Raises:
        InputError: the video cannot be opened.
    """
    try:
        with path.open("rb") as file:
            empty = not file.read(1)
    except OSError as error:
        raise InputError(path, expected="a video", found=(error.strerror or str(error)).lower()) from error
    if empty:
        raise InputError(path, expected="a video", found="an empty file")
    with silence_opencv():
        # As many threads as OpenCV may use: one in a worker process, so that processes do not compete for processors.
        threads = (cv2.CAP_PROP_N_THREADS, max(1, cv2.getNumThreads()))
        # An absolute path, because FFmpeg reads the text before a colon as a protocol.
        capture = cv2.VideoCapture(os.path.abspath(path), cv2.CAP_FFMPEG, threads)
    if not capture.isOpened():
        raise InputError(path, expected="a video", found="a file that FFmpeg cannot open")
    try:
        yield capture
    finally:
        capture.release()


def count_packets(path: Path) -> int:
    """Number of encoded frames in a file, counted without decoding: a few microseconds per frame."""
    with contextlib.suppress(InputError), open_capture(path) as capture:
        capture.set(cv2.CAP_PROP_FORMAT, -1)
        return sum(1 for _ in iter(capture.grab, False))
    return 0


class TruncatedVideoError(InputError):
    """A video has fewer frames that can be decoded than its header says.

    Attributes:
        video: the video.
        num_readable: number of frames that can be decoded.
        num_instants: number of instants of the recording in which these frames suffice.
    """

    def __init__(
        self, video: VideoInfo, num_readable: int, num_instants: int | None = None, way_on: str = ""
    ) -> None:
        self.video, self.num_readable = video, num_readable
        self.num_instants = num_readable if num_instants is None else num_instants
        self._way_on = way_on
        index = num_readable
        if not way_on and num_readable:
            whole = shlex.quote(video.path.name)
            cut = shlex.quote(f"{video.path.stem}_cut{video.path.suffix}")
            way_on = f"`ffmpeg -i {whole} -frames:v {num_readable} -c copy {cut}` keeps the frames before"
        super().__init__(
            video.path,
            expected=f"{video.num_frames} frames",
            found=f"that only {index} can be decoded (frame {index} is missing or broken)",
            remedy="copy it again" + (f"; if only its end is missing, {way_on}" if way_on else ""),
        )

    def with_way_on(self, way_on: str) -> TruncatedVideoError:
        """The same error, which says in other words how to go on with the frames before the missing end."""
        return TruncatedVideoError(self.video, self.num_readable, self.num_instants, way_on)

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self.video, self.num_readable, self.num_instants, self._way_on)
