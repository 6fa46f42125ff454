"""Comparison of a camera's path with a reference that was recorded separately: the paper's Tables 7 and 8.

The paper (technical validation, "ArUco markers") shifts the path along the reference, takes the offset with the
smallest mean distance, and states distances and differences of angles at corresponding frames. The paper's shifts are
whole samples of the reference; here the offset is found to a fraction of a sample (`psotrack.calibration.clocks`).
Orientations may have their own clock, such as an IMU's: their offset is found from the rotation of the camera.

Two constant differences are no errors: the lever arm, from the reference's point on the drone to the camera, and the
turn from the camera's axes to the axes of the reference's body. Each can be estimated and removed, and is returned.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from psotrack.calibration.clocks import time_shift
from psotrack.inside_out.camera_path import CameraPath, roll_pitch_yaw_deg
from psotrack.inside_out.comparison import clocks as clocks

#: Number of iterations of the mean rotation.
_MEAN_STEPS = 10


@dataclass(frozen=True)
class Statistics:
    """Statistics of the values that are not NaN, in their unit: a row of Tables 7 and 8. NaN if there are no values.

    Attributes:
        count: number of values.
        mean, median, minimum, maximum: mean, median, smallest and largest value.
        std: standard deviation about the mean (the sum of squares divided by `count`).
    """

    count: int
    mean: float
    median: float
    std: float
    minimum: float
    maximum: float

    @staticmethod
    def of(values: Float[np.ndarray, "values"]) -> Statistics:
        """Statistics of the values that are not NaN."""
        known = values[np.isfinite(values)]
        if not len(known):
            return Statistics(0, *[np.nan] * 5)
        functions = (np.mean, np.median, np.std, np.min, np.max)
        return Statistics(len(known), *(float(function(known)) for function in functions))


@dataclass(frozen=True)
class PathReference:
    """A reference for a camera's path: poses of the drone that carries the camera, by clocks other than the video's.

    Attributes:
        time_s: (samples,), times of the positions by the reference's clock, seconds.
        position_m: (samples, 3), positions, world, metres; NaN where unknown.
        orientation_wxyz: (turns, 4), orientations, body to world, at `orientation_time_s`, or at `time_s` if that is
            None; NaN where unknown; None if the reference has no orientations.
        orientation_time_s: (turns,), times of the orientations if they have a clock of their own, seconds.
    """

    time_s: Float[np.ndarray, "samples"]
    position_m: Float[np.ndarray, "samples 3"]
    orientation_wxyz: Float[np.ndarray, "turns 4"] | None = None
    orientation_time_s: Float[np.ndarray, "turns"] | None = None


@dataclass(frozen=True)
class OrientationComparison:
    """Orientations of a path and its reference at corresponding frames. Values that are not known are NaN.

    Attributes:
        offset_s: the reference's orientation at t + offset_s corresponds to the path at t, seconds.
        turn_wxyz: (4,), rotation from the camera's axes to the reference's body; the identity if it is not estimated.
        reference_wxyz: (frames, 4), orientation of the camera by the reference, with the turn, camera to world.
        difference_deg: (frames, 3), in roll, pitch and yaw (`roll_pitch_yaw_deg`): path minus reference, each wrapped
            to (-180, 180]. Table 8.
        angle_deg: (frames,), angle of the rotation from the reference's orientation to the path's; independent of
            conventions of angles.
    """

    offset_s: float
    turn_wxyz: Float[np.ndarray, "4"]
    reference_wxyz: Float[np.ndarray, "frames 4"]
    difference_deg: Float[np.ndarray, "frames 3"]
    angle_deg: Float[np.ndarray, "frames"]


@dataclass(frozen=True)
class PathComparison:
    """A path and its reference at corresponding frames. Values that are not known are NaN.

    Attributes:
        frame: (frames,), frame numbers of the path.
        time_s: (frames,), times of the path, seconds.
        offset_s: the reference's position at t + offset_s corresponds to the path at t, seconds.
        offset_std_s: standard deviation of `offset_s`, from the motion and the remaining distances.
        lever_arm_m: (3,), from the reference's point to the camera, in the axes of the reference's body, or of the
            camera where the reference has no orientations; zeros if it is not estimated.
        reference_m: (frames, 3), position of the camera by the reference, with the lever arm, world.
        distance_m: (frames,), from `reference_m` to the path. Table 7.
        distance_to_point_m: (frames,), from the reference's point to the path, without the lever arm.
        turning: comparison of orientations; None where the reference has none.
    """

    frame: Int[np.ndarray, "frames"]
    time_s: Float[np.ndarray, "frames"]
    offset_s: float
    offset_std_s: float
    lever_arm_m: Float[np.ndarray, "3"]
    reference_m: Float[np.ndarray, "frames 3"]
    distance_m: Float[np.ndarray, "frames"]
    distance_to_point_m: Float[np.ndarray, "frames"]
    turning: OrientationComparison | None

    @property
    def path_length_m(self) -> float:
        """Length of the reference's path over the frames in which it is known, metres."""
        known_m = self.reference_m[np.isfinite(self.reference_m).all(axis=-1)]
        return float(np.linalg.norm(np.diff(known_m, axis=0), axis=-1).sum())


def compare_paths(
    path: CameraPath,
    reference: PathReference,
    *,
    with_lever_arm: bool = True,
    with_turn: bool = True,
    max_offset_s: float | None = None,
) -> PathComparison:
    """Compare a path with a reference of any rate, whose clocks differ from the video's.

    Between samples of the reference, positions are cubic splines and orientations great arcs, but not over gaps longer
    than `resampling.MAX_GAP_S`. Lost poses are left out; all others count, even if they are wrong.

    Args:
        path: path at the times of the video.
        reference: poses by the reference.
        with_lever_arm: estimate a constant lever arm in the body.
        with_turn: estimate a constant turn between the camera's axes and the body's; without it the axes are the same.
        max_offset_s: offsets from minus this to this are tried, seconds; None tries all offsets at which half of the
            shorter recording overlaps the other.

    Raises:
        SettingsError: the range is smaller than a step of the reference.
        InputError: path and reference do not overlap, or the motion does not determine the offset; see `find_offset`.
    """
    reference_wxyz = reference.orientation_wxyz
    turns_s, turn_offset_s = reference.time_s, None
    if reference_wxyz is not None and reference.orientation_time_s is not None:
        turns_s = reference.orientation_time_s
        turn_offset_s = clocks.find_orientation_offset(
            path, turns_s, reference_wxyz, with_turn=with_turn, max_offset_s=max_offset_s
        )
    bodies = _body_orientations(path, reference.time_s, reference_wxyz, turns_s, turn_offset_s)
    offset_s, std_s = clocks.find_position_offset(
        path,
        reference.time_s,
        reference.position_m,
        bodies if with_lever_arm else None,
        max_offset_s=max_offset_s,
    )
    turned = bodies(offset_s) if with_lever_arm else None
    placed = time_shift.ShiftedPair.of(
        path.trajectories("camera"),
        reference.time_s,
        reference.position_m[:, None],
        None if turned is None else turned[:, None],
        with_lever_arm,
    )
    left = placed.at(offset_s, np.zeros(1, int))
    point_m = placed.position_m(path.time_s + offset_s)[:, 0]
    arm_m = np.zeros(3)
    if placed.rotation is not None:
        arm_m = placed.rotation(path.time_s + offset_s)[:, 0] @ left.arm_m[0]
    turning = None
    if reference_wxyz is not None:
        by_s = offset_s if turn_offset_s is None else turn_offset_s
        turning = _compare_orientations(
            path,
            clocks.interpolate_orientations(turns_s, reference_wxyz, path.time_s + by_s),
            by_s,
            with_turn,
        )
    return PathComparison(
        frame=path.frame,
        time_s=path.time_s,
        offset_s=offset_s,
        offset_std_s=std_s,
        lever_arm_m=left.arm_m[0],
        reference_m=point_m + arm_m,
        distance_m=np.linalg.norm(left.residual_m[:, 0], axis=-1),
        distance_to_point_m=np.linalg.norm(placed.est_m[:, 0] - point_m, axis=-1),
        turning=turning,
    )


def wrap_deg(angle_deg: Float[np.ndarray, "*angles"]) -> Float[np.ndarray, "*angles"]:
    """Angles without full turns, in (-180, 180], degrees."""
    return 180.0 - (180.0 - angle_deg) % 360.0


def mean_rotation(rotations: Rotation) -> Rotation:
    """The rotation with the smallest mean angle to all rotations (L1); outliers change it only a little.

    Weiszfeld's steps from the chordal mean: R. Hartley, K. Aftab, J. Trumpf, L1 rotation averaging using the Weiszfeld
    algorithm, CVPR 2011.
    """
    mean = rotations.mean()
    for _ in range(_MEAN_STEPS):
        mean = rotations.mean(1 / np.maximum((mean.inv() * rotations).magnitude(), 1e-9))
    return mean


def _body_orientations(
    path: CameraPath,
    time_s: Float[np.ndarray, "samples"],
    reference_wxyz: Float[np.ndarray, "turns 4"] | None,
    turns_s: Float[np.ndarray, "turns"],
    turn_offset_s: float | None,
) -> clocks.BodyOrientations:
    """The reference's own orientations; without any, the orientations of the path, which are the camera's."""
    if reference_wxyz is not None and turn_offset_s is None:
        return lambda offset_s: reference_wxyz
    by_video_s, wxyz = path.time_s, _seen_orientations(path)
    if reference_wxyz is not None and turn_offset_s is not None:
        by_video_s, wxyz = turns_s - turn_offset_s, reference_wxyz
    return lambda offset_s: (
        None if offset_s is None else clocks.interpolate_orientations(by_video_s, wxyz, time_s - offset_s)
    )


def _compare_orientations(
    path: CameraPath, body_wxyz: Float[np.ndarray, "frames 4"], offset_s: float, with_turn: bool
) -> OrientationComparison:
    pose_wxyz = _seen_orientations(path)
    known = np.isfinite(body_wxyz).all(axis=-1)
    both = known & np.isfinite(pose_wxyz).all(axis=-1)
    if not both.any():
        raise time_shift.refused("orientations of both in some frame", "none")
    bodies, poses = (Rotation.from_quat(wxyz[both], scalar_first=True) for wxyz in (body_wxyz, pose_wxyz))
    turn = mean_rotation(bodies.inv() * poses) if with_turn else Rotation.identity()
    reference_wxyz, angle_deg = np.full_like(body_wxyz, np.nan), np.full(len(body_wxyz), np.nan)
    every = Rotation.from_quat(body_wxyz[known], scalar_first=True)
    reference_wxyz[known] = (every * turn).as_quat(scalar_first=True)
    angle_deg[both] = np.degrees(((bodies * turn).inv() * poses).magnitude())
    difference_deg = roll_pitch_yaw_deg(pose_wxyz) - roll_pitch_yaw_deg(reference_wxyz)
    return OrientationComparison(
        offset_s, turn.as_quat(scalar_first=True), reference_wxyz, wrap_deg(difference_deg), angle_deg
    )


def _seen_orientations(path: CameraPath) -> Float[np.ndarray, "frames 4"]:
    return np.where(path.seen[:, None], path.orientation_wxyz, np.nan)
