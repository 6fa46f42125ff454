"""Points that several cameras see, matched so loosely that a camera that is a little wrong still takes part.

A fault must not decide which sightings belong together, or sightings of a camera with a fault would be lost. Boxes that
the image's border cuts, and boxes that two points share, show no single body and are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from psotrack.calibration.doctor.agreement import MIN_VIEWPOINTS, num_viewpoints
from psotrack.geometry import Rig, to_camera, triangulate_linearly
from psotrack.tracking.matching import BORDER_PX, Sightings, match

#: Standard deviation of the direction of a camera's rays that a fault may cause, degrees.
LOOSE_DEG = 0.7
#: Longest way of a body between two frames, as a share of its distance from the nearest camera.
_STEP = 0.06
#: Largest number of frames of a piece of a path: the lasting errors of boxes change with the attitude.
BLOCK_FRAMES = 15
#: Smallest number of points of a piece of a path.
MIN_PIECE = 4


@dataclass(frozen=True)
class CommonPoints:
    """Points of a few runs of consecutive frames, linked to pieces of paths.

    Attributes:
        frame: (points,), number of each point's frame.
        piece: (points,), number of each point's piece of a path.
        run: (pieces,), number of the block of consecutive frames of each piece.
        start_m: (points, 3), positions in the world by the rig as it was read, metres.
        velocity_m: (points, 3), metres per frame.
        centre_px: (points, cameras, 2), middles of boxes, pixels; NaN for no sighting.
        side_px: (points, cameras), mean sides of boxes, pixels; NaN for no sighting.
        offset_frames: (points, cameras), time of the camera's frame minus time of the point's frame, frames.
        information: (points, cameras), part of a sighting's information that this point may use: a slow camera shows
            one frame at several instants.
        share: (cameras,), share of each camera's sightings that belong to a point.
    """

    frame: Int[np.ndarray, "points"]
    piece: Int[np.ndarray, "points"]
    run: Int[np.ndarray, "pieces"]
    start_m: Float[np.ndarray, "points 3"]
    velocity_m: Float[np.ndarray, "points 3"]
    centre_px: Float[np.ndarray, "points cameras 2"]
    side_px: Float[np.ndarray, "points cameras"]
    offset_frames: Float[np.ndarray, "points cameras"]
    information: Float[np.ndarray, "points cameras"]
    share: Float[np.ndarray, "cameras"]

    @property
    def seen(self) -> Bool[np.ndarray, "points cameras"]:
        """(points, cameras), True where a camera sees a point."""
        return np.isfinite(self.side_px)


def find_common_points(
    rig: Rig,
    sightings: Sightings,
    frames: Int[np.ndarray, "chosen"],
    bounds_m: Float[np.ndarray, "2 3"],
    fps: float,
) -> CommonPoints:
    """Match the sightings of some frames over all cameras loosely, and link the points of consecutive frames.

    Args:
        rig: the rig to check.
        sightings: sightings of the rig's cameras.
        frames: (chosen,), numbers of the frames to examine.
        bounds_m: (2, 3), corners of the region where bodies can be, metres.
        fps: frames (instants) per second.
    """
    focal_px = np.sqrt(rig.cameras.K[:, 0, 0] * rig.cameras.K[:, 1, 1])
    loose_px = np.tan(np.deg2rad(LOOSE_DEG)) * focal_px
    numbers, centres, sizes = [], [], []
    used, total = np.zeros(len(rig)), np.zeros(len(rig))
    for frame in frames.tolist():
        view = sightings[frame]
        total += np.isfinite(view.noise_px).sum(axis=1)
        try:
            with np.errstate(all="ignore"):
                noise_px = np.hypot(view.noise_px, loose_px[:, None])
                detection = match(rig.cameras, view.centre_px, noise_px, bounds_m=bounds_m).detection
        except np.linalg.LinAlgError:
            # A rig can be so wrong that the equations are singular.
            continue
        used += [len(np.unique(of[of >= 0])) for of in detection.T]
        alone = view.grouped(_without_shared(detection))
        size_px = alone.size_px
        centre_px = np.where(_is_cut(rig, alone.centre_px, size_px)[..., None], np.nan, alone.centre_px)
        there = np.all(np.isfinite(centre_px), axis=-1)
        enough = num_viewpoints(rig.cameras, there) >= MIN_VIEWPOINTS
        numbers.append(np.full(int(enough.sum()), frame))
        centres.append(centre_px[enough])
        sizes.append(size_px[enough])
    none = np.empty((0, len(rig), 2))
    frame_of = np.concatenate([np.empty(0, int), *numbers])
    centre_px, size_px = np.concatenate([none, *centres]), np.concatenate([none, *sizes])
    position_m = triangulate_linearly(rig.cameras, centre_px)
    known = np.isfinite(position_m).all(axis=-1)
    frame_of, centre_px, size_px, position_m = (
        values[known] for values in (frame_of, centre_px, size_px, position_m)
    )
    piece, run = _link(rig, frame_of, position_m)
    long_enough = np.bincount(piece, minlength=len(run))[piece] >= MIN_PIECE
    kept = np.flatnonzero(long_enough)
    names, piece = np.unique(piece[kept], return_inverse=True)
    side_px = np.sqrt(size_px[kept].prod(axis=-1))
    side_px = np.where(np.isfinite(centre_px[kept]).all(axis=-1), side_px, np.nan)
    exposures = sightings.exposures
    offset_frames, information = np.zeros(side_px.shape), np.ones(side_px.shape)
    if exposures is not None:
        # A rolling shutter exposes each row at its own time; the offset is that of the middle row.
        middle_row = (rig.cameras.image_size_wh[:, 1] - 1) / 2
        from_middle = np.nan_to_num(centre_px[kept][..., 1] - middle_row)
        line_time_s = np.asarray(exposures.line_time_s, np.float64)[frame_of[kept]]
        offset_s = np.asarray(exposures.offset_s, np.float64)[frame_of[kept]]
        offset_frames = fps * (offset_s + line_time_s * from_middle)
        information = np.asarray(exposures.share, np.float64)[frame_of[kept]]
    return CommonPoints(
        frame_of[kept],
        piece,
        run[names],
        position_m[kept],
        _velocities(frame_of[kept], piece, position_m[kept]),
        centre_px[kept],
        side_px,
        offset_frames,
        information,
        used / np.maximum(total, 1),
    )


def _without_shared(detection: Int[np.ndarray, "groups cameras"]) -> Int[np.ndarray, "groups cameras"]:
    """The detections of each group, -1 where another group has the detection, too."""
    same = (detection[:, None] == detection).sum(axis=1) > 1
    return np.where(same, -1, detection)


def _is_cut(
    rig: Rig, centre_px: Float[np.ndarray, "groups cameras 2"], size_px: Float[np.ndarray, "groups cameras 2"]
) -> Bool[np.ndarray, "groups cameras"]:
    """Whether the border cuts a box; pixel centres are at whole numbers, so the image begins at -0.5."""
    low, high = centre_px - size_px / 2 + 0.5, centre_px + size_px / 2 + 0.5
    image_px = np.asarray(rig.cameras.image_size_wh)
    return np.any((low < BORDER_PX) | (high > image_px - BORDER_PX), axis=-1)


def _link(
    rig: Rig, frame: Int[np.ndarray, "points"], position_m: Float[np.ndarray, "points 3"]
) -> tuple[Int[np.ndarray, "points"], Int[np.ndarray, "pieces"]]:
    """The piece of each point, and the run of each piece."""
    piece = np.full(len(frame), -1)
    run_of_piece: list[int] = []
    near_m = np.linalg.norm(to_camera(rig.cameras, position_m[:, None]), axis=-1).min(axis=-1, initial=np.inf)
    run, last, begin, before = -1, -2, 0, np.empty(0, int)
    for number in np.unique(frame).tolist():
        here = np.flatnonzero(frame == number)
        if number != last + 1 or number - begin >= BLOCK_FRAMES:
            run, before, begin = run + 1, np.empty(0, int), number
        distance = np.linalg.norm(position_m[here][:, None] - position_m[before], axis=-1)
        for mine, theirs in zip(*linear_sum_assignment(distance), strict=True):
            if distance[mine, theirs] < _STEP * near_m[here[mine]]:
                piece[here[mine]] = piece[before[theirs]]
        for point in here[piece[here] < 0]:
            piece[point] = len(run_of_piece)
            run_of_piece.append(run)
        before, last = here, number
    return piece, np.array(run_of_piece, int)


def _velocities(
    frame: Int[np.ndarray, "points"],
    piece: Int[np.ndarray, "points"],
    position_m: Float[np.ndarray, "points 3"],
) -> Float[np.ndarray, "points 3"]:
    """Slopes of a parabola through the points of each piece, or of a straight line through few points."""
    velocity_m = np.zeros_like(position_m)
    for number in np.unique(piece):
        rows = np.flatnonzero(piece == number)
        time = frame[rows] - frame[rows].mean()
        degree = 2 if len(rows) >= 2 * MIN_PIECE else 1
        powers = np.vander(time, degree + 1, increasing=True)
        curve = _robust_curve(powers, position_m[rows])
        slope = np.column_stack([np.zeros(len(rows)), *(k * time ** (k - 1) for k in range(1, degree + 1))])
        velocity_m[rows] = slope @ curve
    return velocity_m


def _robust_curve(
    powers: Float[np.ndarray, "n terms"], position_m: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "terms 3"]:
    """Coefficients of a curve; points far from the curve count less."""
    weight = np.ones(len(powers))
    for _ in range(4):
        curve = np.linalg.lstsq(powers * weight[:, None], position_m * weight[:, None], rcond=None)[0]
        off = np.linalg.norm(position_m - powers @ curve, axis=-1)
        weight = 1 / (1 + (off / max(3 * float(np.median(off)), 1e-9)) ** 2)
    return curve
