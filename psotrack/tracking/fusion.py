"""Fusion: the tracks of two methods as one, weighted by their covariances.

The swarm finds the middle of a drone's silhouette, the projection lines the middle of its boxes. The two points
differ by a constant for each drone. The constant is estimated and removed from the lines, so that a drone does not
move where one method takes over from the other. No image shows which of the two points is nearer to the body's
origin. The constant is stored in the record: if the offset of the origin is known for one method, the constant gives
the offset for the other method.

If the boxes are a detector's, the remaining errors of the two methods have different causes, and the information adds
up (Bar-Shalom et al. 2001, section 8.3.3: fusion of independent estimates). Boxes of blobs come from the same
foreground that the swarm sees: part of the errors is common, and the fused covariance is larger (Y. Bar-Shalom,
L. Campo, The effect of the common process noise on the two-sensor fused-track covariance, IEEE Transactions on
Aerospace and Electronic Systems 22(6), 1986). Where one method does not see a drone, the other method's position counts
alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from psotrack.settings import MotionSettings
from psotrack.support import standard_error
from psotrack.tracking.camera_errors import SystematicCovariances, TrackErrors, noise_ratios
from psotrack.tracking.matching import SEPARATION_M
from psotrack.tracking.motion import GATE_999, Measurements, filter_measurements, motion_params
from psotrack.trajectories import ARRAYS, Status, Tracks, padded

#: Least number of common frames from which the offset of the two points is estimated; with fewer the offset is taken
#: as 0.
LEAST_FRAMES = 10
#: Of the normal distribution: its standard deviation over the median of absolute deviations, and the standard error of
#: a median over that of a mean.
MAD_STD, MEDIAN_ERROR = 1.4826, np.sqrt(np.pi / 2)
#: Distance from the median, in standard deviations, beyond which a deviation is cut: such a track was elsewhere,
#: which says nothing about the offset.
FAR = 3.0
#: Correlation of the errors of two methods that see the same foreground: shadows, noise and occlusion are common,
#: the errors of each method are not.
COMMON_CORRELATION = 0.5


@dataclass(frozen=True)
class Fusion:
    """The tracks of both methods as one.

    Attributes:
        tracks: the fused tracks: the drones of the swarm under their numbers, then drones that only the lines know.
        offset_m: (drones, 3), vector from the middle of each drone's silhouettes to the middle of its boxes, constant
            over time, along the world's axes, metres; NaN where too few frames show both.
        offset_std_m: (drones, 3), its standard errors, metres.
        errors: errors of both methods that come from the cameras; None where neither method states any.
    """

    tracks: Tracks
    offset_m: Float[np.ndarray, "drones 3"]
    offset_std_m: Float[np.ndarray, "drones 3"]
    errors: TrackErrors | None


def fuse_tracks(
    swarm: Tracks,
    lines: Tracks,
    settings: MotionSettings,
    *,
    fps: float,
    max_coasting_s: float,
    same_foreground: bool = False,
    errors: tuple[TrackErrors | None, TrackErrors | None] = (None, None),
) -> Fusion:
    """The tracks of both methods as one.

    Drones of the swarm keep their numbers. Drones that only the lines know come after them, unless both methods see the
    same foreground: then the swarm has searched that foreground and found no drone. Positions are middles of
    silhouettes; where only the lines see a drone, and no offset is known for it, the position is the middle of its
    boxes.

    Args:
        swarm, lines: tracks of both methods for the same frames; their measured covariances are those of the noise that
            was found (see `psotrack.tracking.camera_errors`).
        settings: settings of the motion model.
        fps: frames per second.
        max_coasting_s: seconds for which a drone that is not found coasts before it is lost.
        same_foreground: whether the lines' detections are blobs of the foreground that the swarm sees.
        errors: errors of the swarm's and of the lines' tracks that come from the cameras; None for a method that states
            none. The noise of the first that states some fades as that of the fused positions.
    """
    matches = _same_drones(swarm, lines)
    alone = np.setdiff1d(np.arange(lines.num_drones), matches)
    if same_foreground:
        alone = alone[:0]
    # The drones in the order of the swarm; then the drones that only the lines know.
    swarm_drones = np.concatenate([np.arange(swarm.num_drones), np.full(len(alone), -1)])
    lines_drones = np.concatenate([matches, alone])
    first = _of_drones(swarm, swarm_drones)
    second = _of_drones(lines, lines_drones)
    offset_m, offset_std_m = _point_offset(first.found_m(), second.found_m())
    frame = np.arange(swarm.num_frames)
    correlation = COMMON_CORRELATION if same_foreground else 0.0
    measured, share = _weighted(first, second, offset_m, offset_std_m, correlation, frame / fps)
    found = measured.was_measured
    moving = filter_measurements(measured, motion_params(settings, found.shape[1]))
    last = _last_found(found)
    coasting = (last >= 0) & (frame[:, None] - last <= round(max_coasting_s * fps))
    renumbered = {int(drone): swarm.num_drones + number for number, drone in enumerate(alone)}
    arrivals = [
        replace(arrival, drone=renumbered[arrival.drone])
        for arrival in lines.arrivals
        if arrival.drone in renumbered
    ]
    fused = replace(
        first,
        position_m=moving.position_m,
        velocity_m_s=moving.velocity_m_s,
        covariance_m2=moving.covariance_m2,
        measured_m=measured.position_m,
        measured_covariance_m2=measured.covariance_m2,
        fitness=np.where(first.status == Status.TRACKED, first.fitness, second.fitness),
        num_cameras=np.maximum(first.num_cameras, second.num_cameras),
        status=np.where(found, Status.TRACKED, np.where(coasting, Status.COASTING, Status.LOST)),
        size_m=np.concatenate([swarm.size_m, lines.size_m[alone]]),
        size_frames=np.concatenate([swarm.size_frames, lines.size_frames[alone]]),
        arrivals=(*swarm.arrivals, *arrivals),
    )
    if not any(errors):
        return Fusion(fused, offset_m, offset_std_m, None)
    methods = list(zip(errors, (swarm_drones, lines_drones), strict=True))
    with_errors, errors_of_both = _with_errors(fused, methods, share, settings, fps)
    return Fusion(with_errors, offset_m, offset_std_m, errors_of_both)


def _same_drones(swarm: Tracks, lines: Tracks) -> Int[np.ndarray, "drones"]:
    """(drones of the swarm,), the number of the same drone in the lines; -1 for none."""
    apart_m = np.linalg.norm(swarm.found_m()[:, :, None] - lines.found_m()[:, None], axis=-1)
    # Of one drone if more than half of the common frames are as near as the two points' offset and noise allow.
    near, both = (apart_m < SEPARATION_M).sum(axis=0), np.isfinite(apart_m).sum(axis=0)
    # The more frames two tracks share, the more certain it is that they are of one drone.
    gain = np.where(2 * near > both, both, 0)
    drones, others = linear_sum_assignment(gain, maximize=True)
    matches = np.full(swarm.num_drones, -1)
    matches[drones] = np.where(gain[drones, others] > 0, others, -1)
    return matches


def _of_drones(tracks: Tracks, drones: Int[np.ndarray, "drones"]) -> Tracks:
    """The arrays of some drones, in the order of `drones`; the values of drone -1 are unknown."""

    arrays = {name: np.asarray(getattr(tracks, name)) for name in ARRAYS}
    sizes = {name: getattr(tracks, name)[None] for name in ("size_m", "size_frames")}
    chosen: dict[str, Any] = {
        name: padded(name, value, tracks.num_drones + 1)[:, drones]
        for name, value in (arrays | sizes).items()
    }
    return replace(tracks, **chosen | {name: chosen[name][0] for name in sizes})


def _point_offset(
    silhouettes_m: Float[np.ndarray, "frames drones 3"], boxes_m: Float[np.ndarray, "frames drones 3"]
) -> tuple[Float[np.ndarray, "drones 3"], Float[np.ndarray, "drones 3"]]:
    """The offsets of each drone's points and their standard errors (see `Fusion`), from frames that show both points.

    Errors of neighbouring frames are correlated (see `standard_error`).
    """
    off_m = boxes_m - silhouettes_m
    median_m, std_m = np.full((2, *off_m.shape[1:]), np.nan)
    for drone in np.flatnonzero(np.isfinite(off_m).all(axis=-1).sum(axis=0) >= LEAST_FRAMES):
        median_m[drone] = np.nanmedian(off_m[:, drone], axis=0)
        apart_m = off_m[:, drone] - median_m[drone]
        far_m = FAR * MAD_STD * np.nanmedian(np.abs(apart_m), axis=0)
        std_m[drone] = MEDIAN_ERROR * standard_error(np.clip(apart_m, -far_m, far_m))
    return median_m, std_m


def _weighted(
    swarm: Tracks,
    lines: Tracks,
    offset_m: Float[np.ndarray, "drones 3"],
    offset_std_m: Float[np.ndarray, "drones 3"],
    correlation: float,
    time_s: Float[np.ndarray, "frames"],
) -> tuple[Measurements, Float[np.ndarray, "frames drones"]]:
    """Measured positions of both methods together, and the weight of the lines' positions in them, 0 to 1.

    The weight is NaN where neither method found the drone.

    Where the two positions disagree more than their covariances allow, one position belongs to another drone or to no
    drone. Then the swarm's position counts, because the swarm sees all of the foreground.
    """
    first_m, second_m = swarm.found_m(), lines.found_m() - np.nan_to_num(offset_m)
    first_m2 = np.asarray(swarm.measured_covariance_m2, np.float64)
    second_m2 = np.asarray(lines.measured_covariance_m2, np.float64)
    second_m2 = second_m2 + np.nan_to_num(offset_std_m)[..., None] ** 2 * np.eye(3)
    by_swarm, by_lines = (np.isfinite(each_m).all(axis=-1) for each_m in (first_m, second_m))
    position_m = np.where(by_swarm[..., None], first_m, second_m)
    covariance_m2 = np.where(by_swarm[..., None, None], first_m2, second_m2)
    share = np.where(by_swarm, 0.0, np.where(by_lines, 1.0, np.nan))

    both = by_swarm & by_lines
    off_m, one_m2, other_m2 = (second_m - first_m)[both], first_m2[both], second_m2[both]
    # With the cross-covariance P12 the gain is (P1 - P12) (P1 + P2 - P12 - P21)^-1; it is P1 (P1 + P2)^-1 without.
    cross_m2 = correlation * np.linalg.cholesky(one_m2) @ np.linalg.cholesky(other_m2).mT
    gain = (one_m2 - cross_m2) @ np.linalg.inv(one_m2 + other_m2 - cross_m2 - cross_m2.mT)
    distance = np.vecdot(off_m, np.linalg.solve(one_m2 + other_m2, off_m[..., None])[..., 0])
    gain[distance >= GATE_999] = 0.0
    position_m[both] += np.matvec(gain, off_m)
    covariance_m2[both] -= gain @ (one_m2 - cross_m2.mT)
    # Correlated errors can give one method a weight below 0.
    share[both] = np.clip(np.trace(gain, axis1=-2, axis2=-1) / 3, 0.0, 1.0)
    symmetric_m2 = (covariance_m2 + covariance_m2.mT) / 2
    return Measurements(time_s, position_m, symmetric_m2, by_swarm | by_lines), share


def _last_found(found: Bool[np.ndarray, "frames drones"]) -> Int[np.ndarray, "frames drones"]:
    """Last frame, up to each frame, in which a drone was found; -1 before the first."""
    frame = np.arange(len(found))[:, None]
    return np.maximum.accumulate(np.where(found, frame, -1), axis=0)


def _with_errors(
    fused: Tracks,
    methods: list[tuple[TrackErrors | None, Int[np.ndarray, "drones"]]],
    lines_share: Float[np.ndarray, "frames drones"],
    motion: MotionSettings,
    fps: float,
) -> tuple[Tracks, TrackErrors]:
    """Fused tracks whose noise fades, and the errors of both methods as one.

    Systematic errors have the same causes in both methods, the turned cameras and the late clocks, and do not average
    out. A weighted mean of two errors has at most the weighted mean of their squares, whatever their correlation: that
    is the covariance of the fused systematic errors.

    Args:
        fused: the fused tracks; their measured covariances are those of the noise that was found.
        methods: for the swarm and the lines their errors, and the number in them of each fused drone; -1 for none.
        lines_share: (frames, drones), weight of the lines' positions (see `_weighted`).
        motion: settings of the motion model that the fusion used.
        fps: frames per second.
    """
    known = [errors.cameras for errors, _ in methods if errors is not None]

    def mean_square(name: str) -> Any:
        return np.sqrt(np.mean([np.square(getattr(each, name)) for each in known], axis=0))

    cameras = replace(
        known[0],
        noise_px=np.full_like(known[0].noise_px, np.nan),
        bias_px=mean_square("bias_px"),
        turn_rad=float(mean_square("turn_rad")),
        clock_s=float(mean_square("clock_s")),
        constant_covariance=np.mean([each.constant_covariance for each in known], axis=0),
    )
    measured_m2 = fused.measured_covariance_m2
    _, filtered = noise_ratios(measured_m2, measured_m2, cameras, motion, fps)
    # A drone that is not found keeps the weights of the frame in which it was last found, or first will be.
    found = np.isfinite(lines_share)
    last = _last_found(found)
    nearest = np.where(last < 0, found.argmax(axis=0), last)
    share = np.nan_to_num(np.take_along_axis(lines_share, nearest, axis=0))[..., None, None]
    systematic: dict[str, Any] = {"absolute_m2": 0.0, "relative_m2": 0.0}
    for weight, (errors, drones) in zip((1 - share, share), methods, strict=True):
        if errors is not None:
            for name, of_method_m2 in vars(errors.systematic).items():
                # Drone -1 has the column of zeros.
                systematic[name] += weight * np.pad(of_method_m2, [(0, 0), (0, 1), (0, 0), (0, 0)])[:, drones]
    corrected = replace(fused, covariance_m2=fused.covariance_m2 * filtered[..., None, None])
    knocks = (errors.knock for errors, _ in methods if errors is not None)
    knock = next((each for each in knocks if each is not None), None)
    return corrected, TrackErrors(cameras, SystematicCovariances(**systematic), knock)
