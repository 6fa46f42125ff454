"""Corrections of a rig: each camera turned, moved, with another focal length or clock, or all lenses together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from psotrack.calibration.doctor.common_points import CommonPoints
from psotrack.geometry import Rig, cross_matrices, project_visible, project_with_jacobian, to_camera
from psotrack.geometry.estimation import cauchy_weight

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
