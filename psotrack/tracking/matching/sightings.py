"""Sightings: the places where cameras see something in each frame, as boxes of a detector or blobs of foreground.

Both kinds become the same arrays, from which the correspondence and the projection lines start.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.foreground.silhouettes import Exposures, Silhouettes, exposures_of, find_blobs
from psotrack.geometry import NEAR_M, Camera, Rig, project
from psotrack.recordings import Detections, Timeline
from psotrack.support import Report, no_progress

#: Standard deviation of a box's middle along each axis: a constant, pixels, plus a share of the box's mean side. It is
#: a first assumption; the agreement of several views shows the real value.
NOISE_PX, NOISE_SHARE = 1.0, 0.05
#: The same share for a box that the image's border cuts.
CUT_SHARE = 0.25
#: A box with an edge nearer to the image's border than this is taken as cut, pixels.
BORDER_PX = 1.5
#: Number of frames of silhouettes that are read together: as many as are stored together.
_CHUNK_FRAMES = 25

#: Images, middles, widths and heights of boxes, and whether each holds only a part.
_Rows = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Sightings:
    """Sightings of one frame, or of several frames, in all cameras; NaN for no sighting.

    The axis of boxes is as long as the largest number of sightings in one image. One frame has no axis of frames.

    Attributes:
        centre_px: (frames, cameras, boxes, 2), middles of the boxes, pixels; pixel centres are at whole numbers.
        size_px: (frames, cameras, boxes, 2), widths and heights, pixels.
        noise_px: (frames, cameras, boxes), standard deviations of the middles along each axis, pixels.
        exposures: when the frames were exposed; None where frame i of every camera is instant i.
    """

    centre_px: Float[np.ndarray, "*frames cameras boxes 2"]
    size_px: Float[np.ndarray, "*frames cameras boxes 2"]
    noise_px: Float[np.ndarray, "*frames cameras boxes"]
    exposures: Exposures | None = None

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.centre_px)

    def __getitem__(self, frames: int | slice | Int[np.ndarray, "chosen"]) -> Sightings:
        """The sightings of one frame, or of some."""
        exposures = None if self.exposures is None else self.exposures[frames]
        return self.with_arrays(lambda values: values[frames], exposures)

    def with_arrays(
        self, change: Callable[[np.ndarray], np.ndarray], exposures: Exposures | None
    ) -> Sightings:
        """Sightings whose arrays are `change(array)` for each array of these."""
        return Sightings(change(self.centre_px), change(self.size_px), change(self.noise_px), exposures)

    def at_instants(self, timeline: Timeline) -> Sightings:
        """These sightings with instants instead of frames: each camera shows its frame nearest to the instant.

        A camera without a frame at an instant has no sightings there. Where frame i of every camera is instant i, the
        sightings stay as they are.
        """
        if timeline.is_synchronous and timeline.num_instants == self.num_frames:
            return self
        there = (timeline.frame >= 0) & (timeline.frame < self.num_frames)
        shown = np.where(there, timeline.frame, 0), np.arange(timeline.frame.shape[1])
        return self.with_arrays(lambda values: _where(there, values[shown]), exposures_of(timeline))

    def largest(self, count: int) -> Sightings:
        """The largest sightings of each camera in one frame, at most `count` of each."""
        if self.noise_px.shape[1] <= count:
            return self
        area = np.where(np.isfinite(self.noise_px), self.size_px.prod(axis=-1), -1.0)
        kept = np.argsort(-area, axis=1, kind="stable")[:, :count]
        row = np.arange(len(kept))[:, None]
        return self.with_arrays(lambda values: values[row, kept], self.exposures)

    def where(self, kept: Bool[np.ndarray, "*frames cameras boxes"]) -> Sightings:
        """The sightings for which `kept` is True; their places among the boxes stay."""
        return self.with_arrays(lambda values: _where(kept, values), self.exposures)

    def grouped(self, box: Int[np.ndarray, "groups cameras"]) -> Sightings:
        """The sightings of one frame with groups in place of cameras, and cameras in place of boxes.

        Args:
            box: (groups, cameras), which of the camera's boxes is of the group; -1 for no sighting.
        """
        return self.with_arrays(lambda values: _where(box >= 0, values[np.arange(box.shape[1]), box]), None)

    def ungrouped(self, box: Int[np.ndarray, "groups cameras"]) -> Sightings:
        """The sightings of one frame that are in no group; `box` as in `grouped`."""
        grouped = (np.arange(self.noise_px.shape[1]) == box[..., None]).any(axis=0)
        return self.where(~grouped)


def _where(there: Bool[np.ndarray, "*some"], values: np.ndarray) -> np.ndarray:
    """Values (*some, ...), NaN where there are none."""
    return np.where(there.reshape(*there.shape, *[1] * (values.ndim - there.ndim)), values, np.nan)


def from_boxes(
    image: Int[np.ndarray, "rows"],
    centre_px: Float[np.ndarray, "rows 2"],
    size_px: Float[np.ndarray, "rows 2"],
    is_part: Bool[np.ndarray, "rows"],
    num_frames: int,
    num_cameras: int,
    exposures: Exposures | None = None,
) -> Sightings:
    """Make sightings from a list of boxes.

    Args:
        image: (rows,), number of the image in which the box is: frame * `num_cameras` + camera.
        centre_px, size_px: (rows, 2), as in `Sightings`.
        is_part: (rows,), whether the image's border, or something else, cuts what is in the box.
        num_frames, num_cameras: numbers of frames and of cameras.
        exposures: as in `Sightings`.
    """
    noise_px = NOISE_PX + np.where(is_part, CUT_SHARE, NOISE_SHARE) * np.sqrt(size_px.prod(axis=-1))

    def arranged(values: np.ndarray) -> np.ndarray:
        by_number = by_image(image, values, num_frames * num_cameras)
        return by_number.reshape(num_frames, num_cameras, *by_number.shape[1:])

    return Sightings(arranged(centre_px), arranged(size_px), arranged(noise_px), exposures)


def by_image(
    image: Int[np.ndarray, "rows"], values: Float[np.ndarray, "rows *rest"], num_images: int
) -> Float[np.ndarray, "images boxes *rest"]:
    """Arrange the rows of a list by image; NaN where an image has no more. The axis of boxes has at least one entry."""
    order = np.argsort(image, kind="stable")
    row = image[order]
    place = np.arange(len(row)) - np.searchsorted(row, row)
    arranged = np.full((num_images, int(place.max(initial=0)) + 1, *values.shape[1:]), np.nan)
    arranged[row, place] = values[order]
    return arranged


def from_detections(detections: Mapping[str, Detections], rig: Rig, num_frames: int) -> Sightings:
    """Make sightings from the boxes of a detector.

    Args:
        detections: detections by camera name; a camera without an entry has no sightings.
        rig: the cameras.
        num_frames: number of frames of the videos; detections in later frames are ignored.
    """
    rows: list[_Rows] = []
    for index, name in enumerate(rig.names):
        if name in detections:
            boxes = detections[name]
            used = (boxes.frame >= 0) & (boxes.frame < num_frames)
            low, high = boxes.xyxy[used, :2], boxes.xyxy[used, 2:]
            # Pixel centres are at whole numbers, so an edge at 0 is half a pixel before the first centre.
            width_height = rig.cameras.image_size_wh[index]
            cut = np.any((low < BORDER_PX) | (high > width_height - BORDER_PX), axis=-1)
            rows.append((boxes.frame[used] * len(rig) + index, (low + high) / 2 - 0.5, high - low, cut))
    return from_boxes(*_joined(rows), num_frames, len(rig))


def from_silhouettes(
    silhouettes: Silhouettes,
    report: Report = no_progress,
    *,
    frames: Int[np.ndarray, "chosen"] | None = None,
) -> Sightings:
    """Make sightings from the blobs of foreground.

    Args:
        silhouettes: stored silhouettes of all cameras.
        report: receives the progress, in frames.
        frames: (chosen,), numbers of the frames of which sightings are made, in ascending order; None: all.
    """
    frames = np.arange(silhouettes.num_frames) if frames is None else frames
    num_cameras, borders, rows = len(silhouettes.cameras), silhouettes.borders, list[_Rows]()
    with report("blobs", len(frames)) as advance:
        for begin in range(0, silhouettes.num_frames, _CHUNK_FRAMES):
            numbers = np.flatnonzero((frames >= begin) & (frames < begin + _CHUNK_FRAMES))
            if not len(numbers):
                continue
            first, last = frames[numbers[[0, -1]]].tolist()
            chunk = silhouettes.read(first, last + 1)
            for number, frame in zip(numbers.tolist(), frames[numbers].tolist(), strict=True):
                for camera, cells in enumerate(chunk[frame - first]):
                    blobs = find_blobs(cells, silhouettes.reduction, borders[camera])
                    image = np.full(len(blobs.whole), number * num_cameras + camera)
                    rows.append((image, blobs.centre_px, blobs.size_px, ~blobs.whole))
            advance(len(numbers))
    exposures = None if silhouettes.exposures is None else silhouettes.exposures[frames]
    return from_boxes(*_joined(rows), len(frames), num_cameras, exposures)


def _joined(rows: list[_Rows]) -> _Rows:
    none = np.empty(0, int), np.empty((0, 2)), np.empty((0, 2)), np.empty(0, bool)
    image, centre_px, size_px, is_part = (np.concatenate(parts) for parts in zip(none, *rows, strict=True))
    return image, centre_px, size_px, is_part


#: A detection is moved with the drone whose expected box, this many times larger, holds its middle.
_REACH = 1.5


def moved_to_instant(
    cameras: Camera,
    view: Sightings,
    expected_m: Float[np.ndarray, "drones 3"],
    velocity_m_s: Float[np.ndarray, "drones 3"],
    velocity_covariance: Float[np.ndarray, "drones 3 3"],
    unknown_std_m_s: float,
) -> Sightings:
    """The detections as they would be if all frames had been exposed at the instant.

    A detection near an expected drone is moved by the drone's motion in the image between exposure and instant, and is
    less certain by the error of the velocity. Any other detection stays and is less certain by the motion of a drone
    of unknown velocity.

    Args:
        cameras: cameras with one leading axis.
        view: detections of the frames, and when the frames were exposed.
        expected_m, velocity_m_s: (drones, 3), expected positions at the instant, metres, and velocities, m/s.
        velocity_covariance: (drones, 3, 3), covariances of the velocities, m²/s².
        unknown_std_m_s: standard deviation of the velocity of a drone that is not expected.
    """
    if view.exposures is None:
        return view
    offset_s, line_time_s = (
        np.asarray(value, np.float64) for value in (view.exposures.offset_s, view.exposures.line_time_s)
    )
    focal_px = np.sqrt(np.abs(cameras.K[:, 0, 0] * cameras.K[:, 1, 1]))
    # Distance of a drone that is not expected: that of the point at which the cameras look, roughly.
    centre_m = cameras.centre_world
    usual_m = np.linalg.norm(centre_m - centre_m.mean(axis=0), axis=-1).max(initial=1.0)
    noise_px = np.hypot(view.noise_px, (unknown_std_m_s * focal_px * np.abs(offset_s) / usual_m)[:, None])
    if not len(expected_m):
        return replace(view, noise_px=noise_px)
    at_instant, depth = project(cameras, np.repeat(expected_m[:, None], len(offset_s), axis=1))
    height_px = np.asarray(cameras.image_size_wh, np.float64)[:, 1]
    row_px = np.clip(at_instant[..., 1], 0, height_px) - height_px / 2
    own_s = offset_s + line_time_s * row_px
    at_exposure, _ = project(cameras, expected_m[:, None] + velocity_m_s[:, None] * own_s[..., None])
    # (drones, cameras, boxes): distance in half sides of the box.
    off = np.abs(at_exposure[:, :, None] - view.centre_px) / (view.size_px / 2)
    off = np.where((depth > NEAR_M)[..., None], off.max(axis=-1), np.inf)
    off = np.where(np.isfinite(off), off, np.inf)
    drone = off.argmin(axis=0)
    near = off.min(axis=0) <= _REACH
    camera = np.arange(len(offset_s))[:, None]
    moved_px = (at_instant - at_exposure)[drone, camera]
    variance = np.maximum(velocity_covariance.trace(axis1=-2, axis2=-1) / 3, 0.0)
    error_px = np.sqrt(variance)[drone] * (focal_px * np.abs(offset_s))[:, None] / depth[drone, camera]
    return replace(
        view,
        centre_px=np.where(near[..., None], view.centre_px + moved_px, view.centre_px),
        noise_px=np.where(near, np.hypot(view.noise_px, error_px), noise_px),
    )
