"""A camera's path at the frames of other cameras, and the arm from the camera to the middle of its drone.

The camera's centre is not the point that static cameras track, which is the middle of the drone's silhouette. The arm
from one to the other is constant in the camera's axes, because the camera is fixed to the body.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from psotrack.geometry import cross_matrices
from psotrack.inside_out.camera_path import CameraPath
from psotrack.support import standard_error
from psotrack.trajectories import Status

#: Distance from the median, in median distances, beyond which a frame is left out of the arm.
_FAR = 4.0
#: Standard deviation of an unknown orientation about each axis, radians.
_LARGEST_TURN_RAD = np.pi / 2
#: Largest standard deviation of a position along an axis, metres. A position that is uncertain by a kilometre says
#: nothing about a drone that cameras see, and sums with larger covariances lose the smaller ones to rounding.
_LARGEST_STD_M = 1e3
#: Difference below which two times are equal, seconds, and two lengths are, metres.
_SAME_S = 1e-6


@dataclass(frozen=True)
class ResampledPath:
    """A camera's path at the frames of other cameras.

    Attributes:
        index: (frames,), row of the path that is nearest in time to each frame; -1 for none.
        ahead_s: (frames,), time of this row less the time of the frame, seconds.
        position_m: (frames, 3), the camera's centre at the frame's time, world; NaN where it is not tracked.
        rotation: (frames, 3, 3), camera to world, in every frame; between known orientations the shortest turn.
        turn_covariance_rad2: (frames, 3, 3), of small turns about the camera's axes; in gaps it grows with the time to
            the next known orientation.
        has_orientation: (frames,), whether the orientation is the path's own.
    """

    index: Int[np.ndarray, "frames"]
    ahead_s: Float[np.ndarray, "frames"]
    position_m: Float[np.ndarray, "frames 3"]
    rotation: Float[np.ndarray, "frames 3 3"]
    turn_covariance_rad2: Float[np.ndarray, "frames 3 3"]
    has_orientation: Bool[np.ndarray, "frames"]

    @property
    def orientation_wxyz(self) -> Float[np.ndarray, "frames 4"]:
        """(frames, 4), `rotation` as unit quaternions."""
        return Rotation.from_matrix(self.rotation).as_quat(scalar_first=True)

    @property
    def known(self) -> Bool[np.ndarray, "frames"]:
        """(frames,), whether a tracked pose of the path belongs to the frame."""
        return self.index >= 0


def resample_path(
    path: CameraPath, time_s: Float[np.ndarray, "frames"], offset_s: float, *, coasting: bool = False
) -> ResampledPath:
    """Resample a path at the times of frames.

    Args:
        path: path of the camera.
        time_s: (frames,), increasing, seconds.
        offset_s: the path at t + offset_s belongs to the frame at t, seconds.
        coasting: use predicted poses as well.
    """
    tracked = (
        path.seen
        & (coasting | (path.status == Status.TRACKED))
        & np.isfinite(path.orientation_wxyz).all(axis=-1)
    )
    tracked &= is_informative(path.covariance[:, :3, :3]) & np.isfinite(path.covariance).all(axis=(1, 2))
    posed = path.seen & np.isfinite(path.orientation_wxyz).all(axis=-1)
    wanted_s = time_s + offset_s
    step_s = max(_step(path.time_s), _step(time_s))
    index, ahead_s = _nearest(path.time_s, np.flatnonzero(tracked), wanted_s)
    near = np.abs(ahead_s) <= step_s / 2 + _SAME_S
    rotation, turn_covariance_rad2, has_orientation = _orientations(path, np.flatnonzero(posed), wanted_s)
    position_m = np.full((len(time_s), 3), np.nan)
    known_s = path.time_s[tracked]
    if len(known_s) > 1:
        # These positions only serve the pairing and the first arm; the fusion uses the samples themselves.
        inside = near & (wanted_s >= known_s[0] - _SAME_S) & (wanted_s <= known_s[-1] + _SAME_S)
        position_m[inside] = CubicSpline(known_s, path.position_m[tracked])(wanted_s[inside])
    return ResampledPath(
        index=np.where(near, index, -1),
        ahead_s=np.where(near, ahead_s, 0.0),
        position_m=position_m,
        rotation=rotation,
        turn_covariance_rad2=turn_covariance_rad2,
        has_orientation=has_orientation,
    )


def is_informative(covariance_m2: Float[np.ndarray, "*rows 3 3"]) -> Bool[np.ndarray, "*rows"]:
    """Say which covariances of positions are known, and not so large that the position is as good as unknown."""
    variance_m2 = np.diagonal(covariance_m2, axis1=-2, axis2=-1)
    return np.isfinite(covariance_m2).all(axis=(-2, -1)) & (variance_m2 <= _LARGEST_STD_M**2).all(axis=-1)


def estimate_arm(
    camera: ResampledPath, middle_m: Float[np.ndarray, "frames 3"]
) -> tuple[Float[np.ndarray, "3"], float]:
    """The arm (3,) from the camera's centre to the middle, in the camera's axes, and its standard error, metres.

    The result is the mean of the arms near their median, which a minority of gross errors moves little. The standard
    error accounts for the correlation of neighbouring frames.

    Args:
        camera: resampled path.
        middle_m: (frames, 3), middle of the silhouette; NaN where unknown.
    """
    arms_m = np.einsum("fji,fj->fi", camera.rotation, middle_m - camera.position_m)
    arms_m[~camera.has_orientation] = np.nan
    there = np.isfinite(arms_m).all(axis=1)
    if not there.any():
        return np.zeros(3), np.inf
    off_m = np.linalg.norm(arms_m - np.median(arms_m[there], axis=0), axis=1)
    near = there & (off_m <= _FAR * np.median(off_m[there]) + _SAME_S)
    error_m = standard_error(np.where(near[:, None], arms_m, np.nan))
    return arms_m[near].mean(axis=0), float(np.max(np.nan_to_num(error_m, nan=np.inf)))


def arm_covariance_m2(
    camera: ResampledPath, arm_m: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "frames 3 3"]:
    """(frames, 3, 3), covariance of the arm's end, world, m², due to the uncertainty of the camera's orientation."""
    by_turn = camera.rotation @ cross_matrices(arm_m)
    return by_turn @ camera.turn_covariance_rad2 @ by_turn.swapaxes(1, 2)


def _step(time_s: Float[np.ndarray, "samples"]) -> float:
    return float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0


def _nearest(
    time_s: Float[np.ndarray, "samples"],
    rows: Int[np.ndarray, "rows"],
    wanted_s: Float[np.ndarray, "frames"],
) -> tuple[Int[np.ndarray, "frames"], Float[np.ndarray, "frames"]]:
    """The nearest sample to each time, and its time less the wanted time, seconds; a sample is used at most once."""
    if not len(rows):
        return np.full(len(wanted_s), -1), np.full(len(wanted_s), np.inf)
    after = np.clip(np.searchsorted(time_s[rows], wanted_s), 1, max(len(rows) - 1, 1))
    candidates = np.stack([rows[after - 1], rows[np.minimum(after, len(rows) - 1)]])
    ahead_s = time_s[candidates] - wanted_s
    # Of two equally near samples take the earlier one, in spite of rounding.
    choice = np.where(np.abs(ahead_s[0]) <= np.abs(ahead_s[1]) + _SAME_S, 0, 1)
    frames = np.arange(len(wanted_s))
    index, ahead_s = candidates[choice, frames], ahead_s[choice, frames]
    order = np.lexsort((np.abs(ahead_s), index))
    first = np.unique(index[order], return_index=True)[1]
    alone = np.zeros(len(index), bool)
    alone[order[first]] = True
    return np.where(alone, index, -1), np.where(alone, ahead_s, np.inf)


def _orientations(
    path: CameraPath, rows: Int[np.ndarray, "rows"], wanted_s: Float[np.ndarray, "frames"]
) -> tuple[Float[np.ndarray, "frames 3 3"], Float[np.ndarray, "frames 3 3"], Bool[np.ndarray, "frames"]]:
    """Rotations, covariances of small turns, and whether orientations are the path's own."""
    count = len(wanted_s)
    unknown_rad2 = np.tile(_LARGEST_TURN_RAD**2 * np.eye(3), (count, 1, 1))
    if not len(rows):
        return np.tile(np.eye(3), (count, 1, 1)), unknown_rad2, np.zeros(count, bool)
    known_s = path.time_s[rows]
    rotations = Rotation.from_quat(path.orientation_wxyz[rows], scalar_first=True)
    after = np.clip(np.searchsorted(known_s, wanted_s), 0, len(rows) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.where(np.abs(known_s[before] - wanted_s) < np.abs(known_s[after] - wanted_s), before, after)
    away_s = np.abs(known_s[nearer] - wanted_s)
    if len(rows) == 1:
        matrices = np.tile(rotations.as_matrix(), (count, 1, 1))
    else:
        matrices = Slerp(known_s, rotations)(np.clip(wanted_s, known_s[0], known_s[-1])).as_matrix()
    # Between neighbouring samples a turn is as certain as they are; in a gap it may be any usual turn of that duration.
    step_s = _step(path.time_s)
    bridged_s = np.where(away_s <= step_s / 2 + _SAME_S, 0.0, away_s)
    rate_rad_s = _turn_rate_rad_s(rotations, known_s, step_s)
    own_rad2 = path.covariance[rows[nearer], 3:, 3:]
    own_rad2 = np.where(np.isfinite(own_rad2), own_rad2, 0.0)
    covariance_rad2 = own_rad2 + (rate_rad_s * bridged_s)[:, None, None] ** 2 * np.eye(3)
    far = np.linalg.eigvalsh(covariance_rad2)[:, -1] > _LARGEST_TURN_RAD**2
    return matrices, np.where(far[:, None, None], unknown_rad2, covariance_rad2), bridged_s == 0


def _turn_rate_rad_s(rotations: Rotation, time_s: Float[np.ndarray, "samples"], step_s: float) -> float:
    """Usual turn rate about an axis, as a standard deviation; the largest possible if no samples are neighbours."""
    steps_s = np.diff(time_s)
    near = steps_s <= 1.5 * step_s
    if not near.any():
        return _LARGEST_TURN_RAD / max(step_s, _SAME_S)
    turned_rad = np.atleast_1d((rotations[:-1].inv() * rotations[1:]).magnitude())[near]
    # The median, because poses from a wrong marker turn wildly. The median length of three normal numbers is 1.54 times
    # the standard deviation of one; the factor 2 allows for quicker turns than the usual.
    return 2 / 1.54 * float(np.median(turned_rad / steps_s[near]))
