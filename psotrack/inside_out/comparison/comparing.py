"""A camera's path against a reference that was recorded apart from it: the paper's Tables 7 and 8.

The paper (technical validation, "ArUco markers") lays the path on successive points of the reference, takes the offset
with the smallest mean distance, and gives distances and differences of angles at corresponding frames. It does so in
steps of the reference's samples; here the offset is found to a fraction of them (`synchronisation`). Orientations may
come by a clock of their own, as those of an IMU do: their offset is found from how the camera turns.

Two things are constant and no error: the lever arm, from the reference's point on the drone to the camera, and the turn
from the camera's axes to those of the reference's body. Each may be taken out, and is told.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from psotrack.clocks import time_shift
from psotrack.inside_out.camera_path import CameraPath, roll_pitch_yaw_deg
from psotrack.inside_out.comparison import clocks as clocks

_MEAN_STEPS = 10


@dataclass(frozen=True)
class Statistics:
    """Of the values that are known, in their unit: a row of Tables 7 and 8. NaN where there are none.

    Attributes:
        count: of them.
        std: about the mean, divided by their number.
    """

    count: int
    mean: float
    median: float
    std: float
    minimum: float
    maximum: float

    @staticmethod
    def of(values: Float[np.ndarray, "values"]) -> Statistics:
        """Of the values that are not NaN."""
        known = values[np.isfinite(values)]
        if not len(known):
            return Statistics(0, *[np.nan] * 5)
        functions = (np.mean, np.median, np.std, np.min, np.max)
        return Statistics(len(known), *(float(function(known)) for function in functions))


@dataclass(frozen=True)
class Turning:
    """The orientations of a path and its reference at corresponding frames. What is not known of a frame is NaN.

    Attributes:
        offset_s: the reference's orientations at t + offset_s belong to the path at t.
        turn_wxyz: (4,), camera to the reference's body; the identity where none was allowed for.
        reference_wxyz: (frames, 4), camera to world by the reference, turn and all.
        difference_deg: (frames, 3), in roll, pitch and yaw (`roll_pitch_yaw_deg`): path minus reference, each wrapped
            to (-180, 180]. Table 8.
        angle_deg: (frames,), of the one turn that leads from the reference's orientation to the path's: no convention
            enters it.
    """

    offset_s: float
    turn_wxyz: Float[np.ndarray, "4"]
    reference_wxyz: Float[np.ndarray, "frames 4"]
    difference_deg: Float[np.ndarray, "frames 3"]
    angle_deg: Float[np.ndarray, "frames"]


@dataclass(frozen=True)
class PathComparison:
    """A path and its reference at corresponding frames. What is not known of a frame is NaN.

    Attributes:
        frame: (frames,), those of the path.
        time_s: (frames,), likewise.
        offset_s: the reference's positions at t + offset_s belong to the path at t.
        offset_std_s: its standard deviation, from the motion and the distances that are left.
        lever_arm_m: (3,), from the reference's point to the camera, in the axes of the reference's body, or in the
            camera's where it has no orientations; zeros where none was allowed for.
        reference_m: (frames, 3), where the camera is by the reference, lever arm and all, world.
        distance_m: (frames,), of the path's position from there. Table 7.
        distance_to_point_m: (frames,), from the reference's own point: the lever arm counts.
        turning: of the orientations; None where the reference has none.
    """

    frame: Int[np.ndarray, "frames"]
    time_s: Float[np.ndarray, "frames"]
    offset_s: float
    offset_std_s: float
    lever_arm_m: Float[np.ndarray, "3"]
    reference_m: Float[np.ndarray, "frames 3"]
    distance_m: Float[np.ndarray, "frames"]
    distance_to_point_m: Float[np.ndarray, "frames"]
    turning: Turning | None

    @property
    def path_length_m(self) -> float:
        """Of the way by the reference, over the frames in which it is known."""
        known_m = self.reference_m[np.isfinite(self.reference_m).all(axis=-1)]
        return float(np.linalg.norm(np.diff(known_m, axis=0), axis=-1).sum())


def compare(
    path: CameraPath,
    reference_time_s: Float[np.ndarray, "samples"],
    reference_m: Float[np.ndarray, "samples 3"],
    reference_wxyz: Float[np.ndarray, "turns 4"] | None = None,
    *,
    orientation_time_s: Float[np.ndarray, "turns"] | None = None,
    with_lever_arm: bool = True,
    with_turn: bool = True,
    max_offset_s: float | None = None,
) -> PathComparison:
    """A path against a reference of any rate, whose clocks are not that of the video.

    Between samples of the reference positions are cubic splines and orientations great arcs, neither over gaps
    (`time_shift.MAX_GAP_S`). Poses that are lost do not count; all others do, however wrong they are.

    Args:
        path: at the times of the video.
        reference_time_s: (samples,), by the reference's own clock, at its own rate.
        reference_m: (samples, 3), world; NaN where it is not known.
        reference_wxyz: (turns, 4), body to world, at the times of the positions, or else at `orientation_time_s`; NaN
            where it is not known.
        orientation_time_s: (turns,), where orientations come by a clock of their own.
        with_lever_arm: allow a constant arm in the body.
        with_turn: allow a constant turn between the camera's axes and the body's; without it they are the same.
        max_offset_s: offsets from minus this to this; None for all at which half of the shorter one is covered.

    Raises:
        SettingsError: the range is smaller than a step of the reference.
        InputError: nothing is in common, or the motion does not tell the offset: see `synchronisation.find_offset`.
    """
    turns_s, turn_offset_s = reference_time_s, None
    if reference_wxyz is not None and orientation_time_s is not None:
        turns_s = orientation_time_s
        turn_offset_s = clocks.offset_of_turning(
            path, turns_s, reference_wxyz, with_turn=with_turn, max_offset_s=max_offset_s
        )
    bodies = _bodies(path, reference_time_s, reference_wxyz, turns_s, turn_offset_s)
    offset_s, std_s = clocks.offset_of_positions(
        path, reference_time_s, reference_m, bodies if with_lever_arm else None, max_offset_s=max_offset_s
    )
    turned = bodies(offset_s) if with_lever_arm else None
    placed = time_shift.ShiftedPair.of(
        path.trajectories("camera"),
        reference_time_s,
        reference_m[:, None],
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
        turning = _turning(
            path, clocks.at_times(turns_s, reference_wxyz, path.time_s + by_s), by_s, with_turn
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


def wrapped_deg(angle_deg: Float[np.ndarray, "*angles"]) -> Float[np.ndarray, "*angles"]:
    """The same angles in (-180, 180]."""
    return 180.0 - (180.0 - angle_deg) % 360.0


def mean_rotation(rotations: Rotation) -> Rotation:
    """The rotation with the least mean angle to all, which outliers move little (L1).

    Weiszfeld's steps from the chordal mean: R. Hartley, K. Aftab, J. Trumpf, L1 rotation averaging using the Weiszfeld
    algorithm, CVPR 2011.
    """
    mean = rotations.mean()
    for _ in range(_MEAN_STEPS):
        mean = rotations.mean(1 / np.maximum((mean.inv() * rotations).magnitude(), 1e-9))
    return mean


def _bodies(
    path: CameraPath,
    time_s: Float[np.ndarray, "samples"],
    reference_wxyz: Float[np.ndarray, "turns 4"] | None,
    turns_s: Float[np.ndarray, "turns"],
    turn_offset_s: float | None,
) -> clocks.Bodies:
    """The reference's own orientations; without any, the path's, which are the camera's."""
    if reference_wxyz is not None and turn_offset_s is None:
        return lambda offset_s: reference_wxyz
    by_video_s, wxyz = path.time_s, _poses(path)
    if reference_wxyz is not None and turn_offset_s is not None:
        by_video_s, wxyz = turns_s - turn_offset_s, reference_wxyz
    return lambda offset_s: None if offset_s is None else clocks.at_times(by_video_s, wxyz, time_s - offset_s)


def _turning(
    path: CameraPath, body_wxyz: Float[np.ndarray, "frames 4"], offset_s: float, with_turn: bool
) -> Turning:
    pose_wxyz = _poses(path)
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
    return Turning(
        offset_s, turn.as_quat(scalar_first=True), reference_wxyz, wrapped_deg(difference_deg), angle_deg
    )


def _poses(path: CameraPath) -> Float[np.ndarray, "frames 4"]:
    return np.where(path.seen[:, None], path.orientation_wxyz, np.nan)
