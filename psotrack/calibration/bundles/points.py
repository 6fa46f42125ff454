"""Bundle adjustment of cameras and points: residuals, derivatives and normal equations (see `calibration.bundle`).

A point X is seen at K(R_c X + t_c). The unknowns of the cameras, and a common factor of the focal lengths, are shared
by all points; each point is a block, which `psotrack.geometry.estimation` eliminates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.calibration.bundles.poses import move_poses
from psotrack.calibration.derivatives import reproject
from psotrack.calibration.gauge import pose_changes
from psotrack.geometry import Camera
from psotrack.geometry.estimation import (
    NormalEquations,
    Step,
    cauchy_loss,
    cauchy_weight,
    levenberg_marquardt,
)

#: Weight of the constraint on common motions of the rig: large enough to suppress them, and small enough that sums with
#: the other equations keep their digits.
_GAUGE_WEIGHT = 1e6
#: Relative change of the cost that ends the search; the robust search only has to find the outliers.
_LEAST_GAIN, _LEAST_GAIN_ROBUST = 1e-10, 1e-4
_MAX_STEPS = 200


@dataclass(frozen=True)
class PointState:
    """Unknowns of a bundle adjustment.

    Attributes:
        T_cam_world: (cameras, 4, 4), transforms from world to camera, metres.
        points_m: (points, 3), positions of the points in the world, metres.
        focal_scale: common factor of the focal lengths.
    """

    T_cam_world: Float[np.ndarray, "cameras 4 4"]
    points_m: Float[np.ndarray, "points 3"]
    focal_scale: float = 1.0


@dataclass(frozen=True)
class PointProblem:
    """Data of a bundle adjustment.

    Attributes:
        lenses: intrinsics of the cameras.
        given: (cameras, 4, 4), poses before the adjustment, camera from world.
        points_px: (points, cameras, 2), pixels.
        noise_px: (points, cameras), standard deviation of a pixel along x and along y.
        rescaled: (cameras,), True where the focal length is multiplied by the common factor.
        free: (unknowns, free), maps the free unknowns to all unknowns; fixed cameras have no free unknowns.
        common: (unknowns, motions), free common motions of the rig, in units of the cameras' unknowns.
        held: (motions, unknowns), maps changes of the given poses to the common motions, all in equal units.
    """

    lenses: Camera
    given: Float[np.ndarray, "cameras 4 4"]
    points_px: Float[np.ndarray, "points cameras 2"]
    noise_px: Float[np.ndarray, "points cameras"]
    rescaled: Bool[np.ndarray, " cameras"]
    free: Float[np.ndarray, "unknowns free"]
    common: Float[np.ndarray, "unknowns motions"]
    held: Float[np.ndarray, "motions unknowns"]


@dataclass(frozen=True)
class PointBundle:
    """A state of the problem with its residuals, `estimation.least_squares.Linearised`.

    Attributes:
        problem: data of the adjustment.
        state: values of the unknowns.
        used: (points, cameras), True for the observations that count.
        robust: whether the loss is Cauchy's instead of the squared residual.
    """

    problem: PointProblem
    state: PointState
    used: Bool[np.ndarray, "points cameras"]
    robust: bool = False

    @cached_property
    def _projected(
        self,
    ) -> tuple[Float[np.ndarray, "points cameras 2"], Float[np.ndarray, "points cameras 2 6"]]:
        """Projections, and their derivatives by a small turn of the camera (rad) and by its translation (m)."""
        pixels, slopes = [], []
        for index, T in enumerate(self.state.T_cam_world):
            projected, by_turn, by_shift = reproject(
                self.state.points_m, T[:3, :3], T[:3, 3], self._lens(index)
            )
            pixels.append(projected)
            slopes.append(np.concatenate([by_turn, by_shift], axis=-1))
        return np.stack(pixels, axis=1), np.stack(slopes, axis=1)

    @cached_property
    def distance_px(self) -> Float[np.ndarray, "points cameras"]:
        """(points, cameras), distances in the image between projections and measured pixels."""
        return np.asarray(np.linalg.norm(self._projected[0] - self.problem.points_px, axis=-1))

    @cached_property
    def _squares(self) -> Float[np.ndarray, "points cameras"]:
        """(points, cameras), squared distances in standard deviations; 0 where not used."""
        return np.where(self.used, self.distance_px / self.problem.noise_px, 0.0) ** 2

    @cached_property
    def _common(self) -> Float[np.ndarray, " motions"]:
        """(motions,), common motions of the rig since the given poses."""
        return self.problem.held @ pose_changes(self.problem.given, self.state.T_cam_world)

    @cached_property
    def cost(self) -> float:
        """Sum of the losses, and the gauge constraint."""
        loss = cauchy_loss(self._squares) if self.robust else self._squares
        return float(loss.sum() + _GAUGE_WEIGHT * np.sum(self._common**2))

    @property
    def weights(self) -> Float[np.ndarray, "points cameras"]:
        """(points, cameras), weights of the residuals, px⁻²; 0 where not used."""
        weight = cauchy_weight(self._squares) if self.robust else 1.0
        return self.used * weight / self.problem.noise_px**2

    def slopes(
        self, index: int, seen: Int[np.ndarray, " seen"]
    ) -> tuple[Float[np.ndarray, "seen 2 7"], Float[np.ndarray, "seen 2 3"], Float[np.ndarray, "seen 2"]]:
        """Derivatives and residuals of one camera's pixels.

        Returns:
            (seen, 2, 7), derivatives by the camera's six unknowns and by the logarithm of the focal lengths' factor;
            (seen, 2, 3), derivatives by the points; and (seen, 2), measured minus projected pixels.
        """
        pixels, by_pose = (part[seen, index] for part in self._projected)
        # A larger focal length moves pixels away from the principal point.
        centre_px = np.asarray(self._lens(index).K)[:2, 2]
        by_focal = self.problem.rescaled[index] * (pixels - centre_px)[..., None]
        by_point = by_pose[..., 3:] @ self.state.T_cam_world[index, :3, :3]
        return (
            np.concatenate([by_pose, by_focal], axis=-1),
            by_point,
            self.problem.points_px[seen, index] - pixels,
        )

    def equations(self) -> NormalEquations:
        """Normal equations; the points are the blocks."""
        count, free, weights = len(self.problem.given), self.problem.free, self.weights
        points, size = len(self.state.points_m), 6 * count + 1
        information, right = np.zeros((size, size)), np.zeros(size)
        of_points, point_right = np.zeros((points, 3, 3)), np.zeros((points, 3))
        coupling = np.zeros((points, 3, size))
        for index in range(count):
            seen = np.flatnonzero(weights[:, index])
            if not len(seen):
                continue
            by_camera, by_point, off = self.slopes(index, seen)
            weight = weights[seen, index]
            columns = camera_columns(index, count)
            information[np.ix_(columns, columns)] += np.einsum("p,pki,pkj->ij", weight, by_camera, by_camera)
            right[columns] += np.einsum("p,pki,pk->i", weight, by_camera, off)
            of_points[seen] += np.einsum("p,pki,pkj->pij", weight, by_point, by_point)
            point_right[seen] += np.einsum("p,pki,pk->pi", weight, by_point, off)
            rows = np.ix_(seen, np.arange(3), columns)
            coupling[rows] += np.einsum("p,pki,pkj->pij", weight, by_point, by_camera)
        # A point without a used observation stays where it is.
        of_points[np.einsum("pii->p", of_points) == 0] = np.eye(3)
        held = self.problem.held @ free
        return NormalEquations(
            free.T @ information @ free + _GAUGE_WEIGHT * held.T @ held,
            free.T @ right - _GAUGE_WEIGHT * held.T @ self._common,
            of_points,
            point_right,
            coupling @ free,
        )

    def moved(self, step: Step) -> PointBundle:
        """Turn and shift the cameras, shift the points, and scale the focal lengths."""
        if step.blocks is None:
            raise TypeError("expected a step with blocks, found none")
        whole = self.problem.free @ step.shared
        T = move_poses(self.state.T_cam_world, whole[:-1].reshape(-1, 6))
        focal_scale = self.state.focal_scale * float(np.exp(whole[-1]))
        return replace(self, state=PointState(T, self.state.points_m + step.blocks, focal_scale))

    def solved(self) -> PointBundle:
        """Lower the cost from this state."""
        least_gain = _LEAST_GAIN_ROBUST if self.robust else _LEAST_GAIN
        return levenberg_marquardt(self, max_steps=_MAX_STEPS, least_gain=least_gain)

    def _lens(self, index: int) -> Camera:
        lens = self.problem.lenses[index]
        return scale_focal_lengths(lens, self.state.focal_scale) if self.problem.rescaled[index] else lens


def camera_columns(index: int, num_cameras: int) -> Int[np.ndarray, "7"]:
    """(7,), indices of a camera's six unknowns, and of the focal lengths' factor, among all unknowns."""
    return np.append(np.arange(6 * index, 6 * index + 6), 6 * num_cameras)


def scale_focal_lengths(lenses: Camera, focal_scale: float | Float[np.ndarray, " cameras"]) -> Camera:
    """Multiply the focal lengths of all lenses by one factor, or by one factor per lens."""
    K = np.array(lenses.K)
    K[..., :2, :2] *= np.asarray(focal_scale)[..., None, None]
    return replace(lenses, K=K)
