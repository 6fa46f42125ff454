"""Offsets between the clocks of cameras, from the motion of drones that several cameras see.

A video that shows the scene late shows a drone where the drone was when the other cameras exposed the same frame: its
detection is off the epipolar lines by the drone's motion in the image times the delay. The offsets of all cameras and
the points in space are estimated together by Gauss-Newton steps in which the points are eliminated
(`psotrack.geometry.estimation`), until the offsets settle. Each detection is weighted by how well it fits (S. Geman and
D. E. McClure, Statistical Methods for Tomographic Image Reconstruction, 1987).

Errors of neighbouring frames are not independent: the middle of a drone's box is off in nearly the same way for as long
as the drone flies in the same attitude. The standard deviations are therefore those of a block jackknife.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import correlate1d

from psotrack.errors import SettingsError, check_positive
from psotrack.geometry import (
    MAX_CONDITION,
    Camera,
    Rig,
    has_image,
    project_with_jacobian,
    to_camera,
    triangulate_linearly,
)
from psotrack.geometry.estimation import cauchy_weight
from psotrack.support import block_jackknife, time_blocks, widening

#: Number of rounds without a step until the weights have settled, and largest number of steps.
_WEIGHT_ROUNDS, _MAX_STEPS = 5, 35
#: The iteration ends when no offset changes by more than this, frames.
_SETTLED = 1e-4
#: A detection at this multiple of the median distance has a weight of 1/4.
_MEDIANS = 3.0
#: Smallest median distance that is used for the weights, pixels: exact detections would have a median of 0.
_MIN_MEDIAN_PX = 0.1
#: A velocity is the slope of a straight line through the points at most this far away in time, seconds.
_REACH_S = 0.25
#: A velocity counts only beyond this multiple of its standard deviation: the noise of a hovering drone is not motion.
_CLEARLY = 3.0
#: Smallest curvature of the robust cost, as a share of the curvature of weighted least squares.
_MIN_CURVATURE = 0.3
#: An offset is shown if its standard deviation is below this fraction of that of its prior distribution.
_SHOWN = 0.1
#: Smallest number of degrees of freedom of the jackknife: of fewer, standard deviations are infinite.
_LEAST_FREEDOM = 0.5


@dataclass(frozen=True)
class CameraOffsets:
    """Offsets between the clocks of cameras.

    Attributes:
        offset_frames: (cameras,), frames: a camera exposed its frame k at time k + offset of the common clock, as a
            `time_offset_s` says it. The mean of the offsets that the detections show is 0.
        std_frames: (cameras,), standard deviations of the offsets, frames; near `max_offset_frames` for a camera whose
            detections do not show its offset.
        white_std_frames: (cameras,), the same if the errors of all detections were independent.
        shown: (cameras,), whether the detections show the offset at all.
    """

    offset_frames: Float[np.ndarray, "cameras"]
    std_frames: Float[np.ndarray, "cameras"]
    white_std_frames: Float[np.ndarray, "cameras"]
    shown: Bool[np.ndarray, "cameras"]


def camera_offsets(
    rig: Rig,
    points_px: Float[np.ndarray, "frames drones cameras 2"],
    fps: float,
    *,
    max_offset_frames: float = 5.0,
) -> CameraOffsets:
    """Estimate the offset of each camera's clock, in fractions of a frame, from matched detections.

    If all drones hover, or a camera has no detections, the offset stays near 0 and its standard deviation near
    `max_offset_frames`, which are the values of the prior distribution.

    The standard deviations include errors that are correlated in time, as far as the residuals show them. They do not
    include an error that always points along the motion, because such an error looks like an offset of the clock.

    Args:
        rig: the calibrated cameras.
        points_px: (frames, drones, cameras, 2), detections, pixels; NaN where a camera does not see a drone.
            Detections are interpolated between neighbouring frames only.
        fps: frames per second of the videos.
        max_offset_frames: standard deviation of the offsets' prior distribution, and largest offset, frames.

    Raises:
        SettingsError: `fps` or `max_offset_frames` is not above 0, or `points_px` has another number of cameras than
            the rig.
    """
    check_positive("fps", fps)
    check_positive("max_offset_frames", max_offset_frames)
    if points_px.shape[2] != len(rig):
        raise SettingsError("points_px", expected=f"{len(rig)} cameras", found=f"{points_px.shape[2]}")
    reach, zero_frames = max(1, round(_REACH_S * fps)), np.zeros(len(rig))
    system = _linearise(rig.cameras, points_px, reach, zero_frames, np.ones(points_px.shape[:-1]))
    # Offsets are not changed before the weights have excluded the outliers.
    for _ in range(_WEIGHT_ROUNDS):
        system = _linearise(rig.cameras, points_px, reach, zero_frames, system.weights)
    for _ in range(_MAX_STEPS):
        last_frames, moved_frames = system.offset_frames, system.moved_frames(max_offset_frames)
        system = _linearise(rig.cameras, points_px, reach, moved_frames, system.weights)
        if np.abs(moved_frames - last_frames).max() < _SETTLED:
            break
    std_frames, white_std_frames = _standard_deviations(system, max_offset_frames)
    shown = white_std_frames < _SHOWN * max_offset_frames
    return CameraOffsets(system.offset_frames, std_frames, white_std_frames, shown)


@dataclass(frozen=True)
class _System:
    """Normal equations at given offsets with the points eliminated.

    Attributes:
        offset_frames: (cameras,), offsets at which the problem was linearised, frames.
        normal: (frames, drones, cameras, cameras), left side of each drone, squared pixels per squared frame.
        gradient: (frames, drones, cameras), right side of each drone, squared pixels per frame.
        weights: (frames, drones, cameras), weights of the detections; 0 where there is no detection.
        variance_px2: variance of one coordinate of a detection, squared pixels.
    """

    offset_frames: Float[np.ndarray, "cameras"]
    normal: Float[np.ndarray, "frames drones cameras cameras"]
    gradient: Float[np.ndarray, "frames drones cameras"]
    weights: Float[np.ndarray, "frames drones cameras"]
    variance_px2: float

    def mean_of(self, limit_frames: float) -> Float[np.ndarray, "cameras"]:
        """(cameras,), weights of the mean of the offsets: alike for the cameras whose offsets the detections show."""
        information = np.einsum("fdcc->c", self.normal) / self.variance_px2
        shown = information * (_SHOWN * limit_frames) ** 2 > 1
        shown |= ~shown.any()
        return shown / shown.sum()

    def moved_frames(self, limit_frames: float) -> Float[np.ndarray, "cameras"]:
        """Offsets after a step with the prior, within their limit, and with a mean of 0."""
        stiffness = self.variance_px2 / limit_frames**2
        normal = self.normal.sum(axis=(0, 1)) + stiffness * np.eye(len(self.offset_frames))
        right = self.gradient.sum(axis=(0, 1)) - stiffness * self.offset_frames
        offset_frames = self.offset_frames + np.linalg.solve(normal, right)
        offset_frames = np.clip(offset_frames, -limit_frames, limit_frames)
        return offset_frames - self.mean_of(limit_frames) @ offset_frames


def _linearise(
    cameras: Camera,
    points_px: Float[np.ndarray, "frames drones cameras 2"],
    reach: int,
    offset_frames: Float[np.ndarray, "cameras"],
    weights: Float[np.ndarray, "frames drones cameras"],
) -> _System:
    """Linearise |e - u δ - J ΔX|², where δ are changes of the offsets, ΔX changes of the points, and u = J V.

    V are the velocities of the points, and e the detections minus the projections. `weights` are those of the previous
    round, for the triangulation.
    """
    seen_px = _interpolate_at_common_times(points_px, offset_frames)
    point_m = triangulate_linearly(cameras, seen_px, np.maximum(weights, 1e-9))
    places_m = np.nan_to_num(point_m)[:, :, None]
    pixels, _, J = project_with_jacobian(cameras, places_m)
    e = seen_px - pixels
    there = (
        np.isfinite(e).all(axis=-1)
        & has_image(cameras, to_camera(cameras, places_m))
        & np.isfinite(point_m).all(axis=-1)[..., None]
    )
    there &= there.sum(axis=-1, keepdims=True) >= 2
    e = np.where(there[..., None], e, 0.0)
    weights = _robust_weights(e, there)
    weighted = weights[..., None, None] * J
    # The cameras' equations on one axis, so that sums over it are products of matrices.
    sides = (*e.shape[:2], 2 * e.shape[2], 3)
    equations, weighted_equations = J.reshape(sides), weighted.reshape(sides)
    point_normal = weighted_equations.swapaxes(-1, -2) @ equations
    values = np.linalg.eigvalsh(point_normal)
    known = values[..., -1] < MAX_CONDITION * values[..., 0]
    point_normal = np.where(known[..., None, None], point_normal, np.eye(3))
    squares, total = float((weights * (e**2).sum(axis=-1)).sum()), float(weights.sum())
    # Each triangulated point uses up three degrees of freedom.
    freedom = 2 * total - 3 * float((weights.max(axis=-1) * known).sum())
    # Detections without any error, as of a simulation, would leave the prior no weight: at least (0.001 px)².
    variance_px2 = squares / max(freedom, 1.0) + 1e-6

    inverse = np.linalg.inv(point_normal)
    spread_m2 = np.where(known, variance_px2 * np.trace(inverse, axis1=-2, axis2=-1), np.inf)
    velocity_m, noise_m2 = _fit_velocities(point_m, spread_m2, reach)
    moving = known & ((velocity_m**2).sum(axis=-1) > _CLEARLY**2 * noise_m2)
    u = np.matvec(equations, np.where(moving[..., None], velocity_m, 0.0)).reshape(e.shape)
    coupling = np.vecmat(u, weighted).swapaxes(-1, -2)
    gain = inverse @ coupling
    normal = -(coupling.swapaxes(-1, -2) @ gain)
    index = np.arange(len(offset_frames))
    normal[:, :, index, index] += weights * np.vecdot(u, u)
    moved = np.vecmat(e.reshape(equations.shape[:-1]), weighted_equations)
    gradient = weights * np.vecdot(u, e) - np.vecmat(moved, gain)
    return _System(offset_frames, normal, gradient, weights, variance_px2)


def _robust_weights(
    e: Float[np.ndarray, "frames drones cameras 2"], there: np.ndarray
) -> Float[np.ndarray, "frames drones cameras"]:
    """Geman-McClure weights of the detections, (1 + (distance / scale)²)⁻²; 0 where there is no detection."""
    distance_px = np.linalg.norm(e, axis=-1)
    # Two rays nearly always meet, so the distances of points that only two cameras see do not show the noise.
    checked = there & (there.sum(axis=-1, keepdims=True) >= 3)
    checked = checked if checked.any() else there
    median_px = float(np.median(distance_px[checked])) if checked.any() else 0.0
    scale_px = _MEDIANS * max(median_px, _MIN_MEDIAN_PX)
    return there * cauchy_weight((distance_px / scale_px) ** 2) ** 2


def _interpolate_at_common_times(
    points_px: Float[np.ndarray, "frames drones cameras 2"], offset: Float[np.ndarray, "cameras"]
) -> Float[np.ndarray, "frames drones cameras 2"]:
    """Interpolate each camera's detections at whole frames k of the common clock: at k - offset of its own clock."""
    own_time = np.arange(len(points_px))[:, None] - offset
    before = np.floor(own_time).astype(int)
    share = (own_time - before)[:, None, :, None]
    rows, columns = np.clip(before, 0, len(points_px) - 1), np.arange(len(offset))
    next_rows = np.clip(before + (share[:, 0, :, 0] > 0), 0, len(points_px) - 1)
    # Index arrays that a slice separates put their axes first: (frames, cameras, drones, 2).
    first_px, second_px = (points_px[row, :, columns].swapaxes(1, 2) for row in (rows, next_rows))
    inside = (own_time >= 0) & (own_time <= len(points_px) - 1)
    return np.where(inside[:, None, :, None], (1 - share) * first_px + share * second_px, np.nan)


def _fit_velocities(
    point_m: Float[np.ndarray, "frames drones 3"], spread_m2: Float[np.ndarray, "frames drones"], reach: int
) -> tuple[Float[np.ndarray, "frames drones 3"], Float[np.ndarray, "frames drones"]]:
    """Fit a straight line through the points near each frame: velocities, metres per frame, and their variances.

    Args:
        point_m: (frames, drones, 3), points, metres.
        spread_m2: (frames, drones), variances of the points, square metres; infinite where there is no point.
        reach: number of frames before and after a frame through which the line is fitted.
    """
    steps = np.arange(-reach, reach + 1.0)

    def around(values: np.ndarray, power: int) -> np.ndarray:
        """Sums of values over the frames near each frame, times a power of their distance in time."""
        return correlate1d(values, steps**power, axis=0, mode="constant")

    weight = 1 / spread_m2
    weighted_m = weight[..., None] * np.nan_to_num(point_m)
    total, first, second = (around(weight, power) for power in (0, 1, 2))
    # The weighted mean time of each window, and the weighted sum of squares about this mean.
    middle = first / np.maximum(total, 1e-300)
    squares = second - first * middle
    pull = around(weighted_m, 1) - middle[..., None] * around(weighted_m, 0)
    known = squares > 1e-9 * np.maximum(second, 1e-300)
    squares = np.where(known, squares, 1.0)
    return np.where(known[..., None], pull / squares[..., None], 0.0), np.where(known, 1 / squares, np.inf)


def _standard_deviations(
    system: _System, max_offset_frames: float
) -> tuple[Float[np.ndarray, "cameras"], Float[np.ndarray, "cameras"]]:
    """Standard deviations of the offsets by a block jackknife, the step that is left without each block; and the same
    for independent errors."""
    w, prior = system.weights, np.eye(len(system.offset_frames)) / max_offset_frames**2
    # The Geman-McClure cost has less curvature than least squares with the fixed weights w: its second derivatives are
    # w (4 √w - 3) along the residual and w across it.
    curvature = max(float((w * (2 * np.sqrt(w) - 1)).sum() / max(w.sum(), 1e-12)), _MIN_CURVATURE)
    normal, gradient = curvature * system.normal / system.variance_px2, system.gradient / system.variance_px2
    block = time_blocks(np.asarray((w > 0).any(axis=-1)))
    block_normal = np.array([normal[block == one].sum(axis=0) for one in range(block.max(initial=0) + 1)])
    block_gradient = np.array([gradient[block == one].sum(axis=0) for one in range(len(block_normal))])
    information = np.diagonal(block_normal, axis1=-2, axis2=-1)
    weight = information.sum(axis=-1)
    used = weight > 1e-6 * weight.sum()
    total = block_normal.sum(axis=0) + prior
    left_out = np.linalg.solve(total - block_normal[used], -block_gradient[used][..., None])[..., 0]
    mean = system.mean_of(max_offset_frames)
    left_out -= (left_out @ mean)[:, None]
    variance = np.zeros(len(prior))
    if used.sum() > 1:
        freedom = information.sum(axis=0) ** 2 / np.maximum((information**2).sum(axis=0), 1e-300) - 1
        spread = np.diag(block_jackknife(np.zeros(len(prior)), left_out, weight[used]))
        variance = spread * widening(np.maximum(freedom, _LEAST_FREEDOM)) ** 2
    # Where nothing moves, the prior alone is known. The mean of the offsets is 0.
    centred = np.eye(len(mean)) - mean
    inverse = centred @ np.linalg.inv(total) @ centred.T
    white = np.diag(inverse)
    by_prior = np.einsum("kb,bc,kc->k", inverse, prior, inverse)
    # Few blocks know the variance of one camera badly: how far errors are correlated is the mean of all cameras.
    shown = information.sum(axis=0) > np.diag(prior)
    ratio = (variance[shown] / white[shown]).mean() if shown.any() else 0.0
    return np.sqrt(np.where(shown, ratio * white, variance) + by_prior), np.sqrt(white)
