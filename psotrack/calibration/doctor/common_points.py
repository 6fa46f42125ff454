"""Points that several cameras see, and how they change with corrections of the rig.

**Matching.** Points are matched so loosely that a camera that is a little wrong still takes part. A fault must not
decide which sightings belong together, or sightings of a camera with a fault would be lost. Boxes that the image's
border cuts, and boxes that two points share, show no single body and are left out.

**Corrections.** Each camera may be turned, moved, or have another focal length or clock; or all lenses together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from psotrack.geometry import (
    Rig,
    cross_matrices,
    project_visible,
    project_with_jacobian,
    to_camera,
    triangulate_linearly,
    viewpoints,
)
from psotrack.geometry.estimation import cauchy_weight
from psotrack.tracking.camera_errors import ClockStep, Knock
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
#: Parameters of a camera: a turn about its axes (3), a way of its centre in the world (3), logarithm of the focal
#: length, lag of its video in frames. One parameter more is the logarithm of all focal lengths.
PER_CAMERA = 8
#: First assumption of the noise from frame to frame: pixels, and as a fraction of a box's side.
_NOISE_PX, _NOISE_OF_SIDE = 0.5, 0.02
#: A sighting at this number of standard deviations from the others of its piece has a weight of 1/4.
_OUTLIER_STD = 3.0
#: Number of rounds of the weights, and of the errors of pieces in each.
_ROUNDS, _BIAS_ROUNDS = 6, 15
#: Median of the length of a vector whose components have a standard deviation of 1 (Rayleigh distribution).
_RAYLEIGH_MEDIAN = 1.1774
#: Information that keeps a point that no camera sees where it is, 1 / m².
_TINY = 1e-9 * np.eye(3)


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

    def without(self, change: Knock | ClockStep) -> ExaminedFrames:
        """What is seen before a camera changed, and by the others then."""
        kept = np.ones(self.sightings.noise_px.shape, bool)
        kept[change.frame :, change.camera] = False
        return replace(self, sightings=self.sightings.where(kept))

    def matched(
        self, rig: Rig, loose_deg: float = 0.0, least: int | None = None
    ) -> tuple[Int[np.ndarray, "groups"], Int[np.ndarray, "groups cameras"], Float[np.ndarray, "groups 3"]]:
        """Groups of sightings that may show one body: frames, indices of the sightings, -1 for none, and positions.

        Args:
            rig: the cameras.
            loose_deg: standard deviation of the direction of rays that a fault may cause, degrees.
            least: smallest number of viewpoints of a group; None: `viewpoints`.
        """
        loose_px = np.tan(np.deg2rad(loose_deg)) * np.sqrt(rig.cameras.K[:, 0, 0] * rig.cameras.K[:, 1, 1])
        noise_px = np.hypot(self.sightings.noise_px, loose_px[:, None])
        least = self.viewpoints(rig) if least is None else least
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


@dataclass(frozen=True)
class Corrected:
    """A rig after a correction.

    Attributes:
        rig: the cameras.
        lag_frames: (cameras,), frames by which each video shows the scene late.
    """

    rig: Rig
    lag_frames: Float[np.ndarray, "cameras"]

    def by(self, step: Float[np.ndarray, "parameters"]) -> Corrected:
        """The rig after a further correction in all parameters."""
        cameras = self.rig.cameras
        T, K = cameras.T_cam_world.copy(), cameras.K.copy()
        each = step[:-1].reshape(-1, PER_CAMERA)
        R = Rotation.from_rotvec(each[:, :3]).as_matrix() @ T[:, :3, :3]
        T[:, :3, :3], T[:, :3, 3] = R, -np.matvec(R, cameras.centre_world + each[:, 3:6])
        K[:, :2, :2] *= np.exp(each[:, 6] + step[-1])[:, None, None]
        rig = Rig(self.rig.names, replace(cameras, T_cam_world=T, K=K))
        return Corrected(rig, self.lag_frames + each[:, 7])


@dataclass(frozen=True)
class WeightedPoints:
    """Sightings with weights.

    Attributes:
        points: the points.
        position_m: (points, 3), positions, metres.
        weight: (points, cameras), inverse variances, 1 / px²; 0 for no sighting and for outliers.
    """

    points: CommonPoints
    position_m: Float[np.ndarray, "points 3"]
    weight: Float[np.ndarray, "points cameras"]

    @property
    def used(self) -> Bool[np.ndarray, "points cameras"]:
        """(points, cameras), True where a camera sees a point and the sighting is no outlier."""
        return self.weight > 0


@dataclass(frozen=True)
class Slopes:
    """Sightings minus projections, and derivatives of the projections.

    Attributes:
        residual_px: (points, cameras, 2), sightings minus projections, pixels; NaN for no sighting.
        by_point: (points, cameras, 2, 3), derivatives by the points, pixels per metre.
        by_parameter: (points, cameras, 2, parameters), derivatives by the correction.
    """

    residual_px: Float[np.ndarray, "points cameras 2"]
    by_point: Float[np.ndarray, "points cameras 2 3"]
    by_parameter: Float[np.ndarray, "points cameras 2 parameters"]


def linearise(
    corrected: Corrected, points: CommonPoints, position_m: Float[np.ndarray, "points 3"]
) -> Slopes:
    """Compare sightings with projections of points at whole frames, and differentiate by points and corrections."""
    cameras, count = corrected.rig.cameras, len(corrected.rig)
    # A video that lags shows where a body was before.
    ahead_frames = points.offset_frames - corrected.lag_frames
    there_m = position_m[:, None] + ahead_frames[..., None] * points.velocity_m[:, None]
    pixels, depth, by_world = project_with_jacobian(cameras, there_m)
    in_camera = by_world @ cameras.T_cam_world[:, :3, :3].swapaxes(-1, -2)
    turn = -in_camera @ cross_matrices(np.asarray(to_camera(cameras, there_m)))
    zoom = (pixels - cameras.K[:, :2, 2])[..., None]
    lag = -by_world @ points.velocity_m[:, None, :, None]
    own = np.concatenate([turn, -by_world, zoom, lag], axis=-1)
    slopes = np.zeros((*pixels.shape, PER_CAMERA * count + 1))
    for index in range(count):
        slopes[:, index, :, PER_CAMERA * index : PER_CAMERA * (index + 1)] = own[:, index]
    slopes[..., -1:] = zoom
    # Beyond the fold of a lens's model there is no projection: such a sighting does not count.
    residual_px = points.centre_px - project_visible(cameras, there_m)[0]
    residual_px = np.where((depth > 0)[..., None], residual_px, np.nan)
    return Slopes(residual_px, np.nan_to_num(by_world), np.nan_to_num(slopes))


def weigh(corrected: Corrected, points: CommonPoints) -> WeightedPoints:
    """Weights of the sightings: outliers are far from where the same camera otherwise sees the same piece.

    A constant error of a camera in a piece costs nothing here, so that faults do not make outliers.
    """
    sigma_px = _NOISE_PX + _NOISE_OF_SIDE * np.nan_to_num(points.side_px)
    weight, position_m = points.seen / sigma_px**2, points.start_m
    of_piece = np.arange(points.piece.max(initial=-1) + 1)[:, None] == points.piece
    for _ in range(_ROUNDS):
        slopes = linearise(corrected, points, position_m)
        there, J = np.isfinite(slopes.residual_px).all(axis=-1), slopes.by_point
        weight = np.where(there, weight, 0.0)
        residual_px = np.where(there[..., None], slopes.residual_px, 0.0)
        inverse = np.linalg.inv(information(J, weight).sum(axis=1) + _TINY)
        bias_px = np.zeros_like(residual_px)
        for _ in range(_BIAS_ROUNDS):
            step_m = np.matvec(inverse, np.einsum("pc,pcik,pci->pk", weight, J, residual_px - bias_px))
            left_px = residual_px - np.matvec(J, step_m[:, None])
            total = np.einsum("qp,pci->qci", of_piece, weight[..., None] * left_px)
            bias_px = (total / np.maximum(of_piece @ weight, 1e-9)[..., None])[points.piece]
        position_m = position_m + step_m
        distance = np.where(there, np.linalg.norm(left_px - bias_px, axis=-1) / sigma_px, np.nan)
        # The fit has three unknowns per point, and follows the noise.
        freedom = 1 - 1.5 / np.maximum((weight > 0).sum(axis=1, keepdims=True), 2)
        scale = np.nan_to_num(medians(distance)) / _RAYLEIGH_MEDIAN
        if points.viewpoints == 2:
            # Two cameras show only the noise of both together.
            scale = np.full(len(scale), np.sqrt(np.square(scale).sum() / max((scale > 0).sum(), 1)))
        std = np.maximum(scale, 0.1) / np.sqrt(freedom)
        robust = cauchy_weight((np.nan_to_num(distance) / std / _OUTLIER_STD) ** 2) ** 2
        used = there & (robust > 0.02)
        used &= used.sum(axis=1, keepdims=True) >= points.viewpoints
        weight = np.where(used, robust * points.information / (std * sigma_px) ** 2, 0.0)
    return WeightedPoints(points, position_m, weight)


def information(
    J: Float[np.ndarray, "points cameras 2 3"], weight: Float[np.ndarray, "points cameras"]
) -> Float[np.ndarray, "points cameras 3 3"]:
    """What each camera tells of each point, 1 / m²."""
    return weight[..., None, None] * (J.swapaxes(-1, -2) @ J)


def misfit_px(corrected: Corrected, data: WeightedPoints) -> Float[np.ndarray, "points cameras"]:
    """Distances of sightings from where the other cameras put the body, pixels; NaN for no sighting and outliers.

    Where fewer than two other cameras see the body, it is twice the distance from where all cameras put it: two cameras
    have equal parts of their disagreement.
    """
    slopes = linearise(corrected, data.points, data.position_m)
    J, residual_px = slopes.by_point, np.nan_to_num(slopes.residual_px)
    each, right = information(J, data.weight), np.einsum("pc,pcik,pci->pck", data.weight, J, residual_px)
    others = (data.used.sum(axis=1, keepdims=True) - data.used >= 2)[..., None]
    normal = each.sum(axis=1, keepdims=True) - np.where(others[..., None], each, 0.0) + _TINY
    right = right.sum(axis=1, keepdims=True) - np.where(others, right, 0.0)
    left_px = residual_px - np.matvec(J, np.linalg.solve(normal, right[..., None])[..., 0])
    distance_px = np.linalg.norm(left_px, axis=-1) * np.where(others[..., 0], 1, 2)
    return np.where(data.used, distance_px, np.nan)


def medians(values: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "columns"]:
    """The median of the numbers in each column; NaN where there are none."""
    return np.array([np.median(of[np.isfinite(of)]) if np.isfinite(of).any() else np.nan for of in values.T])
