"""Sightings: the places where cameras see something in each frame, as boxes of a detector or blobs of foreground.

Both kinds become the same arrays, from which the correspondence and the projection lines start.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from psotrack.geometry import Rig
from psotrack.recordings import Detections, Timeline
from psotrack.silhouettes import Exposures, Silhouettes, exposures_of, find_blobs
from psotrack.support import Report, no_progress

#: Standard deviation of a box's middle along each axis: a constant, pixels, plus a share of the box's mean side. It is
#: a first assumption; the agreement of several views shows the real value.
NOISE_PX, NOISE_SHARE = 1.0, 0.05
#: The same share for a box that the image's border cuts.
CUT_SHARE = 0.25
#: A box with an edge nearer to the image's border than this is taken as cut, pixels.
BORDER_PX = 1.5
#: Number of frames of silhouettes that are read together.
_CHUNK_FRAMES = 25

#: Frame, camera, middles, widths and heights, and whether the border cuts each box.
_Image = tuple[int, int, np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class CameraSightings:
    """Sightings of one frame in all cameras; NaN for no sighting.

    Attributes:
        centre_px: (cameras, boxes, 2), middles of the boxes, pixels.
        size_px: (cameras, boxes, 2), widths and heights, pixels.
        noise_px: (cameras, boxes), standard deviations of the middles along each axis, pixels.
        exposures: when the cameras' frames were exposed; None where all were exposed together.
    """

    centre_px: Float[np.ndarray, "cameras boxes 2"]
    size_px: Float[np.ndarray, "cameras boxes 2"]
    noise_px: Float[np.ndarray, "cameras boxes"]
    exposures: Exposures | None = None

    def largest(self, count: int) -> CameraSightings:
        """The largest sightings of each camera, at most `count` of each."""
        if self.noise_px.shape[1] <= count:
            return self
        area = np.where(np.isfinite(self.noise_px), self.size_px.prod(axis=-1), -1.0)
        kept = np.argsort(-area, axis=1, kind="stable")[:, :count]
        row = np.arange(len(kept))[:, None]
        return replace(
            self,
            centre_px=self.centre_px[row, kept],
            size_px=self.size_px[row, kept],
            noise_px=self.noise_px[row, kept],
        )

    def without(self, camera: Int[np.ndarray, "gone"], box: Int[np.ndarray, "gone"]) -> CameraSightings:
        """The sightings without some of them; the places of the others among the boxes stay.

        Args:
            camera, box: (gone,), cameras and boxes of the sightings to leave out.
        """
        centre_px, size_px, noise_px = self.centre_px.copy(), self.size_px.copy(), self.noise_px.copy()
        for values in (centre_px, size_px, noise_px):
            values[camera, box] = np.nan
        return replace(self, centre_px=centre_px, size_px=size_px, noise_px=noise_px)

    def grouped(self, box: Int[np.ndarray, "groups cameras"]) -> CameraSightings:
        """The sightings with groups in place of cameras, and cameras in place of boxes.

        Args:
            box: (groups, cameras), which of the camera's boxes is of the group; -1 for no sighting.
        """
        there, of = box >= 0, (np.arange(box.shape[1]), box)
        return CameraSightings(
            np.where(there[..., None], self.centre_px[of], np.nan),
            np.where(there[..., None], self.size_px[of], np.nan),
            np.where(there, self.noise_px[of], np.nan),
        )


@dataclass(frozen=True)
class Sightings:
    """Sightings in all frames of all cameras; NaN for no sighting.

    The axis of boxes is as long as the largest number of sightings in one image.

    Attributes:
        centre_px: (frames, cameras, boxes, 2), middles of the boxes, pixels; pixel centres are at whole numbers.
        size_px: (frames, cameras, boxes, 2), widths and heights, pixels.
        noise_px: (frames, cameras, boxes), standard deviations of the middles along each axis, pixels.
        exposures: when the frames were exposed; None where frame i of every camera is instant i.
    """

    centre_px: Float[np.ndarray, "frames cameras boxes 2"]
    size_px: Float[np.ndarray, "frames cameras boxes 2"]
    noise_px: Float[np.ndarray, "frames cameras boxes"]
    exposures: Exposures | None = None

    @property
    def num_frames(self) -> int:
        """Number of frames of the recording."""
        return len(self.centre_px)

    def at(self, frame: int) -> CameraSightings:
        """The sightings of one frame."""
        exposures = None if self.exposures is None else self.exposures[frame]
        return CameraSightings(self.centre_px[frame], self.size_px[frame], self.noise_px[frame], exposures)

    def in_frames(self, frames: Int[np.ndarray, "chosen"]) -> Sightings:
        """The sightings of some frames."""
        exposures = None if self.exposures is None else self.exposures[frames]
        return Sightings(self.centre_px[frames], self.size_px[frames], self.noise_px[frames], exposures)

    def at_instants(self, timeline: Timeline) -> Sightings:
        """These sightings with instants instead of frames: each camera shows its frame nearest to the instant.

        A camera without a frame at an instant has no sightings there. Where frame i of every camera is instant i, the
        sightings stay as they are.
        """
        if timeline.is_synchronous and timeline.num_instants == self.num_frames:
            return self
        cameras = np.arange(timeline.frame.shape[1])
        there = (timeline.frame >= 0) & (timeline.frame < self.num_frames)
        frame = np.where(there, timeline.frame, 0)
        centre_px, size_px, noise_px = (
            np.where(there.reshape(*there.shape, *[1] * (values.ndim - 2)), values[frame, cameras], np.nan)
            for values in (self.centre_px, self.size_px, self.noise_px)
        )
        return Sightings(centre_px, size_px, noise_px, exposures_of(timeline))


def from_detections(detections: Mapping[str, Detections], rig: Rig, num_frames: int) -> Sightings:
    """Make sightings from the boxes of a detector.

    Args:
        detections: detections by camera name; a camera without an entry has no sightings.
        rig: the cameras.
        num_frames: number of frames of the videos; detections in later frames are ignored.
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
                # Pixel centres are at whole numbers, so an edge at 0 is half a pixel before the first centre.
                cut = np.any((xyxy[:, :2] < BORDER_PX) | (xyxy[:, 2:] > width_height - BORDER_PX), axis=-1)
                images.append((frame, index, (xyxy[:, :2] + xyxy[:, 2:]) / 2 - 0.5, _sides(xyxy), cut))
    return _arrays(images, num_frames, len(rig))


def from_silhouettes(
    silhouettes: Silhouettes, report: Report = no_progress, *, first: int = 0, stop: int | None = None
) -> Sightings:
    """Make sightings from the blobs of foreground.

    Args:
        silhouettes: stored silhouettes of all cameras.
        report: receives the progress, in frames.
        first, stop: first frame, and frame before which to stop; None: all. The sightings begin with frame `first`.
    """
    stop = silhouettes.num_frames if stop is None else stop
    images: list[_Image] = []
    with report("blobs", stop - first) as advance:
        for begin in range(first, stop, _CHUNK_FRAMES):
            chunk = silhouettes.read(begin, min(begin + _CHUNK_FRAMES, stop))
            for frame, views in enumerate(chunk, begin - first):
                for camera, image in enumerate(views):
                    blobs = find_blobs(image, silhouettes.reduction, silhouettes.borders[camera])
                    images.append((frame, camera, blobs.centre_px, blobs.size_px, ~blobs.whole))
            advance(len(chunk))
    exposures = silhouettes.exposures
    return replace(
        _arrays(images, stop - first, len(silhouettes.cameras)),
        exposures=None if exposures is None else exposures[first:stop],
    )


def _runs(frame: np.ndarray) -> Iterable[tuple[int, int, int]]:
    """Frame numbers, each with the first row of the frame and the first row after the frame."""
    values, starts, counts = np.unique(frame, return_index=True, return_counts=True)
    return zip(values.tolist(), starts.tolist(), (starts + counts).tolist(), strict=True)


def _sides(xyxy: Float[np.ndarray, "boxes 4"]) -> Float[np.ndarray, "boxes 2"]:
    return xyxy[:, 2:] - xyxy[:, :2]


def _arrays(images: list[_Image], num_frames: int, num_cameras: int) -> Sightings:
    """Put the boxes of all images into arrays; the axis of boxes has at least one entry."""
    max_boxes = max([1, *(len(centre) for _, _, centre, _, _ in images)])
    shape = (num_frames, num_cameras, max_boxes)
    centre_px, size_px = np.full((2, *shape, 2), np.nan)
    noise_px = np.full(shape, np.nan)
    for frame, camera, centre, size, cut in images:
        rows = (frame, camera, slice(len(centre)))
        centre_px[rows], size_px[rows] = centre, size
        side_px = np.sqrt(size.prod(axis=-1))
        noise_px[rows] = NOISE_PX + np.where(cut, CUT_SHARE, NOISE_SHARE) * side_px
    return Sightings(centre_px, size_px, noise_px)
