"""Points that several cameras see, matched so loosely that a camera that is a little wrong still takes part.

A fault must not decide which sightings belong together, or sightings of a camera with a fault would be lost. Boxes that
the image's border cuts, and boxes that two points share, show no single body and are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from psotrack.geometry import Rig, to_camera, triangulate_linearly, viewpoints
from psotrack.geometry.estimation import cauchy_weight
from psotrack.tracking.camera_errors import Knock
from psotrack.tracking.matching import BORDER_PX, Sightings, are_near, by_image, match

#: Standard deviation of the direction of a camera's rays that a fault may cause, degrees.
LOOSE_DEG = 0.7
#: Longest way of a body between two frames, as a fraction of its distance from the nearest camera.
_STEP = 0.06
#: Largest number of frames of a piece of a path: the errors of boxes change with the attitude.
_BLOCK_FRAMES = 15
#: Smallest number of points of a piece of a path.
_MIN_PIECE = 4
#: Three viewpoints must agree where this share of the frames that two of them see is seen by three.
_SEEN_BY_THREE = 0.3


@dataclass(frozen=True)
class CommonPoints:
    """Points of a few runs of consecutive frames, linked to pieces of paths.

    Attributes:
        frame: (points,), number of each point's frame.
        piece: (points,), number of each point's piece of a path, from 0 without gaps.
        start_m: (points, 3), positions in the world by the rig as it was read, metres.
        velocity_m: (points, 3), metres per frame.
        centre_px: (points, cameras, 2), middles of boxes, pixels; NaN for no sighting.
        side_px: (points, cameras), mean sides of boxes, pixels; NaN for no sighting.
        offset_frames: (points, cameras), time of the camera's frame minus time of the point's frame, frames.
        information: (points, cameras), part of a sighting's information that this point may use: a slow camera shows
            one frame at several instants.
        share: (cameras,), fraction of each camera's sightings that are matched.
        viewpoints: smallest number of viewpoints of a point.
    """

    frame: Int[np.ndarray, "points"]
    piece: Int[np.ndarray, "points"]
    start_m: Float[np.ndarray, "points 3"]
    velocity_m: Float[np.ndarray, "points 3"]
    centre_px: Float[np.ndarray, "points cameras 2"]
    side_px: Float[np.ndarray, "points cameras"]
    offset_frames: Float[np.ndarray, "points cameras"]
    information: Float[np.ndarray, "points cameras"]
    share: Float[np.ndarray, "cameras"]
    viewpoints: int = 3

    @property
    def seen(self) -> Bool[np.ndarray, "points cameras"]:
        """(points, cameras), True where a camera sees a point."""
        return np.isfinite(self.side_px)


@dataclass(frozen=True)
class ExaminedFrames:
    """What is examined.

    Attributes:
        sightings: sightings of a rig's cameras.
        frames: (chosen,), numbers of the frames to examine.
        bounds_m: (2, 3), corners of the region where bodies can be, metres.
        fps: frames (instants) per second.
    """

    sightings: Sightings
    frames: Int[np.ndarray, "chosen"]
    bounds_m: Float[np.ndarray, "2 3"]
    fps: float

    @property
    def count(self) -> Int[np.ndarray, "cameras"]:
        """(cameras,), numbers of sightings."""
        return np.isfinite(self.sightings.noise_px[self.frames]).sum(axis=(0, 2))

    def viewpoints(self, rig: Rig) -> int:
        """Smallest number of viewpoints of a point: three where three see enough, because two agree by chance."""
        seen = np.isfinite(self.sightings.noise_px[self.frames]).any(axis=-1)
        together = _count_viewpoints(rig, seen)
        return 3 if (together >= 3).sum() > _SEEN_BY_THREE * (together >= 2).sum() else 2

    def by(self, index: list[int]) -> ExaminedFrames:
        """What some of the cameras see."""
        exposures = self.sightings.exposures
        chosen = None if exposures is None else exposures.of_cameras(np.array(index))
        return replace(self, sightings=self.sightings.with_arrays(lambda values: values[:, index], chosen))

    def without(self, knock: Knock) -> ExaminedFrames:
        """What is seen before a camera was knocked, and by the others then."""
        kept = np.ones(self.sightings.noise_px.shape, bool)
        kept[knock.frame :, knock.camera] = False
        return replace(self, sightings=self.sightings.where(kept))

    def matched(
        self, rig: Rig, loose_deg: float = 0.0
    ) -> tuple[Int[np.ndarray, "groups"], Int[np.ndarray, "groups cameras"], Float[np.ndarray, "groups 3"]]:
        """Groups of sightings that may show one body: frames, indices of the sightings, -1 for none, and positions.

        Args:
            rig: the cameras.
            loose_deg: standard deviation of the direction of rays that a fault may cause, degrees.
        """
        loose_px = np.tan(np.deg2rad(loose_deg)) * np.sqrt(rig.cameras.K[:, 0, 0] * rig.cameras.K[:, 1, 1])
        noise_px = np.hypot(self.sightings.noise_px, loose_px[:, None])
        least = self.viewpoints(rig)
        numbers, found, places_m = [np.empty(0, int)], [np.empty((0, len(rig)), int)], [np.empty((0, 3))]
        for frame in self.frames.tolist():
            seen_px = self.sightings.centre_px[frame]
            try:
                with np.errstate(all="ignore"):
                    matches = match(
                        rig.cameras, seen_px, noise_px[frame], bounds_m=self.bounds_m, min_views=least
                    )
            except np.linalg.LinAlgError:
                # A rig can be so wrong that the equations are singular.
                continue
            enough = _count_viewpoints(rig, matches.detection >= 0) >= least
            found.append(matches.detection[enough])
            places_m.append(matches.position_m[enough])
            numbers.append(np.full(enough.sum(), frame))
        return np.concatenate(numbers), np.concatenate(found), np.concatenate(places_m)

    def explained(self, rig: Rig) -> Int[np.ndarray, "cameras"]:
        """(cameras,), numbers of sightings that are near a point at which enough viewpoints agree."""
        frame, _, position_m = self.matched(rig)
        position_m = by_image(np.searchsorted(self.frames, frame), position_m, len(self.frames))
        return are_near(rig.cameras, self.sightings[self.frames], position_m).any(axis=1).sum(axis=(0, 2))

    def common_points(self, rig: Rig) -> CommonPoints:
        """Match the sightings over all cameras loosely, and link the points of consecutive frames."""
        cameras, sightings = rig.cameras, self.sightings
        frame, detection, _ = self.matched(rig, LOOSE_DEG)
        used = np.zeros(len(rig))
        for camera, of in enumerate(detection.T):
            boxes, of_box, count = np.unique(
                np.stack([frame, of]), axis=1, return_inverse=True, return_counts=True
            )
            used[camera] = (boxes[1] >= 0).sum()
            detection[count[of_box.ravel()] > 1, camera] = -1
        here = frame[:, None], np.arange(len(rig)), detection
        centre_px, size_px = sightings.centre_px[here], sightings.size_px[here]
        # Pixel centres are at whole numbers, so the image begins at -0.5.
        low, high = centre_px - size_px / 2 + 0.5, centre_px + size_px / 2 + 0.5
        cut = np.any((low < BORDER_PX) | (high > cameras.image_size_wh - BORDER_PX), axis=-1)
        seen = (detection >= 0) & ~cut & np.isfinite(centre_px).all(axis=-1)
        centre_px = np.where(seen[..., None], centre_px, np.nan)
        position_m = triangulate_linearly(cameras, centre_px)
        least = self.viewpoints(rig)
        enough = _count_viewpoints(rig, seen) >= least
        kept = np.flatnonzero(enough & np.isfinite(position_m).all(axis=-1))
        piece = _link(rig, frame[kept], position_m[kept])
        long = np.bincount(piece, minlength=1)[piece] >= _MIN_PIECE
        kept, piece = kept[long], np.unique(piece[long], return_inverse=True)[1]
        frame, centre_px, position_m = frame[kept], centre_px[kept], position_m[kept]
        side_px = np.where(seen[kept], np.sqrt(size_px[kept].prod(axis=-1)), np.nan)
        offset_s, information = np.zeros(side_px.shape), np.ones(side_px.shape)
        if sightings.exposures is not None:
            # A rolling shutter exposes each row at its own time; the offset is that of the middle row.
            exposures = sightings.exposures[frame]
            from_middle = np.nan_to_num(centre_px[..., 1] - (cameras.image_size_wh[:, 1] - 1) / 2)
            offset_s = np.asarray(exposures.offset_s + exposures.line_time_s * from_middle, float)
            information = np.asarray(exposures.share, float)
        return CommonPoints(
            frame,
            piece,
            position_m,
            _velocities(frame, piece, position_m),
            centre_px,
            side_px,
            self.fps * offset_s,
            information,
            used / np.maximum(self.count, 1),
            least,
        )


def _count_viewpoints(rig: Rig, seen: Bool[np.ndarray, "rows cameras"]) -> Int[np.ndarray, "rows"]:
    """(rows,), numbers of viewpoints that see something."""
    label = viewpoints(rig.cameras)
    at = label[:, None] == np.unique(label)
    return (seen.astype(int) @ at.astype(int) > 0).sum(axis=-1)


def _link(
    rig: Rig, frame: Int[np.ndarray, "points"], position_m: Float[np.ndarray, "points 3"]
) -> Int[np.ndarray, "points"]:
    """The piece of each point."""
    piece = np.full(len(frame), -1)
    near_m = np.linalg.norm(to_camera(rig.cameras, position_m[:, None]), axis=-1).min(axis=-1, initial=np.inf)
    last, begin, before = -2, 0, np.empty(0, int)
    for number in np.unique(frame).tolist():
        here = np.flatnonzero(frame == number)
        if number != last + 1 or number - begin >= _BLOCK_FRAMES:
            before, begin = np.empty(0, int), number
        distance = np.linalg.norm(position_m[here][:, None] - position_m[before], axis=-1)
        for mine, theirs in zip(*linear_sum_assignment(distance), strict=True):
            if distance[mine, theirs] < _STEP * near_m[here[mine]]:
                piece[here[mine]] = piece[before[theirs]]
        new = here[piece[here] < 0]
        piece[new] = piece.max(initial=-1) + 1 + np.arange(len(new))
        before, last = here, number
    return piece


def _velocities(
    frame: Int[np.ndarray, "points"],
    piece: Int[np.ndarray, "points"],
    position_m: Float[np.ndarray, "points 3"],
) -> Float[np.ndarray, "points 3"]:
    """Slopes of a robust parabola through the points of each piece, or of a straight line through few points."""
    velocity_m = np.zeros_like(position_m)
    for number in np.unique(piece):
        rows = np.flatnonzero(piece == number)
        time = frame[rows] - frame[rows].mean()
        degree = 2 if len(rows) >= 2 * _MIN_PIECE else 1
        powers, weight = np.vander(time, degree + 1, increasing=True), np.ones((len(rows), 1))
        for _ in range(4):
            curve = np.linalg.lstsq(powers * weight, position_m[rows] * weight, rcond=None)[0]
            distance = np.linalg.norm(position_m[rows] - powers @ curve, axis=-1, keepdims=True)
            weight = cauchy_weight((distance / max(3 * float(np.median(distance)), 1e-9)) ** 2)
        velocity_m[rows] = curve[1] + (2 * time[:, None] * curve[2] if degree == 2 else 0.0)
    return velocity_m
