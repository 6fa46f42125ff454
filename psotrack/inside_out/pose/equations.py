"""Linear equations of one frame's corners, in the pose, in two unknowns of all corners, and in the markers' places.

The error of a corner has four parts: its own error; the error of its marker's place; an inset, because the white around
a black marker shines into the marker, and each corner is found too far inside; and the error of the focal length. Inset
and focal length are one number each for all corners of a frame. The own errors of a marker's corners are correlated,
because each edge of the marker moves two corners: their mean is more accurate than the mean of independent errors.
`centre_scale` is the ratio of the two deviations (`localising.corner_noise`). With residuals r, derivatives J by the
pose, the inset and the focal length, and derivatives S by a marker's place, the cost is

    Σ |r - J x - S d|² / own² + Σ |d|² / place² + (inset / its deviation)² + (focal length / its deviation)².

Where the shutter rolls, the velocity and the turn rate of the camera are six more unknowns (see `row_motion`), with the
prior that the motion gives. The places d are eliminated (`psotrack.geometry.estimation`). Both variances, own² and
place², are estimated from the residuals and from the number of unknowns that the data determine (MacKay, Bayesian
interpolation, Neural Computation 4(3), 1992), with a scaled inverse χ² prior. The principal point is not an unknown,
because a turn of the camera has almost the same effect, except at the edge of a wide image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from psotrack.calibration import reproject
from psotrack.geometry import NEAR_M, Camera
from psotrack.geometry.estimation import NormalEquations, covariance_from_information
from psotrack.inside_out.pose.records import CornerResiduals
from psotrack.inside_out.pose.row_motion import RowMotion, UnsureRows, at_rows, slopes_by_motion

#: Standard deviation of the inset, px.
INSET_STD_PX = 0.5
#: Prior information on the inset and on the focal length, whose unit is its stated standard deviation.
_PRIOR = np.diag([1 / INSET_STD_PX**2, 1.0])
#: Number of unknowns of the pose.
POSE_SIZE = 6
#: Weight of a stated variance, as a number of residuals.
PRIOR_RESIDUALS = 3.0
#: Ratio of an unknown's variance to its variance if all others were known, above which the pose is undetermined.
_LARGEST_INFLATION = 1e12


@dataclass(frozen=True)
class SeenCorners:
    """Markers of one frame, and the lens of the camera.

    Attributes:
        corners_px: (markers, 4, 2), measured pixels.
        corners_m: (markers, 4, 3), places of the corners in the map, world, metres.
        inward: (markers, 4, 2), unit vectors in the image from each corner into its marker.
        lens: intrinsics; the pose is ignored.
        noise_px: stated standard deviation of a corner along x and along y, pixels.
        usual_px: the same in other frames, which counts together with the residuals of this frame.
        place_m: stated standard deviation of a marker's place along each axis, metres.
        usual_place_m: the same in other frames, which counts together with the residuals of this frame.
        map_share: share of the variance of a marker's place that comes from the map and is the same in every frame.
        focal_error: stated standard deviation of the focal length, as a share of the focal length.
        centre_scale: deviation of the mean error of a marker's corners, as a multiple of the deviation that it would
            have if the errors of the corners were independent.
        shift_px: stated standard deviation of an error that all corners share, along x and along y, pixels.
        rows: when the corners were exposed, and the motion that is expected; None of a global shutter.
        unsure: by how much these times may be wrong; None if the line time is exact.
    """

    corners_px: Float[np.ndarray, "markers 4 2"]
    corners_m: Float[np.ndarray, "markers 4 3"]
    inward: Float[np.ndarray, "markers 4 2"]
    lens: Camera
    noise_px: float
    usual_px: float
    place_m: float
    usual_place_m: float
    map_share: float
    focal_error: float
    centre_scale: float = 1.0
    shift_px: float = 0.0
    rows: RowMotion | None = None
    unsure: UnsureRows | None = None

    @property
    def prior_information(self) -> Float[np.ndarray, "extra extra"]:
        """(extra, extra), prior information on inset and focal length, and on the motion of a rolling shutter."""
        if self.rows is None:
            return _PRIOR
        information = np.zeros((8, 8))
        information[:2, :2], information[2:, 2:] = _PRIOR, self.rows.information
        return information

    @property
    def expected_extra(self) -> Float[np.ndarray, "extra"]:
        """(extra,), prior means of these unknowns."""
        return np.zeros(2) if self.rows is None else np.append(np.zeros(2), self.rows.expected)


@dataclass(frozen=True)
class Noise:
    """Variances of a corner's own error and of a marker's place, with the degrees of freedom of both estimates.

    Attributes:
        own_px2: variance of a corner's own error along x and along y, square pixels.
        place_m2: variance of a marker's place along each axis, square metres.
        own_freedom: degrees of freedom of `own_px2`.
        place_freedom: degrees of freedom of `place_m2`.
    """

    own_px2: float
    place_m2: float
    own_freedom: float
    place_freedom: float

    def widened(self) -> Noise:
        """Variances of Student's t distributions, which include the uncertainty of the variances themselves."""
        own, place = (freedom / (freedom - 2) for freedom in (self.own_freedom, self.place_freedom))
        return Noise(own * self.own_px2, place * self.place_m2, self.own_freedom, self.place_freedom)


@dataclass(frozen=True)
class Solution:
    """Solution of the equations of one frame.

    Attributes:
        step: (unknowns,), step of position along the world's axes (m), turn about the camera's axes (rad), inset (px),
            and focal length (stated standard deviations); of a rolling shutter also of the motion (`RowMotion`).
        covariance: (unknowns, unknowns), covariance of these unknowns.
        length: squared length of the step in standard deviations.
        places_m2: (markers, 3, 3), covariances of the markers' places if the pose were known.
    """

    step: Float[np.ndarray, "unknowns"]
    covariance: Float[np.ndarray, "unknowns unknowns"]
    length: float
    places_m2: Float[np.ndarray, "markers 3 3"]


@dataclass(frozen=True)
class Sums:
    """Sums over the equations of the used corners, each a row of derivatives by the unknowns and a residual.

    Attributes:
        total: (unknowns + 1, unknowns + 1), rows multiplied with their transposes, sum over all rows.
        by_place: (markers, 3, unknowns + 1), derivatives by a marker's place multiplied with the rows, sums over each
            marker.
        count: number of equations.
    """

    total: Float[np.ndarray, "columns columns"]
    by_place: Float[np.ndarray, "markers 3 columns"]
    count: int

    def solved(
        self,
        noise: Noise,
        prior_information: Float[np.ndarray, "extra extra"],
        off_prior: Float[np.ndarray, "extra"],
    ) -> Solution | None:
        """Minimise the cost over the linear equations; None if the equations do not determine the pose.

        Args:
            noise: variances of the errors.
            prior_information: (extra, extra), prior information on the unknowns after those of the pose.
            off_prior: (extra,), values of these unknowns at which the equations were made, less their prior means.
        """
        total, by_place = self.total / noise.own_px2, self.by_place / noise.own_px2
        equations = NormalEquations(
            information=total[:-1, :-1],
            right=total[:-1, -1],
            block_information=by_place[..., :3] + np.eye(3) / noise.place_m2,
            block_right=by_place[..., -1],
            coupling=by_place[..., :-1],
        )
        reduced = with_prior(equations, prior_information, off_prior).reduced()
        try:
            covariance = covariance_from_information(reduced.information, _LARGEST_INFLATION)
        except np.linalg.LinAlgError:
            return None
        step = covariance @ reduced.right
        return Solution(step, covariance, float(step @ reduced.right), reduced.block_covariance)

    def noise(self, solution: Solution, noise: Noise, seen: SeenCorners) -> Noise:
        """Estimate the variances from the residuals after a step.

        Args:
            solution: the step.
            noise: variances with which the step was computed.
            seen: markers of the frame, with the stated variances.
        """
        left = np.append(-solution.step, 1.0)
        gain = solution.places_m2 @ self.by_place / noise.own_px2
        off_m = gain @ left
        gain = gain[..., :-1]
        uncertain_m2 = np.trace(solution.places_m2, axis1=1, axis2=2).sum()
        uncertain_m2 += np.sum((gain @ solution.covariance) * gain)
        of_places = max(off_m.size - uncertain_m2 / noise.place_m2, 0.0)
        by_prior = np.sum(seen.prior_information * solution.covariance[POSE_SIZE:, POSE_SIZE:])
        of_pose = len(solution.step) - by_prior
        own_freedom = PRIOR_RESIDUALS + max(self.count - of_pose - of_places, 0.0)
        place_freedom = PRIOR_RESIDUALS + of_places
        square = left @ self.total @ left - 2 * np.sum(off_m * (self.by_place @ left))
        square += np.sum((self.by_place[..., :3] @ off_m[..., None])[..., 0] * off_m)
        return Noise(
            (PRIOR_RESIDUALS * seen.usual_px**2 + max(square, 0.0)) / own_freedom,
            (PRIOR_RESIDUALS * seen.usual_place_m**2 + np.sum(off_m**2)) / place_freedom,
            own_freedom,
            place_freedom,
        )

    def common(
        self, solution: Solution, noise: Noise, map_share: float
    ) -> Float[np.ndarray, "unknowns errors"]:
        """Effect on the unknowns of one standard deviation of each error that is the same in all frames.

        Returns:
            (unknowns, 3 markers + 1), effects of an error of each marker's place in the map along x, y and z, and of an
            error of the focal length.
        """
        # The step is linear in the residuals, and an error of a place or of the focal length adds to the residuals. The
        # derivatives by a marker's place are those by the camera's position with the opposite sign.
        gain = solution.places_m2 @ self.by_place[..., :-1] / noise.own_px2
        places = (gain @ solution.covariance).reshape(-1, len(solution.step))
        places *= np.sqrt(map_share / noise.place_m2)
        return -np.concatenate([places, solution.covariance[POSE_SIZE + 1 : POSE_SIZE + 2]]).T


def with_prior(
    equations: NormalEquations,
    prior_information: Float[np.ndarray, "extra extra"],
    off_prior: Float[np.ndarray, "extra"],
) -> NormalEquations:
    """Add the prior of the unknowns after the pose; the arguments are those of `Sums.solved`."""
    information, right = equations.information.copy(), equations.right.copy()
    information[POSE_SIZE:, POSE_SIZE:] += prior_information
    right[POSE_SIZE:] -= prior_information @ off_prior
    return replace(equations, information=information, right=right)


def log_prior(seen: SeenCorners, extra: Float[np.ndarray, "extra"]) -> float:
    """Logarithm of the prior density of the unknowns after the pose, without its constant."""
    off = extra - seen.expected_extra
    return -0.5 * float(off @ seen.prior_information @ off)


def seen_markers(
    corners_px: Float[np.ndarray, "markers 4 2"],
    corners_m: Float[np.ndarray, "markers 4 3"],
    lens: Camera,
    noise_px: float,
    place_m: float,
    map_error_m: float = 0.0,
    focal_error: float = 0.0,
) -> SeenCorners:
    """Make the data of a fit; the error of a marker's place is the sum of errors of the map and of this frame."""
    to_next = _unit(corners_px[:, [1, 2, 3, 0]] - corners_px)
    inward = _unit(to_next - to_next[:, [3, 0, 1, 2]])
    off_m = float(np.hypot(place_m, map_error_m))
    return SeenCorners(
        corners_px,
        corners_m,
        inward,
        lens,
        noise_px,
        noise_px,
        off_m,
        off_m,
        (map_error_m / off_m) ** 2,
        focal_error,
    )


def equations(
    seen: SeenCorners,
    position_m: Float[np.ndarray, "3"],
    R_world_cam: Float[np.ndarray, "3 3"],
    extra: Float[np.ndarray, "extra"],
) -> tuple[Float[np.ndarray, "markers 4 2 columns"], Float[np.ndarray, "markers 4"]]:
    """Linearise the projections of all corners.

    Args:
        seen: markers of the frame.
        position_m, R_world_cam: pose of the camera; of a rolling shutter at the reference row.
        extra: (extra,), inset and focal length, and of a rolling shutter the motion.

    Returns:
        (markers, 4, 2, unknowns + 1), derivatives of each pixel by position, turn and `extra`, and its residual,
        measured minus projected; and (markers, 4), depths of the corners, metres.
    """
    from_camera_m, turned = (seen.corners_m - position_m).reshape(-1, 3), None
    if seen.rows is None:
        x_cam = from_camera_m @ R_world_cam
    else:
        turned = at_rows(seen.rows.time_s.ravel(), extra[2:])
        x_cam = ((from_camera_m - turned.moved_m) @ R_world_cam)[:, None] @ turned.R_reference_row
        x_cam = x_cam[:, 0]
    depth_m = x_cam[:, 2].copy()
    # A corner behind the camera has no projection; a point in front of the camera keeps the numbers finite.
    x_cam[depth_m <= NEAR_M] = (0.0, 0.0, 1.0)
    pixels, by_turn, by_shift = reproject(x_cam, np.eye(3), np.zeros(3), seen.lens)
    by_extra = np.stack(
        [seen.inward.reshape(-1, 2), seen.focal_error * (pixels - seen.lens.K[:2, 2])], axis=-1
    )
    off_px = seen.corners_px.reshape(-1, 2) - pixels - by_extra @ extra[:2]
    if turned is None:
        columns = [-by_shift @ R_world_cam.T, -by_turn, by_extra, off_px[..., None]]
    else:
        by_pose, by_motion = slopes_by_motion(by_shift, -by_turn, R_world_cam, turned)
        columns = [by_pose, by_extra, by_motion, off_px[..., None]]
    rows = np.concatenate(columns, axis=-1)
    shape = seen.corners_px.shape[:2]
    return rows.reshape(*shape, 2, -1), depth_m.reshape(shape)


def summed(
    rows: Float[np.ndarray, "markers 4 2 columns"],
    fits: Bool[np.ndarray, "markers 4"],
    centre_scale: float = 1.0,
) -> Sums:
    """Sum the equations of the corners that fit.

    Each marker's mean equation is divided by `centre_scale` first: then all errors have the variance of a corner's own
    error, and none are correlated.
    """
    if centre_scale != 1:
        mean = _sums_of_markers(rows, fits) / np.maximum(fits.sum(axis=1), 1)[:, None, None]
        rows = rows + (1 / centre_scale - 1) * mean[:, None]
    chosen = (rows * fits[..., None, None]).reshape(-1, 8, rows.shape[-1])
    transposed = chosen.swapaxes(1, 2)
    return Sums((transposed @ chosen).sum(axis=0), transposed[:, :3] @ chosen, 2 * int(fits.sum()))


def corner_residuals(
    rows: Float[np.ndarray, "markers 4 2 columns"],
    off_px: Float[np.ndarray, "markers 4 2"],
    fits: Bool[np.ndarray, "markers 4"],
    solution: Solution,
    noise: Noise,
    seen: SeenCorners,
    unmodelled_px: Float[np.ndarray, "markers 4 2 causes"],
) -> CornerResiduals:
    """Sum the corners' own errors, and compare the mean residuals of the markers with their covariance.

    Args:
        rows: (markers, 4, 2, unknowns + 1), the equations.
        off_px: (markers, 4, 2), residuals after the step.
        fits: (markers, 4), True for the corners that were used.
        solution: the step.
        noise: the widened variances of the errors, with which the step was computed.
        seen: markers of the frame, with the stated variances.
        unmodelled_px: (markers, 4, 2, causes), residuals by one standard deviation of what the equations do not have.
    """
    used, count = fits.any(axis=1), fits.sum(axis=1)
    # Sums over corners divided by the root of their number are coordinates along unit vectors.
    root = np.sqrt(np.maximum(count, 1))[:, None]
    mean_px = _sums_of_markers(off_px, fits)[used] / root[used]
    slopes = _sums_of_markers(rows[..., :-1], fits)[used] / root[used, :, None]
    own_px2 = 2 * int(used.sum()) * seen.centre_scale**2 * noise.own_px2
    places_px2 = noise.place_m2 * float((slopes[..., :3] ** 2).sum())
    # The residuals of a generalised least squares fit have the covariance of the errors less that of the fit.
    fitted_px2 = float(np.einsum("mai,ij,maj->", slopes, solution.covariance, slopes))
    others_px2 = float(((_sums_of_markers(unmodelled_px, fits)[used] / root[used, :, None]) ** 2).sum())
    return CornerResiduals(
        max((noise.own_freedom - 2) * noise.own_px2 - PRIOR_RESIDUALS * seen.usual_px**2, 0.0),
        noise.own_freedom - PRIOR_RESIDUALS,
        float((mean_px**2).sum()) / noise.own_px2,
        max(own_px2 + places_px2 + others_px2 - fitted_px2, 0.0) / noise.own_px2,
        places_px2 / (own_px2 + places_px2 + others_px2),
    )


def _sums_of_markers(
    values: Float[np.ndarray, "markers 4 *rest"], fits: Bool[np.ndarray, "markers 4"]
) -> Float[np.ndarray, "markers *rest"]:
    """Sums over the fitting corners of each marker."""
    return np.einsum("mc...,mc->m...", values, fits.astype(float))


def _unit(vectors: Float[np.ndarray, "markers 4 2"]) -> Float[np.ndarray, "markers 4 2"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
