"""Offsets between the clocks of cameras, from the motion of drones that several of them see.

A camera that is late sees a drone where the others will see it: off its epipolar lines by the drone's motion in the
image times the delay. The offsets of all cameras and the points in space are solved for together, linearised
(Gauss-Newton) and with the points eliminated (Schur complement), until nothing changes. Detections count by how well
they fit (S. Geman and D. E. McClure, Statistical Methods for Tomographic Image Reconstruction, 1987).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.errors import SettingsError, check_positive
from psotrack.geometry import MAX_CONDITION, NEAR_M, Camera, CameraRig, project_with_jacobian, triangulate
from psotrack.support import standard_error

#: Rounds at most, those that the weights take to settle, and the change in frames that is none.
_ROUNDS, _LEAST_ROUNDS, _SETTLED = 40, 6, 1e-4
#: A detection that is off by this many medians counts a quarter; medians below a tenth of a pixel are none.
_MEDIANS, _LEAST_MEDIAN_PX = 3.0, 0.1
#: Velocities are slopes of straight lines through what is so near in time, and none where they are not beyond as many
#: standard deviations: the noise of a drone that hovers is no motion.
_REACH_S, _CLEARLY = 0.25, 3.0


@dataclass(frozen=True)
class CameraOffsets:
    """When cameras took their frames.

    Attributes:
        offset_frames: (cameras,), a camera's frame k was taken at k + offset, where the cameras' mean is 0: a camera
            with an offset above 0 is late.
        std_frames: (cameras,), standard deviations; near `max_offset_frames` of a camera that nothing is known of.
        rms_before_px: root mean square distance of detections from projections, without offsets, those counting little
            that fit nothing; NaN where no point is seen by two cameras.
        rms_after_px: the same with the offsets.
    """

    offset_frames: Float[np.ndarray, "cameras"]
    std_frames: Float[np.ndarray, "cameras"]
    rms_before_px: float
    rms_after_px: float


def camera_offsets(
    rig: CameraRig,
    points_px: Float[np.ndarray, "frames drones cameras 2"],
    fps: float,
    *,
    max_offset_frames: float = 5.0,
) -> CameraOffsets:
    """How late each camera is, in fractions of a frame, from detections that belong together.

    Nothing is refused: of drones that hover, or of a camera without detections, the offset stays near 0 and its
    standard deviation near `max_offset_frames`, which is what was expected to begin with. Errors of detections that
    change with the motion are not in the standard deviations: middles of silhouettes leave a tenth of a frame.

    Args:
        rig: the calibrated cameras.
        points_px: (frames, drones, cameras, 2), NaN where a drone is not seen. Detections are interpolated between
            neighbouring frames only.
        fps: frames per second.
        max_offset_frames: standard deviation of offsets before anything is known, and their limit.

    Raises:
        SettingsError: `fps` or `max_offset_frames` is not above 0, or the cameras are not those of the rig.
    """
    check_positive("fps", fps)
    check_positive("max_offset_frames", max_offset_frames)
    if points_px.shape[2] != len(rig):
        raise SettingsError("points_px", expected=f"{len(rig)} cameras", found=f"{points_px.shape[2]}")
    reach = max(1, round(_REACH_S * fps))
    offset = np.zeros(len(rig))
    weights = np.ones(points_px.shape[:-1])
    rms_before_px = np.nan
    for number in range(_ROUNDS):
        system = _linearised(rig.cameras, _at_common_times(points_px, offset), weights, reach)
        weights = system.weights
        if number < _LEAST_ROUNDS - 1:
            # No step before it is known which detections count.
            rms_before_px = system.rms_px
            continue
        stiffness = system.variance_px2 / max_offset_frames**2
        normal = system.normal + stiffness * np.eye(len(rig))
        step = np.linalg.solve(normal, system.gradient.sum(axis=0) - stiffness * offset)
        previous, offset = offset, np.clip(offset + step, -max_offset_frames, max_offset_frames)
        offset -= offset.mean()
        if np.abs(offset - previous).max() < _SETTLED:
            break
    std = _standard_deviations(system, max_offset_frames)
    return CameraOffsets(offset, std, rms_before_px, system.rms_px)


@dataclass(frozen=True)
class _System:
    """Normal equations of the offsets, the points eliminated, and what they were made from.

    Attributes:
        normal: (cameras, cameras), pixels squared per frame squared.
        gradient: (frames, cameras), of each frame.
        weights: (frames, drones, cameras), how much each detection counts; 0 where there is none.
        variance_px2: of a coordinate of a detection that fits.
        rms_px: of the distances, weighted.
    """

    normal: Float[np.ndarray, "cameras cameras"]
    gradient: Float[np.ndarray, "frames cameras"]
    weights: Float[np.ndarray, "frames drones cameras"]
    variance_px2: float
    rms_px: float


def _linearised(
    cameras: Camera,
    seen_px: Float[np.ndarray, "frames drones cameras 2"],
    weights: Float[np.ndarray, "frames drones cameras"],
    reach: int,
) -> _System:
    """Least squares of |e - u δ - J ΔX| over the offsets' changes δ and the points', with u = J V."""
    point_m = triangulate(cameras, seen_px, np.maximum(weights, 1e-9))
    pixels, depth, J = project_with_jacobian(cameras, np.nan_to_num(point_m)[:, :, None])
    e = seen_px - pixels
    there = np.isfinite(e).all(axis=-1) & (depth > NEAR_M) & np.isfinite(point_m).all(axis=-1)[..., None]
    there &= there.sum(axis=-1, keepdims=True) >= 2
    e = np.where(there[..., None], e, 0.0)
    weights = _fitting(e, there)
    of_points = np.einsum("fdc,fdcik,fdcil->fdkl", weights, J, J)
    known = np.linalg.cond(of_points) < MAX_CONDITION
    inverse = np.linalg.inv(np.where(known[..., None, None], of_points, np.eye(3)))
    squares, total = float((weights * (e**2).sum(axis=-1)).sum()), float(weights.sum())
    # Each point takes three of its coordinates.
    free = 2 * total - 3 * float((weights.max(axis=-1) * known).sum())
    variance_px2 = squares / max(free, 1.0) + 1e-12

    spread_m2 = np.where(known, variance_px2 * np.trace(inverse, axis1=-2, axis2=-1), np.inf)
    velocity_m, noise_m2 = _slopes(point_m, spread_m2, reach)
    moving = known & ((velocity_m**2).sum(axis=-1) > _CLEARLY**2 * noise_m2)
    u = np.einsum("fdcij,fdj->fdci", J, np.where(moving[..., None], velocity_m, 0.0))
    B = np.einsum("fdc,fdcik,fdci->fdck", weights, J, u)
    B_inverse = np.einsum("fdck,fdkl->fdcl", B, inverse)
    pull = np.einsum("fdc,fdcik,fdci->fdk", weights, J, e)
    normal = -np.einsum("fdcl,fdbl->cb", B_inverse, B)
    normal[np.diag_indices(len(normal))] += np.einsum("fdc,fdci,fdci->c", weights, u, u)
    gradient = np.einsum("fdc,fdci,fdci->fc", weights, u, e) - np.einsum("fdcl,fdl->fc", B_inverse, pull)
    return _System(normal, gradient, weights, variance_px2, np.sqrt(squares / total) if total else np.nan)


def _fitting(
    e: Float[np.ndarray, "frames drones cameras 2"], there: np.ndarray
) -> Float[np.ndarray, "frames drones cameras"]:
    """How much detections count, (1 + (distance / scale)²)⁻², 0 where there are none."""
    distance_px = np.linalg.norm(e, axis=-1)
    # Two rays nearly always meet: distances of two views say little.
    telling = there & (there.sum(axis=-1, keepdims=True) >= 3)
    telling = telling if telling.any() else there
    median_px = float(np.median(distance_px[telling])) if telling.any() else 0.0
    scale_px = _MEDIANS * max(median_px, _LEAST_MEDIAN_PX)
    return there / (1 + (distance_px / scale_px) ** 2) ** 2


def _at_common_times(
    points_px: Float[np.ndarray, "frames drones cameras 2"], offset: Float[np.ndarray, "cameras"]
) -> Float[np.ndarray, "frames drones cameras 2"]:
    """What each camera would have seen at whole frames of the common clock: at k - offset of its own."""
    own = np.arange(len(points_px))[:, None] - offset
    before = np.floor(own).astype(int)
    share = (own - before)[:, None, :, None]
    rows, columns = np.clip(before, 0, len(points_px) - 1), np.arange(len(offset))
    next_rows = np.clip(before + (share[:, 0, :, 0] > 0), 0, len(points_px) - 1)
    # Indices that are apart put their axis first: (frames, cameras, drones, 2).
    first_px, second_px = (points_px[row, :, columns].swapaxes(1, 2) for row in (rows, next_rows))
    inside = (own >= 0) & (own <= len(points_px) - 1)
    return np.where(inside[:, None, :, None], (1 - share) * first_px + share * second_px, np.nan)


def _slopes(
    point_m: Float[np.ndarray, "frames drones 3"], spread_m2: Float[np.ndarray, "frames drones"], reach: int
) -> tuple[Float[np.ndarray, "frames drones 3"], Float[np.ndarray, "frames drones"]]:
    """Metres per frame, from points of this variance, infinite where there is none; and the slopes' own variance."""
    num_frames = len(point_m)
    around = ((reach, reach), (0, 0))
    padded_m = np.pad(np.nan_to_num(point_m), (*around, (0, 0)))
    weight = np.pad(1 / spread_m2, around)
    steps = np.arange(-reach, reach + 1.0)
    rows = np.arange(num_frames)[:, None] + np.arange(len(steps))
    total, first, second = (np.einsum("fwd,w->fd", weight[rows], steps**power) for power in (0, 1, 2))
    # The middle of the window's weight, and its spread about it.
    middle = first / np.maximum(total, 1e-300)
    squares = second - first * middle
    pull = np.einsum("fwd,w,fwdi->fdi", weight[rows], steps, padded_m[rows])
    pull -= middle[..., None] * np.einsum("fwd,fwdi->fdi", weight[rows], padded_m[rows])
    known = squares > 1e-9 * np.maximum(second, 1e-300)
    squares = np.where(known, squares, 1.0)
    return np.where(known[..., None], pull / squares[..., None], 0.0), np.where(known, 1 / squares, np.inf)


def _standard_deviations(system: _System, max_offset_frames: float) -> Float[np.ndarray, "cameras"]:
    """What the noise of detections says, or what frames say that err alike (Huber's sandwich), whichever is larger."""
    num_frames, num_cameras = system.gradient.shape
    prior = np.eye(num_cameras) / max_offset_frames**2
    inverse = np.linalg.inv(system.normal / system.variance_px2 + prior)
    # About the mean of 0, the cameras' offsets have one direction less.
    inverse -= inverse.mean(axis=0)
    of_noise = np.sqrt(np.diag(inverse - inverse.mean(axis=1, keepdims=True)))
    influence = system.gradient @ inverse.T / system.variance_px2
    return np.fmax(of_noise, num_frames * standard_error(influence, np.arange(num_frames)))
