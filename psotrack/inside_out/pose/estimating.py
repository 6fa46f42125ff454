"""Estimation of a camera's pose from the corners of markers in one frame.

The fit starts at the pose of all markers together. Where this pose does not explain most of the markers, some markers
are wrong, and poses of pairs of markers are fitted too (see `initial_poses`); markers in a plane have a second pose.
Likelihoods, and the pose that motion predicts, decide which of the fitted poses is returned.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from math import log, pi

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError
from psotrack.geometry import Camera, undistort
from psotrack.inside_out.pose.equations import SeenMarkers
from psotrack.inside_out.pose.fit import fit
from psotrack.inside_out.pose.initial_poses import mirrored_poses, near_px, pose_of_all, poses_of_pairs
from psotrack.inside_out.pose.records import CameraPose, CornerNoise, MarkerPose, PoseSettings

#: Number of markers that suffices for a pose; in frames of fewer than eight markers, half of the markers suffice.
_ENOUGH_MARKERS = 4
#: Standard deviation of a corner whose detection states none, and the smallest that is believed, pixels.
_UNKNOWN_STD_PX, _LEAST_STD_PX = 0.2, 0.02
#: Logarithm of the density of a pose that is not where motion predicts it: in 1 of 1000 frames the camera is anywhere
#: in 1000 m³, in any orientation.
_LOG_UNEXPECTED = -log(1e3 * 1e3 * 8 * pi**2)
#: Squared Mahalanobis distance of two poses below which they are one pose: χ² with 6 degrees of freedom exceeds it
#: with probability 1/1000.
_SAME = 22.5


def estimate_pose(
    corners_px: Float[np.ndarray, "markers 4 2"],
    corners_m: Float[np.ndarray, "markers 4 3"],
    lens: Camera,
    settings: PoseSettings,
    expected: CameraPose | None = None,
    *,
    std_px: Float[np.ndarray, " markers"] | None = None,
    map_std_m: Float[np.ndarray, " markers"] | None = None,
) -> MarkerPose | None:
    """Estimate the pose of a camera from one frame's markers; whole markers and single corners may be wrong.

    Args:
        corners_px: (markers, 4, 2), corners in the image, pixels.
        corners_m: (markers, 4, 3), the same corners in the world, metres.
        lens: intrinsics of the camera; the pose in it is ignored.
        settings: settings of pose estimation.
        expected: pose that motion predicts; decides between poses that fit about equally well.
        std_px: (markers,), standard deviation of a corner along x and along y by its detection, pixels; NaN or None
            where it is unknown.
        map_std_m: (markers,), standard deviation of a marker's place in the map along each axis, metres; 0 or None
            where it is unknown.

    Returns:
        The pose; None where there are too few markers, or no pose explains the markers.

    Raises:
        InputError: a coordinate is not finite.
    """
    if not (np.isfinite(corners_px).all() and np.isfinite(corners_m).all()):
        raise InputError("corners", expected="finite coordinates", found="NaN or infinity")
    count, noise = len(corners_px), settings.noise or CornerNoise()
    std_px = np.full(count, np.nan) if std_px is None else std_px
    std_px = np.where(np.isfinite(std_px), np.maximum(std_px, _LEAST_STD_PX), _UNKNOWN_STD_PX)
    map_std_m = np.zeros(count) if map_std_m is None else map_std_m
    map_std_m = np.where(map_std_m > 0, map_std_m, settings.map_error_m)
    rays = undistort(lens, np.asarray(corners_px, np.float64))
    # A marker where the lens model shows nothing counts as not seen.
    shown = np.isfinite(rays).all(axis=(1, 2))
    if shown.sum() < settings.min_markers:
        return None
    seen = SeenMarkers(
        np.asarray(corners_px, np.float64)[shown],
        rays[shown],
        np.asarray(corners_m, np.float64)[shown],
        lens,
        noise.scale * std_px[shown],
        noise.place_m,
        map_std_m[shown],
        settings.focal_error,
    )
    # One or two of many markers may agree by chance, because every single marker has a pose that explains this marker.
    least = min(_ENOUGH_MARKERS, shown.sum() / 2)
    poses = [pose for pose in _likely_poses(seen) if pose.used.sum() >= least]
    if not poses:
        return None
    log_likelihood = np.array([pose.log_evidence + _log_prior(pose, expected) for pose in poses])
    best = poses[log_likelihood.argmax()]
    odds = np.exp(np.sort(log_likelihood - log_likelihood.max()))[-2:-1].sum()
    used = np.zeros(count, bool)
    used[shown] = best.used
    return replace(best, used=used, ambiguity=float(odds / (1 + odds)))


def _likely_poses(seen: SeenMarkers) -> list[MarkerPose]:
    """Different poses that explain all markers or a part of the markers, the most likely pose first."""
    found = _distinct(fit(seen, *pose) for pose in pose_of_all(seen))
    # If all markers agree, or at least three markers and more than half of all, no other pose explains an equal number.
    count = len(seen.rays)
    enough = min(max(3, count // 2 + 1), count)
    if not found or found[0].used.sum() < enough or found[0].reprojection_px > near_px(seen).mean():
        by_pairs = poses_of_pairs(seen)
        found = _distinct([*found, *(fit(seen, *pose, fits) for pose, fits in by_pairs)])
    mirrored = [fit(seen, *pose, best.fits) for best in found for pose in mirrored_poses(seen, best)]
    return _distinct([*found, *mirrored])


def _distinct(fits: Iterable[MarkerPose | None]) -> list[MarkerPose]:
    """Fits, the most likely first, without fits of the same pose as a more likely fit."""
    found: list[MarkerPose] = []
    for pose in sorted((pose for pose in fits if pose is not None), key=lambda pose: -pose.log_evidence):
        if not any(_mahalanobis2(pose, other)[0] < _SAME for other in found):
            found.append(pose)
    return found


def _mahalanobis2(pose: MarkerPose, other: CameraPose) -> tuple[float, float]:
    """Squared Mahalanobis distance of two poses, and the log determinant of the sum of their covariances."""
    turn = Rotation.from_matrix(other.R_world_cam.T @ pose.R_world_cam).as_rotvec()
    apart = np.concatenate([pose.position_m - other.position_m, turn])
    both = pose.covariance + other.covariance
    return float(apart @ np.linalg.solve(both, apart)), float(np.linalg.slogdet(both)[1])


def _log_prior(pose: MarkerPose, expected: CameraPose | None) -> float:
    """Log density of a pose given the pose that motion predicts."""
    if expected is None:
        return 0.0
    square, log_determinant = _mahalanobis2(pose, expected)
    return float(np.logaddexp(-0.5 * (square + log_determinant + 6 * log(2 * pi)), _LOG_UNEXPECTED))
