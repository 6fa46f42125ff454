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

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from psotrack.motion import GATE_999, filter_measurements, motion_params
from psotrack.settings import MotionSettings
from psotrack.support import standard_error
from psotrack.trajectories import Status, Tracks, unknown_value

#: Largest median distance of two tracks of one drone, metres: the offset of the two points, and noise.
SAME_M = 0.25
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
class PointOffset:
    """Vector from the middle of each drone's silhouettes to the middle of its boxes, constant over time.

    Attributes:
        offset_m: (drones, 3), along the world's axes, metres; NaN where too few frames show both.
        std_m: (drones, 3), standard errors, metres.
    """

    offset_m: Float[np.ndarray, "drones 3"]
    std_m: Float[np.ndarray, "drones 3"]


@dataclass(frozen=True)
class Fusion:
    """The tracks of both methods as one, and what they were made of.

    Attributes:
        tracks: the fused tracks: the drones of the swarm under their numbers, then drones that only the lines know.
        offset: the offset between the two tracked points.
        lines_drones: (drones,), number of each fused drone in the lines; -1 for none.
        lines_share: (frames, drones), weight of the lines' position in the fused position, 0 to 1; NaN where neither
            method found the drone.
    """

    tracks: Tracks
    offset: PointOffset
    lines_drones: Int[np.ndarray, "drones"]
    lines_share: Float[np.ndarray, "frames drones"]


def fuse_tracks(
    swarm: Tracks,
    lines: Tracks,
    settings: MotionSettings,
    *,
    fps: float,
    max_coasting_s: float,
    same_foreground: bool = False,
) -> Fusion:
    """The tracks of both methods as one.

    Drones of the swarm keep their numbers. Drones that only the lines know come after them, unless both methods see the
    same foreground: then the swarm has searched that foreground and found no drone. Positions are middles of
    silhouettes; where only the lines see a drone, and no offset is known for it, the position is the middle of its
    boxes.

    Args:
        swarm, lines: tracks of both methods for the same frames; their measured covariances are those of the noise that
            was found (see `psotrack.camera_errors`).
        settings: settings of the motion model.
        fps: frames per second.
        max_coasting_s: seconds for which a drone that is not found coasts before it is lost.
        same_foreground: whether the lines' detections are blobs of the foreground that the swarm sees.
    """
    matches = _same_drones(swarm, lines)
    alone = np.setdiff1d(np.arange(lines.num_drones), matches)
    if same_foreground:
        alone = alone[:0]
    # The lines' drones in the order of the swarm's drones; then the drones that only the lines know.
    lines_drones = np.concatenate([matches, alone])
    first = _of_drones(swarm, np.concatenate([np.arange(swarm.num_drones), np.full(len(alone), -1)]))
    second = _of_drones(lines, lines_drones)
    offset = _point_offset(first.found_m(), second.found_m())
    correlation = COMMON_CORRELATION if same_foreground else 0.0
    measured_m, covariance_m2, lines_share = _weighted(first, second, offset, correlation)
    was_measured = np.isfinite(lines_share)
    time_s = np.arange(len(measured_m)) / fps
    params = jax.tree.map(
        lambda value: np.asarray(value, np.float64), motion_params(settings, measured_m.shape[1])
    )
    moving = filter_measurements(time_s, measured_m, covariance_m2, was_measured, params)
    coasting = _frames_since_found(was_measured) <= round(max_coasting_s * fps)
    status = np.where(was_measured, Status.TRACKED, np.where(coasting, Status.COASTING, Status.LOST))
    by_swarm = first.status == Status.TRACKED
    renumbered = {int(drone): swarm.num_drones + number for number, drone in enumerate(alone)}
    arrivals = [
        replace(arrival, drone=renumbered[arrival.drone])
        for arrival in lines.arrivals
        if arrival.drone in renumbered
    ]
    fused = Tracks(
        position_m=moving.position_m,
        velocity_m_s=moving.velocity_m_s,
        covariance_m2=moving.covariance_m2,
        measured_m=measured_m,
        measured_covariance_m2=covariance_m2,
        fitness=np.where(by_swarm, first.fitness, second.fitness),
        num_cameras=np.maximum(first.num_cameras, second.num_cameras),
        status=status,
        measured_size_m=first.measured_size_m,
        sizes=swarm.sizes.joined(lines.sizes.of_drones(alone)),
        arrivals=(*swarm.arrivals, *arrivals),
    )
    return Fusion(fused, offset, lines_drones, lines_share)


def _same_drones(swarm: Tracks, lines: Tracks) -> Int[np.ndarray, "drones"]:
    """(drones of the swarm,), the number of the same drone in the lines; -1 for none."""
    matches = np.full(swarm.num_drones, -1)
    apart_m = np.linalg.norm(swarm.found_m()[:, :, None] - lines.found_m()[:, None], axis=-1)
    both = np.isfinite(apart_m)
    median_m = np.full(apart_m.shape[1:], np.inf)
    together = both.any(axis=0)
    median_m[together] = np.nanmedian(apart_m[:, together], axis=0)
    # The more frames two tracks share, the more certain it is that they are of one drone.
    gain = np.where(median_m < SAME_M, both.sum(axis=0), 0)
    for drone, other in zip(*linear_sum_assignment(gain, maximize=True), strict=True):
        if gain[drone, other]:
            matches[drone] = other
    return matches


def _of_drones(tracks: Tracks, drones: Int[np.ndarray, "drones"]) -> Tracks:
    """The arrays of some drones, in the order of `drones`; the values of drone -1 are unknown. Sizes do not change."""

    def chosen(name: str, value: np.ndarray) -> np.ndarray:
        # The fitness of a drone that was not found is 0, not unknown.
        unknown = 0.0 if name == "fitness" else unknown_value(name, value.dtype)
        column = np.full_like(value[:, :1], unknown, shape=(len(value), 1, *value.shape[2:]))
        return np.concatenate([value, column], axis=1)[:, drones]

    return tracks.with_arrays(lambda name, value: chosen(name, np.asarray(value)))


def _point_offset(
    silhouettes_m: Float[np.ndarray, "frames drones 3"], boxes_m: Float[np.ndarray, "frames drones 3"]
) -> PointOffset:
    """The offsets, from frames that show both points.

    Errors of neighbouring frames are correlated (see `standard_error`).
    """
    off_m = boxes_m - silhouettes_m
    median_m, std_m = np.full((2, *off_m.shape[1:]), np.nan)
    for drone in np.flatnonzero(np.isfinite(off_m).all(axis=-1).sum(axis=0) >= LEAST_FRAMES):
        median_m[drone] = np.nanmedian(off_m[:, drone], axis=0)
        apart_m = off_m[:, drone] - median_m[drone]
        far_m = FAR * MAD_STD * np.nanmedian(np.abs(apart_m), axis=0)
        std_m[drone] = MEDIAN_ERROR * standard_error(np.clip(apart_m, -far_m, far_m), np.arange(len(off_m)))
    return PointOffset(median_m, std_m)


def _weighted(
    swarm: Tracks, lines: Tracks, offset: PointOffset, correlation: float
) -> tuple[
    Float[np.ndarray, "frames drones 3"],
    Float[np.ndarray, "frames drones 3 3"],
    Float[np.ndarray, "frames drones"],
]:
    """Measured positions of both methods together, their covariances, and the lines' weight (`Fusion.lines_share`).

    Where the two positions disagree more than their covariances allow, one position belongs to another drone or to no
    drone. Then the swarm's position counts, because the swarm sees all of the foreground.
    """
    first_m, second_m = swarm.found_m(), lines.found_m()
    first_m2 = np.asarray(swarm.measured_covariance_m2, np.float64)
    second_m2 = np.array(lines.measured_covariance_m2, np.float64)
    second_m -= np.nan_to_num(offset.offset_m)
    second_m2 += np.nan_to_num(offset.std_m)[..., None] ** 2 * np.eye(3)
    both = np.isfinite(first_m).all(axis=-1) & np.isfinite(second_m).all(axis=-1)
    off_m = np.where(both[..., None], second_m - first_m, 0.0)
    one_m2, other_m2 = (np.where(both[..., None, None], value, np.eye(3)) for value in (first_m2, second_m2))
    solved = np.linalg.solve(one_m2 + other_m2, off_m[..., None])
    agree = both & ((off_m[..., None, :] @ solved)[..., 0, 0] < GATE_999)
    # With the cross-covariance P12 the gain is (P1 - P12) (P1 + P2 - P12 - P21)^-1; it is P1 (P1 + P2)^-1 without.
    cross_m2 = correlation * np.linalg.cholesky(one_m2) @ np.linalg.cholesky(other_m2).swapaxes(-1, -2)
    crossed_m2 = cross_m2.swapaxes(-1, -2)
    gain = (one_m2 - cross_m2) @ np.linalg.inv(one_m2 + other_m2 - cross_m2 - crossed_m2)
    together_m = first_m + (gain @ off_m[..., None])[..., 0]
    together_m2 = one_m2 - gain @ (one_m2 - crossed_m2)
    by_swarm = np.isfinite(first_m).all(axis=-1)
    measured_m = np.where(agree[..., None], together_m, np.where(by_swarm[..., None], first_m, second_m))
    covariance_m2 = np.where(
        agree[..., None, None], together_m2, np.where(by_swarm[..., None, None], first_m2, second_m2)
    )
    covariance_m2 = (covariance_m2 + covariance_m2.swapaxes(-1, -2)) / 2
    # Correlated errors can give one method a weight below 0.
    share = np.clip(np.trace(gain, axis1=-2, axis2=-1) / 3, 0.0, 1.0)
    share = np.where(agree, share, np.where(by_swarm, 0.0, 1.0))
    return measured_m, covariance_m2, np.where(np.isfinite(measured_m).all(axis=-1), share, np.nan)


def _frames_since_found(was_measured: Bool[np.ndarray, "frames drones"]) -> Int[np.ndarray, "frames drones"]:
    """Frames since each drone was last measured; before the first measurement at least the number of all frames."""
    frame = np.arange(len(was_measured))[:, None]
    last = np.maximum.accumulate(np.where(was_measured, frame, -len(was_measured)), axis=0)
    return frame - last
