"""Estimation of a camera's pose from the corners of markers in one frame.

The fit starts at the pose of all markers together. Where this pose does not explain most of the markers, some markers
are wrong, and poses of pairs of markers are fitted too (see `initial_poses`); markers in a plane have a second pose.
Likelihoods, and the pose that motion predicts, decide which of the fitted poses is returned.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from math import comb, log, pi

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError
from psotrack.geometry import Camera, undistort
from psotrack.inside_out.pose.equations import SeenCorners, seen_markers
from psotrack.inside_out.pose.fit import Fit, fit
from psotrack.inside_out.pose.initial_poses import LOOSE, mirrored_poses, pose_of_all, poses_of_pairs
from psotrack.inside_out.pose.records import (
    ExpectedMotion,
    ExpectedPose,
    MarkerPose,
    PoseSettings,
    RollingShutter,
)
from psotrack.inside_out.pose.row_motion import RowMotion, UnsureRows, at_rows, row_times_s

#: Number of markers that suffices for a pose; in frames of fewer than eight markers, half of the markers suffice.
_ENOUGH_MARKERS = 4
#: Logarithm of the density of a pose that is not where motion predicts it: in 1 of 1000 frames the camera is anywhere
#: in 1000 m³, in any orientation.
_LOG_UNEXPECTED = -log(1e3 * 1e3 * 8 * pi**2)
#: Velocity (m/s) and turn rate (rad/s) along each axis where nothing is known of the motion, and their changes (m/s²,
#: rad/s²): those of a flight, the middle one of the filter's levels of agility.
_UNKNOWN_MOTION = ExpectedMotion(
    np.zeros(6), np.diag(np.repeat([5.0, 3.0], 3) ** 2.0), np.repeat([5.0, 5.0], 3)
)
#: Factor on the standard deviations of the expected motion, and a deviation that is added, m/s and rad/s, because a
#: frame's own rows shall decide where the motion changes.
_WIDER, _MOTION_STD = 2.0, 0.1
#: Squared Mahalanobis distance of two poses below which they are one pose: χ² with 6 degrees of freedom exceeds it
#: with probability 1/1000.
_SAME = 22.5


def estimate_pose(
    corners_px: Float[np.ndarray, "markers 4 2"],
    corners_m: Float[np.ndarray, "markers 4 3"],
    lens: Camera,
    settings: PoseSettings,
    expected: ExpectedPose | None = None,
    shutter: RollingShutter | None = None,
    motion: ExpectedMotion | None = None,
) -> MarkerPose | None:
    """Estimate the pose of a camera from one frame's markers; whole markers and single corners may be wrong.

    Args:
        corners_px: (markers, 4, 2), corners in the image, pixels.
        corners_m: (markers, 4, 3), the same corners in the world, metres.
        lens: intrinsics of the camera; the pose in it is ignored.
        settings: settings of pose estimation.
        expected: pose that motion predicts; decides between poses that fit about equally well.
        shutter: the rolling shutter, with which the pose is that of the image's middle row; None is a global shutter.
        motion: expected motion during the frame; None if nothing is known of the motion. A global shutter does not use
            it.

    Returns:
        The pose; None where there are too few markers, or no pose explains the markers.

    Raises:
        InputError: a coordinate is not finite.
    """
    if not (np.isfinite(corners_px).all() and np.isfinite(corners_m).all()):
        raise InputError("corners", expected="finite coordinates", found="NaN or infinity")
    rays = undistort(lens, np.asarray(corners_px, np.float64))
    is_shown = np.isfinite(rays).all(axis=(1, 2))
    if not is_shown.all():
        # A marker where the lens model shows nothing counts as not seen.
        pose = estimate_pose(
            corners_px[is_shown], corners_m[is_shown], lens, settings, expected, shutter, motion
        )
        return None if pose is None else _among_all(pose, is_shown)
    if len(corners_px) < settings.min_markers:
        return None
    rows, unsure = _row_times(corners_px, lens, shutter, motion)
    if rows is not None:
        rays = _at_reference_row(rays, rows)
    corners = seen_markers(
        np.asarray(corners_px, np.float64),
        np.asarray(corners_m, np.float64),
        lens,
        settings.noise_px,
        settings.place_m,
        settings.map_error_m,
        settings.focal_error,
    )
    usual_place_m = float(np.hypot(settings.usual_place_m or settings.place_m, settings.map_error_m))
    corners = replace(
        corners,
        rows=rows,
        unsure=unsure,
        centre_scale=settings.centre_scale or 1.0,
        shift_px=settings.shift_px,
        usual_place_m=usual_place_m,
        map_share=(settings.map_error_m / usual_place_m) ** 2,
        usual_px=settings.usual_px or settings.noise_px,
    )
    poses = _likely_poses(corners, rays)
    # One or two of many markers may agree by chance, because every single marker has a pose that explains this marker.
    poses = [pose for pose in poses if pose.used.sum() >= min(_ENOUGH_MARKERS, len(corners_px) / 2)]
    if not poses:
        return None
    log_likelihood = np.array([pose.log_evidence + _log_prior(pose, expected) for pose in poses])
    best = poses[log_likelihood.argmax()]
    odds = np.exp(np.sort(log_likelihood - log_likelihood.max()))[-2:-1].sum()
    return MarkerPose(
        best.position_m,
        best.R_world_cam,
        best.covariance,
        best.used,
        best.reprojection_px,
        float(odds / (1 + odds)),
        best.common,
        _chance(corners, best),
        best.residuals,
        best.motion,
        best.by_line_time,
    )


def _row_times(
    corners_px: Float[np.ndarray, "markers 4 2"],
    lens: Camera,
    shutter: RollingShutter | None,
    expected: ExpectedMotion | None,
) -> tuple[RowMotion | None, UnsureRows | None]:
    """Times of the corners' rows, and the uncertainty of these times; None for what a shutter does not have."""
    if shutter is None:
        return None, None
    rows = unsure = None
    motion = expected or _UNKNOWN_MOTION
    if shutter.line_time_s:
        time_s = row_times_s(corners_px, lens, shutter.line_time_s)
        covariance = motion.covariance
        if expected is not None:
            covariance = _WIDER**2 * covariance + _MOTION_STD**2 * np.eye(6)
        rows = RowMotion(time_s, motion.motion, np.linalg.inv(covariance), motion.acceleration_std)
    if shutter.std_s:
        unsure = UnsureRows(row_times_s(corners_px, lens, shutter.std_s), motion.motion, motion.covariance)
    return rows, unsure


def _at_reference_row(
    rays: Float[np.ndarray, "markers 4 2"], rows: RowMotion
) -> Float[np.ndarray, "markers 4 2"]:
    """Rays turned by the expected turn between the rows, for initial poses."""
    turned = at_rows(rows.time_s.ravel(), rows.expected).R_reference_row
    along = turned @ np.append(rays, np.ones((*rays.shape[:2], 1)), axis=-1).reshape(-1, 3, 1)
    return (along[:, :2, 0] / np.maximum(along[:, 2], 1e-9)).reshape(rays.shape)


def _among_all(pose: MarkerPose, is_shown: Bool[np.ndarray, " markers"]) -> MarkerPose:
    """The pose from some of the markers as a pose from all markers; the others are unused and have no errors."""
    used = np.zeros(len(is_shown), bool)
    used[is_shown] = pose.used
    if not pose.common.size:
        return replace(pose, used=used)

    def widened(common: Float[np.ndarray, "unknowns errors"]) -> Float[np.ndarray, "unknowns others"]:
        others = common.shape[1] - 3 * int(is_shown.sum())
        wide = np.zeros((len(common), 3 * len(is_shown) + others))
        wide[:, np.append(np.repeat(is_shown, 3), np.ones(others, bool))] = common
        return wide

    motion = pose.motion and replace(pose.motion, common=widened(pose.motion.common))
    return replace(pose, used=used, common=widened(pose.common), motion=motion)


def _chance(corners: SeenCorners, best: Fit) -> float:
    """Expected number of sets of markers, as large as the used set, that agree by chance.

    Markers agree if all but one fall near their projections. The number is an upper bound on the probability, because
    the sizes and orientations of the markers, which would have to agree too, are left out.
    """
    count, others = len(best.used), int(best.used.sum()) - 1
    near_px = LOOSE * max(corners.noise_px, best.reprojection_px)
    area_px2 = np.prod(np.asarray(corners.lens.image_size_wh, float))
    return min(float(count * comb(count - 1, others) * min(pi * near_px**2 / area_px2, 1.0) ** others), 1.0)


def _likely_poses(corners: SeenCorners, rays: Float[np.ndarray, "markers 4 2"]) -> list[Fit]:
    """Different poses that explain all markers or a part of the markers, the most likely pose first."""
    found = _distinct(fit(corners, *pose) for pose in pose_of_all(corners, rays))
    # If all markers agree, or at least three markers and more than half of all, no other pose explains an equal number.
    enough, near_px = min(max(3, len(rays) // 2 + 1), len(rays)), LOOSE * corners.noise_px
    if not found or found[0].used.sum() < enough or found[0].reprojection_px > near_px:
        by_pairs = poses_of_pairs(corners, rays)
        found = _distinct([*found, *(fit(corners, *pose, fits) for pose, fits in by_pairs)])
    mirrored = [
        fit(corners, *pose, best.fits) for best in found for pose in mirrored_poses(corners, rays, best)
    ]
    return _distinct([*found, *mirrored])


def _distinct(fits: Iterable[Fit | None]) -> list[Fit]:
    """Fits, the most likely first, without fits of the same pose as a more likely fit."""
    found: list[Fit] = []
    for pose in sorted((pose for pose in fits if pose is not None), key=lambda pose: -pose.log_evidence):
        if not any(
            _mahalanobis2(pose, other.position_m, other.R_world_cam, other.covariance)[0] < _SAME
            for other in found
        ):
            found.append(pose)
    return found


def _mahalanobis2(
    pose: Fit,
    position_m: Float[np.ndarray, "3"],
    R_world_cam: Float[np.ndarray, "3 3"],
    covariance: Float[np.ndarray, "6 6"],
) -> tuple[float, float]:
    """Squared Mahalanobis distance of two poses, and the log determinant of the sum of their covariances."""
    turn = Rotation.from_matrix(R_world_cam.T @ pose.R_world_cam).as_rotvec()
    apart = np.concatenate([pose.position_m - position_m, turn])
    both = pose.covariance + covariance
    try:
        return float(apart @ np.linalg.solve(both, apart)), float(np.linalg.slogdet(both)[1])
    except np.linalg.LinAlgError:
        # Both poses are certain in some direction: they are different.
        return np.inf, 0.0


def _log_prior(pose: Fit, expected: ExpectedPose | None) -> float:
    """Log density of a pose given the pose that motion predicts."""
    if expected is None:
        return 0.0
    square, log_determinant = _mahalanobis2(
        pose, expected.position_m, expected.R_world_cam, expected.covariance
    )
    return float(np.logaddexp(-0.5 * (square + log_determinant + 6 * log(2 * pi)), _LOG_UNEXPECTED))
