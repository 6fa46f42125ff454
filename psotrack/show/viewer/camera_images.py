"""Images of cameras as small JPEG files, with the silhouettes, blobs and markers that are drawn above them.

Rerun shows JPEG images in every viewer; videos need FFmpeg on the user's computer, and a video codec takes longer than
JPEG. Workers write the images of a camera one after the other into one file, so that an hour does not fill the memory.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8, UInt32

from psotrack.errors import OutputError
from psotrack.foreground.silhouettes import find_blobs
from psotrack.recordings import VideoInfo, read_frames
from psotrack.support import Advance, short_repr

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


@dataclass(frozen=True)
class EncodingTask:
    """Task of encoding the images of one video.

    Attributes:
        video: the video.
        path: file that the images are written to, one after the other.
        step, reduction: see `ImagePlan`.
        bytes_per_image: size that the images shall have on average, with their silhouettes.
        silhouettes: one of the `arrays` of `Silhouettes`, by frames; None where there are no silhouettes.
        cell_px: image pixels per pixel of the silhouettes, along each side.
        dictionary: dictionary of the markers that are looked for; None: none are.
    """

    video: VideoInfo
    path: Path
    step: int
    reduction: int
    bytes_per_image: float
    silhouettes: Any = None
    cell_px: int = 1
    dictionary: str | None = None


@dataclass(frozen=True, repr=False)
class EncodedImages:
    """Encoded images of one camera.

    Attributes:
        path: file of all images, one after the other: of each frame the JPEG image, then the PNG image of the
            silhouette.
        frame: (images,), numbers of the video's frames.
        sizes: (images, 2), bytes of the JPEG image and of the PNG image; 0 where there is no silhouette.
        blobs_px: boxes of each image's blobs, (blobs, 4), as in `geometry.boxes`.
        markers: ids of each image's markers, and their corners, (markers, 4, 2), pixel centres at whole numbers.
    """

    path: Path
    frame: Int[np.ndarray, " images"]
    sizes: Int[np.ndarray, "images 2"]
    blobs_px: tuple[Float[np.ndarray, "blobs 4"], ...]
    markers: tuple[tuple[Int[np.ndarray, " markers"], Float[np.ndarray, "markers 4 2"]], ...]

    __repr__ = short_repr


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


def encode_images(task: EncodingTask, advance: Advance) -> EncodedImages:
    """Encode the images of one video; the quality follows the size of the images so far.

    Raises:
        InputError: the video ends early.
        OutputError: the disk is full.
    """
    detector = None
    if task.dictionary is not None:
        from psotrack.inside_out.detection import MarkerDetector

        detector = MarkerDetector(task.dictionary)
    frames, sizes, blobs, markers = range(0, task.video.num_frames, task.step), [], [], []
    coverages = _read_coverages(task.silhouettes, frames)
    quality, written = _QUALITY, 0
    try:
        with task.path.open("wb") as file:
            for number, image in enumerate(read_frames(task.video, task.step, into_one=True), 1):
                jpeg, mask = _jpeg(_reduced(image, task.reduction), quality), b""
                if task.silhouettes is not None:
                    coverage = next(coverages)
                    mask = _silhouette_png(coverage)
                    blobs.append(_blob_boxes_px(coverage, task.cell_px))
                if detector is not None:
                    found = detector.detect(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8))
                    markers.append((found.ids, found.corners_px))
                file.write(jpeg + mask)
                sizes.append((len(jpeg), len(mask)))
                written += len(jpeg) + len(mask)
                planned = number * task.bytes_per_image
                change = _QUALITY_STEP * ((written < 0.98 * planned) - (written > planned))
                quality = int(np.clip(quality + change, _LEAST_QUALITY, _BEST_QUALITY))
                advance(1)
    except OSError as error:
        raise OutputError(
            task.path, expected="a file that can be written", found=error.strerror or f"{error}"
        ) from error
    return EncodedImages(
        task.path, np.array(frames), np.array(sizes).reshape(-1, 2), tuple(blobs), tuple(markers)
    )


def split_images(images: EncodedImages, chosen: Sequence[int]) -> list[tuple[bytes, bytes]]:
    """The JPEG and the PNG image of some of a camera's images."""
    ends = np.cumsum(images.sizes.sum(axis=1))
    found = []
    with images.path.open("rb") as file:
        for index in chosen:
            jpeg, mask = images.sizes[index].tolist()
            file.seek(int(ends[index]) - jpeg - mask)
            found.append((file.read(jpeg), file.read(mask)))
    return found


def _reduced(
    image: UInt8[np.ndarray, "height width 3"], reduction: int
) -> UInt8[np.ndarray, "rows columns 3"]:
    """An image of 1 / reduction of the width and height: means over squares, which OpenCV computes quickly."""
    if reduction == 1:
        return image
    height, width = (side // reduction for side in image.shape[:2])
    whole = image[: height * reduction, : width * reduction]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _jpeg(image: UInt8[np.ndarray, "height width 3"], quality: int) -> bytes:
    return cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, quality))[1].tobytes()


def _read_coverages(silhouettes: Any, frames: range) -> Iterator[UInt8[np.ndarray, "height width"]]:
    """Yield the silhouettes of some frames; frames that are compressed together are read together."""
    for first in range(0, 0 if silhouettes is None else silhouettes.shape[0], _READ_FRAMES):
        chunk = None
        for frame in range(first, min(first + _READ_FRAMES, frames.stop)):
            if frame in frames:
                chunk = np.asarray(silhouettes[first : first + _READ_FRAMES]) if chunk is None else chunk
                yield chunk[frame - first]


def _silhouette_png(coverage: UInt8[np.ndarray, "height width"]) -> bytes:
    """An image that is as opaque as a cell is covered."""
    # Pixels of four bytes as one number each, which NumPy looks up quickly.
    bgra = _silhouette_colours()[coverage].view(np.uint8).reshape(*coverage.shape, 4)
    return cv2.imencode(".png", bgra, _PNG)[1].tobytes()


@functools.cache
def _silhouette_colours() -> UInt32[np.ndarray, "256"]:
    """Blue, green, red and opacity of each coverage; without colour where nothing is covered."""
    table = np.zeros((256, 4), np.uint8)
    table[1:, :3] = _SILHOUETTE_BGR
    table[:, 3] = np.arange(256) * _OPACITY
    return table.view(np.uint32).ravel()


def _blob_boxes_px(coverage: UInt8[np.ndarray, "height width"], cell_px: int) -> Float[np.ndarray, "blobs 4"]:
    height, width = coverage.shape
    blobs = find_blobs(coverage, cell_px, np.array([width, height]))
    half_px = blobs.size_px / 2
    # Pixel centres are at whole numbers, so that the edges of a box are half a pixel further.
    return np.hstack([blobs.centre_px - half_px, blobs.centre_px + half_px]) + 0.5
