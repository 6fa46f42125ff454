"""Where cameras see something, frame by frame: boxes of a detector, or blobs of foreground.

What the projection lines start from, in arrays, whatever it came from.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from psotrack.geometry import CameraRig
from psotrack.recordings import Detections
from psotrack.silhouettes import Silhouettes, find_blobs
from psotrack.support import Report, no_progress

#: The middle of a box is off by about a pixel, and by so much of its sides; what it really is, the views tell.
NOISE_PX, NOISE_SHARE = 1.0, 0.05
#: Of a box that the image's border cuts the middle is off by so much of its sides.
CUT_SHARE = 0.25
#: Boxes nearer to the border than this are cut by it.
BORDER_PX = 1.5
#: Silhouettes that are looked at together.
_CHUNK_FRAMES = 25

#: Frame, camera, middles, sides, and whether the border cuts the box.
_Image = tuple[int, int, np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class CameraSightings:
    """The sightings of one frame, in all cameras; NaN for none.

    Attributes:
        centre_px, size_px: (cameras, boxes, 2), middles and sides.
        noise_px: (cameras, boxes), standard deviations of the middles.
    """

    centre_px: Float[np.ndarray, "cameras boxes 2"]
    size_px: Float[np.ndarray, "cameras boxes 2"]
    noise_px: Float[np.ndarray, "cameras boxes"]

    def found(self, values: Float[np.ndarray, "cameras boxes *rest"]) -> list[np.ndarray]:
        """What is known of the sightings of each camera, without the gaps: (found, ...) each."""
        return [of[which] for of, which in zip(values, np.isfinite(self.noise_px), strict=True)]

    def grouped(
        self, values: Float[np.ndarray, "cameras boxes *rest"], detection: Int[np.ndarray, "groups cameras"]
    ) -> Float[np.ndarray, "groups cameras *rest"]:
        """What is known of the sightings of each group; NaN where a camera has none, which is -1.

        Args:
            values: of all boxes.
            detection: (groups, cameras), numbers of sightings, without the gaps.
        """
        padded = np.full((values.shape[0], values.shape[1] + 1, *values.shape[2:]), np.nan)
        for camera, found in enumerate(self.found(values)):
            padded[camera, : len(found)] = found
        return padded[np.arange(len(values)), detection]


@dataclass(frozen=True)
class Sightings:
    """Boxes in all frames of all cameras; the axis of boxes is as long as the fullest image needs.

    Attributes:
        centre_px: (frames, cameras, boxes, 2), middles, pixel centres at whole numbers; NaN for none.
        size_px: (frames, cameras, boxes, 2), widths and heights; NaN for none.
        noise_px: (frames, cameras, boxes), standard deviation of the middle along either axis; NaN for none.
    """

    centre_px: Float[np.ndarray, "frames cameras boxes 2"]
    size_px: Float[np.ndarray, "frames cameras boxes 2"]
    noise_px: Float[np.ndarray, "frames cameras boxes"]

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.centre_px)

    def at(self, frame: int) -> CameraSightings:
        """Those of a frame."""
        return CameraSightings(self.centre_px[frame], self.size_px[frame], self.noise_px[frame])


def from_detections(detections: Mapping[str, Detections], rig: CameraRig, num_frames: int) -> Sightings:
    """The boxes of a detector.

    Args:
        detections: by camera name; a camera that is absent sees nothing.
        rig: of the cameras.
        num_frames: of the videos; what was detected in later frames does not count.
    """
    images: list[_Image] = []
    for index, name in enumerate(rig.names):
        boxes = detections.get(name)
        if boxes is None:
            continue
        width_height = rig.cameras.image_size_wh[index]
        for frame, start, stop in _runs(boxes.frame):
            if 0 <= frame < num_frames:
                xyxy = boxes.xyxy[start:stop]
                # Pixels are squares about whole numbers: an edge at 0 is half a pixel before the first centre.
                cut = np.any((xyxy[:, :2] < BORDER_PX) | (xyxy[:, 2:] > width_height - BORDER_PX), axis=-1)
                images.append((frame, index, (xyxy[:, :2] + xyxy[:, 2:]) / 2 - 0.5, _sides(xyxy), cut))
    return _arrays(images, num_frames, len(rig))


def from_silhouettes(silhouettes: Silhouettes, report: Report = no_progress) -> Sightings:
    """The blobs of foreground.

    Args:
        silhouettes: of all cameras.
        report: told of the frames.
    """
    images: list[_Image] = []
    with report("blobs", silhouettes.num_frames) as advance:
        for first in range(0, silhouettes.num_frames, _CHUNK_FRAMES):
            chunk = silhouettes.read(first, min(first + _CHUNK_FRAMES, silhouettes.num_frames))
            for frame, views in enumerate(chunk, first):
                for camera, image in enumerate(views):
                    blobs = find_blobs(image, silhouettes.reduction)
                    images.append((frame, camera, blobs.centre_px, blobs.size_px, ~blobs.whole))
            advance(len(chunk))
    return _arrays(images, silhouettes.num_frames, len(silhouettes.cameras))


def _runs(frame: np.ndarray) -> Iterable[tuple[int, int, int]]:
    """Each frame number, the first row that has it, and the first one after them."""
    values, starts, counts = np.unique(frame, return_index=True, return_counts=True)
    return zip(values.tolist(), starts.tolist(), (starts + counts).tolist(), strict=True)


def _sides(xyxy: Float[np.ndarray, "boxes 4"]) -> Float[np.ndarray, "boxes 2"]:
    return xyxy[:, 2:] - xyxy[:, :2]


def _arrays(images: list[_Image], num_frames: int, num_cameras: int) -> Sightings:
    """The images' boxes in arrays, with room for one box at least."""
    most = max([1, *(len(centre) for _, _, centre, _, _ in images)])
    shape = (num_frames, num_cameras, most)
    centre_px, size_px = np.full((2, *shape, 2), np.nan)
    noise_px = np.full(shape, np.nan)
    for frame, camera, centre, size, cut in images:
        of = (frame, camera, slice(len(centre)))
        centre_px[of], size_px[of] = centre, size
        side_px = np.sqrt(size.prod(axis=-1))
        noise_px[of] = NOISE_PX + np.where(cut, CUT_SHARE, NOISE_SHARE) * side_px
    return Sightings(centre_px, size_px, noise_px)
