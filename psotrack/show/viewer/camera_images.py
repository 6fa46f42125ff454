"""Images of cameras as small JPEG files, with the silhouettes, blobs and markers that are drawn above them.

Rerun shows JPEG images in every viewer; videos need FFmpeg on the user's computer, and a video codec takes longer than
JPEG. Images are made one after the other, so that an hour does not fill the memory.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from psotrack.foreground.silhouettes import (
    Silhouettes,
    SilhouetteSettings,
    compute,
    find_blobs,
    stored_silhouettes,
)
from psotrack.recordings import VideoInfo, read_frames
from psotrack.show.flights import TrackedFlight
from psotrack.support import Report, convert, no_progress

_Coverage = UInt8[np.ndarray, "height width"]
_Image = UInt8[np.ndarray, "height width 3"]
#: Quality of JPEG with which the size of images is planned, and its limits while images are written.
_QUALITY, _LEAST_QUALITY, _BEST_QUALITY = 75, 20, 90
#: Change of the quality from image to image, where the images so far are larger or smaller than planned.
_QUALITY_STEP = 2
#: Images are not made narrower than this, pixels; then frames are left out.
_LEAST_WIDTH_PX = 480
#: Colour (BGR) and opacity of whole coverage in the images of silhouettes.
_SILHOUETTE_BGR, _OPACITY = (0, 255, 170), 0.55
#: Number of silhouettes that are read together.
_READ_FRAMES = 25
#: Of all settings of PNG these compress silhouettes the most, and the fastest.
_PNG = (
    *(cv2.IMWRITE_PNG_COMPRESSION, 1),
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE),
)


@dataclass(frozen=True)
class CameraKey:
    """A camera: of the rig, or on a drone.

    Attributes:
        name: name of the camera of the rig, or of the drone.
        on_drone: whether the camera is on a drone.
    """

    name: str
    on_drone: bool = False


@dataclass(frozen=True)
class ImagePlan:
    """How the images of a flight are reduced.

    Attributes:
        step: each frame whose number is a multiple of it is shown.
        reduction: image pixels per shown pixel along each side, by camera.
        num_images: number of images of all cameras.
    """

    step: int
    reduction: Mapping[CameraKey, int]
    num_images: int


@dataclass(frozen=True, eq=False)
class ImageSource:
    """Where the images of one camera come from, and how they are encoded.

    Attributes:
        video: the video.
        step, reduction: see `ImagePlan`.
        bytes_per_image: size that the images shall have on average, with their silhouettes.
        silhouettes: one of the `arrays` of `Silhouettes`, by frames; None where there are no silhouettes.
        cell_px: image pixels per pixel of the silhouettes, along each side.
        dictionary: dictionary of the markers that are looked for; None: none are.
    """

    video: VideoInfo
    step: int
    reduction: int
    bytes_per_image: float
    silhouettes: Any = None
    cell_px: int = 1
    dictionary: str | None = None


@dataclass(frozen=True, eq=False)
class EncodedImage:
    """An encoded frame of a camera, and what was found in it.

    Attributes:
        frame: number of the frame.
        jpeg: the image.
        silhouette: PNG image of the silhouette; empty where there is none.
        blobs_px: boxes of the blobs, as in `geometry.boxes`.
        marker_ids: ids of the markers.
        marker_corners_px: their corners, pixel centres at whole numbers.
    """

    frame: int
    jpeg: bytes
    silhouette: bytes
    blobs_px: Float[np.ndarray, "blobs 4"]
    marker_ids: Int[np.ndarray, " markers"]
    marker_corners_px: Float[np.ndarray, "markers 4 2"]


def plan_images(videos: Mapping[CameraKey, VideoInfo], max_bytes: float) -> ImagePlan:
    """Size and number of images that fit into a number of bytes, from the first frame of each video.

    Images get smaller first, to a third or so of their width; then frames are left out.

    Args:
        videos: the videos.
        max_bytes: bytes of all images.

    Raises:
        InputError: a video cannot be read.
    """
    first = {name: next(read_frames(video)) for name, video in videos.items()}
    largest = {name: max(1, max(video.image_size_wh) // _LEAST_WIDTH_PX) for name, video in videos.items()}
    for limit in range(1, max(largest.values(), default=1) + 1):
        reduction = {name: min(limit, largest[name]) for name in videos}
        of_one = {name: len(_jpeg(_reduced(first[name], reduction[name]), _QUALITY)) for name in videos}
        total = sum(of_one[name] * video.num_frames for name, video in videos.items())
        if total <= max_bytes:
            break
    step = max(1, int(np.ceil(total / max(max_bytes, 1.0)))) if videos else 1
    return ImagePlan(step, reduction, sum(len(range(0, each.num_frames, step)) for each in videos.values()))


def encode_images(source: ImageSource) -> Iterator[EncodedImage]:
    """Encode the images of one video; the quality follows the size of the images so far.

    Raises:
        InputError: the video ends early.
    """
    detector = None
    if source.dictionary is not None:
        from psotrack.foreground.markers import MarkerDetector

        detector = MarkerDetector(source.dictionary)
    coverages = _read_coverages(source.silhouettes, range(0, source.video.num_frames, source.step))
    quality, written = _QUALITY, 0
    for number, image in enumerate(read_frames(source.video, source.step, into_one=True)):
        jpeg, silhouette, blobs_px = _jpeg(_reduced(image, source.reduction), quality), b"", np.zeros((0, 4))
        if source.silhouettes is not None:
            coverage = next(coverages)
            silhouette, blobs_px = _silhouette_png(coverage), _blob_boxes_px(coverage, source.cell_px)
        ids, corners_px = np.zeros(0, int), np.zeros((0, 4, 2))
        if detector is not None:
            found = detector.detect(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8))
            ids, corners_px = found.ids, found.corners_px
        yield EncodedImage(number * source.step, jpeg, silhouette, blobs_px, ids, corners_px)
        written += len(jpeg) + len(silhouette)
        planned = (number + 1) * source.bytes_per_image
        change = _QUALITY_STEP * ((written < 0.98 * planned) - (written > planned))
        quality = int(np.clip(quality + change, _LEAST_QUALITY, _BEST_QUALITY))


def _reduced(image: _Image, reduction: int) -> UInt8[np.ndarray, "rows columns 3"]:
    """An image of 1 / reduction of the width and height: means over squares, which OpenCV computes quickly."""
    if reduction == 1:
        return image
    height, width = (side // reduction for side in image.shape[:2])
    whole = image[: height * reduction, : width * reduction]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _jpeg(image: _Image, quality: int) -> bytes:
    return cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, quality))[1].tobytes()


def _read_coverages(silhouettes: Any, frames: range) -> Iterator[_Coverage]:
    """Yield the silhouettes of some frames; frames that are compressed together are read together."""
    for first in range(0, 0 if silhouettes is None else silhouettes.shape[0], _READ_FRAMES):
        chunk = None
        for frame in range(first, min(first + _READ_FRAMES, frames.stop)):
            if frame in frames:
                chunk = np.asarray(silhouettes[first : first + _READ_FRAMES]) if chunk is None else chunk
                yield chunk[frame - first]


def _silhouette_png(coverage: _Coverage) -> bytes:
    """An image that is as opaque as a cell is covered, and without colour where nothing is."""
    bgra = np.zeros((*coverage.shape, 4), np.uint8)
    bgra[coverage > 0, :3] = _SILHOUETTE_BGR
    bgra[..., 3] = coverage * _OPACITY
    return cv2.imencode(".png", bgra, _PNG)[1].tobytes()


def _blob_boxes_px(coverage: _Coverage, cell_px: int) -> Float[np.ndarray, "blobs 4"]:
    height, width = coverage.shape
    blobs = find_blobs(coverage, cell_px, np.array([width, height]))
    half_px = blobs.size_px / 2
    # Pixel centres are at whole numbers, so that the edges of a box are half a pixel further.
    return np.hstack([blobs.centre_px - half_px, blobs.centre_px + half_px]) + 0.5


def find_silhouettes(
    flight: TrackedFlight,
    cache: Path,
    *,
    make: bool = False,
    jobs: int | None = None,
    report: Report = no_progress,
) -> Silhouettes | None:
    """The silhouettes of a flight's cameras by frames; None where they are not stored, or no camera has a video.

    Args:
        flight: the flight; the settings of the silhouettes are those of its first tracks.
        cache: folder of the store.
        make: whether silhouettes that are not stored are computed.
        jobs: largest number of processes; None is one per processor.
        report: progress.

    Raises:
        InputError: a video cannot be read, or the record of the tracks has settings that cannot be read.
    """
    if flight.recording is None or not flight.recording.videos:
        return None
    settings = _settings(flight)
    recording = flight.recording.usable(videos=False)
    stored = stored_silhouettes(recording, settings, cache).values()
    if not make and not all(each.path.exists() for each in stored):
        return None
    return compute(recording, settings, cache=cache, jobs=jobs, all_videos=False, report=report)


def _settings(flight: TrackedFlight) -> SilhouetteSettings:
    """The settings of the first tracks with a record of them, else the defaults."""
    for tracks in flight.tracks:
        if tracks.record is not None and "silhouettes" in tracks.record.settings:
            where = f"{tracks.path.with_suffix('.json')}, settings.silhouettes."
            return convert(tracks.record.settings["silhouettes"], SilhouetteSettings, where)
    return SilhouetteSettings()
