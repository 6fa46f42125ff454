"""Reading of videos.

FFmpeg, inside OpenCV, decodes. What a header says of the number of frames and of their rate is an estimate in many
containers, so that the packets of a file, which hold one encoded frame each, are counted and their times are read.
Where the first of them are not the frames that FFmpeg shows, all frames are decoded and counted. The last frame is not
decoded for that: in many videos of H.264 all frames from the last key frame on, ten seconds of them, come before it.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
import os
import shlex
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from psotrack.errors import InputError, SettingsError, check_positive, system_errors
from psotrack.recordings.image_files import check_pixels, depth_of, read_image, silence_opencv
from psotrack.recordings.timing import MOST_INSTANTS, FrameTimes
from psotrack.support import check_kind, digest_file, digest_record

_Frame = UInt8[np.ndarray, "height width 3"]
_logger = logging.getLogger(__name__)
#: Largest number of images of which the depth is read.
_READ_IMAGES = 5
#: To reach a frame, OpenCV decodes from the last key frame that is at least this number of frames before it.
_SEEK_BEFORE = 17
#: Times nearer than this are one time: containers round to a millisecond.
_SAME_S = 2e-3
#: Number of first frames of which the times are compared with those of the packets.
_FIRST_FRAMES = 3
#: Time before the end in which frames that cannot be decoded show the picture before, seconds.
_END_S = 0.5
#: Number of packets in a row that cannot be decoded from which on a video is at its end: ten seconds at 30 Hz.
_FAILURES = 300
#: Sound in containers comes in blocks, of 46 ms at most in AAC of 22 kHz, and often ends after the pictures.
_SOUND_S = 0.05
#: Largest deviation of regular frames from their rate: in intervals, and half a tick of Matroska's clock, seconds.
_JITTER, _TICK_S = 0.1, 0.51e-3
#: Largest share by which the rate of a header differs from that of times which are rounded to a clock's ticks.
_SAME_RATE = 1e-3
#: Intervals between two frames from which on there is a gap; largest number of gaps that a message names.
_GAP, _SHOWN = 1.5, 3
#: Number of frames from which on a seek is faster than decoding: the usual distance of key frames.
_WORTH_SEEKING = 250


@dataclass(frozen=True)
class VideoInfo:
    """Properties of a video file, or of image files that are its frames.

    Attributes:
        path: path of the file; of the images' folder where the frames are image files.
        num_frames: number of frames, above 0; reduce it with `dataclasses.replace` to use only
            the first frames.
        fps: frames per second, as exact as in the container.
        image_size_wh: width and height of the frames in pixels.
        images: the image files that are the frames, in order; empty for a video file.
        depth_bits: number of bits that the values of images of 16 bits use; frames have the upper 8 of them.
        is_finished: False for a video whose program was stopped before it wrote the number of frames into the header,
            and the index with which frames are sought.
        is_timed: whether each frame that is decoded has the time of its packet, so that one that cannot be decoded is
            noticed; otherwise frames are only counted.
        times_s: time of each frame as the container states it, seconds from the start of the file, increasing; empty
            where frames come at `fps` from time 0.
    """

    path: Path
    num_frames: int
    fps: float
    image_size_wh: tuple[int, int]
    images: tuple[Path, ...] = ()
    depth_bits: int = 16
    is_finished: bool = True
    is_timed: bool = field(default=False, compare=False)
    times_s: tuple[float, ...] = ()

    def at_rate(self, fps: float) -> VideoInfo:
        """The same frames at a rate that somebody states instead of the file."""
        return replace(self, fps=fps, times_s=(), is_timed=False)


def probe(path: Path | str) -> VideoInfo:
    """Count the frames of a video, and read their times.

    Packets are read without decoding, which is as fast as reading the file; the first frames are decoded. The frames of
    a video that was not finished are counted without its last frame, because it may be incomplete.

    Raises:
        InputError: the file does not exist, is empty, is not a video, has no frames, or none that can be decoded.
    """
    path = Path(path)
    check_kind(path, "a video")
    with open_capture(path) as capture, silence_opencv():
        stated = round(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        fps = capture.get(cv2.CAP_PROP_FPS)
        codec = round(capture.get(cv2.CAP_PROP_FOURCC))
        width = round(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        height = round(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        check_pixels(path, width, height)
        times_s = packet_times(path)
        if not times_s:
            raise InputError(path, expected="a video with frames", found="no frames")
        first_s = list(itertools.islice(_grabbed_times(capture), _FIRST_FRAMES))
    if not first_s:
        raise _undecodable(path, len(times_s), codec)
    is_finished = stated >= 1
    # The first frame is that of the first packet, and each of the others that of a later one.
    apart_s = np.abs(np.subtract.outer(first_s, times_s))
    packet = apart_s.argmin(axis=1)
    is_timed = bool(packet[0] == 0 and (np.diff(packet) > 0).all() and (apart_s.min(axis=1) <= _SAME_S).all())
    if not is_finished:
        times_s = times_s[:-1]
    elif not is_timed:
        times_s, is_timed = _decoded_times(path, times_s)
    if not 1 <= len(times_s) <= MOST_INSTANTS:
        expected = f"a video of 1 to {MOST_INSTANTS} frames"
        raise InputError(path, expected=expected, found=f"{len(times_s)}")
    video = VideoInfo(path, len(times_s), fps, (width, height), is_finished=is_finished, is_timed=is_timed)
    video = _timed(video, np.array(times_s))
    end_s = video.times_s[-1] + 1 / video.fps if video.times_s else video.num_frames / video.fps
    if is_finished and fps > 0 and stated / fps - end_s > 1 / fps + _SOUND_S:
        _logger.warning(
            "%s: its header says %d frames until %.2f s, and the %d that can be decoded end at %.2f s: is it cut "
            "short? Where it was cut without encoding, or its sound is longer, nothing is missing",
            path, stated, stated / fps, video.num_frames, end_s,
        )  # fmt: skip
    return video


def _undecodable(path: Path, num_frames: int, codec: int) -> InputError:
    """Error of a video that FFmpeg opens, and of which it decodes nothing."""
    name = codec.to_bytes(4, "little").decode("latin-1")
    new = shlex.quote(f"{path.stem}_h264.mp4")
    return InputError(
        path,
        expected="a video that can be decoded",
        found=f"{num_frames} frames of the codec {name if name.isprintable() else codec}, of which none can be",
        remedy=f"if the file is whole, `ffmpeg -i {shlex.quote(path.name)} -c:v libx264 -crf 10 {new}` makes one",
    )


def packet_times(path: Path) -> list[float]:
    """Times of the encoded frames in a file, seconds, ascending; found without decoding, in microseconds per frame.

    A file that cannot be opened has none.
    """
    with contextlib.suppress(InputError), open_capture(path) as capture:
        capture.set(cv2.CAP_PROP_FORMAT, -1)
        return sorted(_grabbed_times(capture))
    return []


def _grab(capture: cv2.VideoCapture) -> bool:
    """Go on to the next frame that can be decoded; False at the end."""
    return any(capture.grab() for _ in range(_FAILURES))


def _grabbed_times(capture: cv2.VideoCapture) -> Iterator[float]:
    """Times of the frames, or of the packets, from here to the end, seconds."""
    while _grab(capture):
        yield capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3


def _decoded_times(path: Path, packets_s: list[float]) -> tuple[list[float], bool]:
    """Times of all frames that can be decoded, seconds, and whether each frame comes with its time."""
    with open_capture(path) as capture, silence_opencv():
        times_s = list(_grabbed_times(capture))
    # Some containers state no times, and frames that a codec has held back come without them.
    is_timed = bool((np.diff(times_s) > 0).all())
    return (packets_s if not is_timed and len(times_s) == len(packets_s) else times_s), is_timed


def _timed(video: VideoInfo, times_s: Float[np.ndarray, "frames"]) -> VideoInfo:
    """A video with the times of its frames, or with their rate where they come regularly."""
    if len(times_s) < 2 or not (np.diff(times_s) > 0).all():
        if not (math.isfinite(video.fps) and video.fps > 0):
            found = f"{video.fps:g} frames per second"
            raise InputError(video.path, expected="a video with a frame rate", found=found)
        return replace(video, is_timed=False)
    number, steps_s = np.arange(len(times_s)), np.diff(times_s)
    # Gaps are no part of the rate; the median alone would be a whole number of the clock's ticks.
    own_fps = 1 / float(steps_s[steps_s <= _GAP * np.median(steps_s)].mean())
    for fps in (video.fps, own_fps):
        if fps > 0 and (np.abs(times_s - number / fps) <= max(_JITTER / fps, _TICK_S)).all():
            return replace(video, fps=fps)
    fps = video.fps if abs(video.fps / own_fps - 1) < _SAME_RATE else own_fps
    return replace(video, fps=fps, times_s=tuple(times_s.tolist()))


def frame_times(video: VideoInfo, offset_s: float = 0.0) -> FrameTimes:
    """Times of a video's frames; a warning says where they are not regular.

    Args:
        video: the video.
        offset_s: time on the recording's clock at which the video begins, seconds.
    """
    if not video.times_s:
        return FrameTimes(video.num_frames, video.fps, offset_s)
    times_s = np.array(video.times_s[: video.num_frames])
    gaps_s = np.diff(times_s, prepend=min(0.0, times_s[0]))
    late = np.flatnonzero(gaps_s * video.fps > _GAP)
    shown = ", ".join(f"{gaps_s[frame]:.3g} s before frame {frame}" for frame in late[:_SHOWN])
    more = f" and {len(late) - _SHOWN} others" if len(late) > _SHOWN else ""
    _logger.warning(
        "%s: %s; the times that the file states for its frames are used",
        video.path,
        f"gap of {shown}{more}" if shown else f"frames at irregular times, not at {video.fps:g} Hz",
    )
    if len(times_s) < 2:
        return FrameTimes(len(times_s), video.fps, offset_s + float(times_s[0]))
    return replace(FrameTimes.listed(times_s + offset_s, video.path), fps=video.fps)


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
    video = VideoInfo(paths[0].parent, len(paths), fps, (width, height), paths, depth_of(read))
    _check_size(paths[-1], video, read_image(paths[-1]))
    return video


def digest_video(video: VideoInfo) -> str:
    """Digest of a video's content, as hexadecimal digits; of all its images where the frames are image files.

    Raises:
        InputError: a file cannot be read.
    """
    if not video.images:
        return digest_file(video.path, expected="a readable video")
    return digest_record([digest_file(path, expected="a readable image") for path in video.images])


def read_frames(video: VideoInfo, step: int = 1, *, into_one: bool = False) -> Iterator[_Frame]:
    """Yield frames 0, step, 2 step, ... below `video.num_frames`, in order: BGR, (height, width, 3), uint8.

    The codec must decode the frames in between, but they are not converted to BGR. A frame that cannot be decoded
    shows the picture before, also at the end of a file, if all but its last half second can be decoded.

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
    numbers = range(0, video.num_frames, step)
    return (frame for _, frame in _read(video, numbers, into_one=into_one))


def _number_at(video: VideoInfo, time_s: float) -> int:
    """Number of the frame that has a time, seconds; 0 where times say nothing."""
    if not video.is_timed:
        return 0
    return bisect_left(video.times_s, time_s - _SAME_S) if video.times_s else round(time_s * video.fps)


def read_frames_at(video: VideoInfo, numbers: Sequence[int]) -> Iterator[tuple[int, _Frame]]:
    """Yield chosen frames of a video and their numbers: BGR, (height, width, 3), uint8.

    Frames far ahead are sought, frames nearby are reached by decoding. Of a video that was not finished, which has no
    index, all frames up to the last chosen one are decoded.

    Args:
        video: the video.
        numbers: numbers of frames, ascending, below `video.num_frames`.

    Raises:
        InputError: the file ends or is damaged before a frame, or a frame has another size.
    """
    return _read(video, numbers, is_sparse=True)


def _read(
    video: VideoInfo, numbers: Sequence[int], *, into_one: bool = False, is_sparse: bool = False
) -> Iterator[tuple[int, _Frame]]:
    """Yield chosen frames and their numbers; of sparse ones, those far ahead are sought."""
    if video.images:
        for number in numbers:
            image = read_image(video.images[number], video.depth_bits)
            _check_size(video.images[number], video, image)
            yield number, image
        return
    frame: _Frame | None = None
    reached = -1
    with open_capture(video.path) as capture:
        for number in numbers:
            is_far = is_sparse and number - reached > _WORTH_SEEKING + 1
            if is_far and video.is_finished and not video.times_s:
                with silence_opencv():
                    if capture.set(cv2.CAP_PROP_POS_FRAMES, number):
                        reached = round(capture.get(cv2.CAP_PROP_POS_FRAMES)) - 1
            while reached < number:
                following = reached + 1
                if _grab(capture):
                    reached = max(following, _number_at(video, capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3))
                elif following and video.is_timed and video.num_frames - following <= _END_S * video.fps:
                    reached = video.num_frames
                else:
                    raise TruncatedVideoError(video, following)
            # Of a picture that cannot be decoded, the one before is near only if no frames are left out.
            if reached == number or frame is None or is_sparse:
                decoded, frame = capture.retrieve(frame if into_one else None)
                if not decoded:
                    raise TruncatedVideoError(video, number)
                _check_size(video.path, video, frame, f" in frame {number}")
            yield number, frame


def read_near(video: VideoInfo, places: Sequence[int]) -> Iterator[tuple[int, _Frame]]:
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


def _check_size(path: Path, video: VideoInfo, frame: _Frame, where: str = "") -> None:
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
    with system_errors(path, "a video"), path.open("rb") as file:
        if not file.read(1):
            raise InputError(path, expected="a video", found="an empty file")
    with silence_opencv():
        # As many threads as OpenCV may use: one in a worker process, so that processes do not compete for processors.
        threads = (cv2.CAP_PROP_N_THREADS, max(1, cv2.getNumThreads()))
        # An absolute path, because FFmpeg reads the text before a colon as a protocol.
        capture = cv2.VideoCapture(os.path.abspath(path), cv2.CAP_FFMPEG, threads)
    if not capture.isOpened():
        raise InputError(path, expected="a video", found="a file in which FFmpeg finds no pictures")
    try:
        yield capture
    finally:
        capture.release()


class TruncatedVideoError(InputError):
    """A frame of a video cannot be decoded, although the file has it.

    Attributes:
        video: the video.
        num_readable: number of frames that can be decoded.
    """

    def __init__(self, video: VideoInfo, num_readable: int) -> None:
        self.video, self.num_readable = video, num_readable
        whole = shlex.quote(video.path.name)
        new = shlex.quote(f"{video.path.stem}_h264.mp4")
        super().__init__(
            video.path,
            expected=f"{video.num_frames} frames",
            found=f"that only {num_readable} can be decoded: the file is damaged",
            remedy=f"copy it again; or `ffmpeg -i {whole} -c:v libx264 -crf 10 {new}` keeps what can be decoded",
        )

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self.video, self.num_readable)
