"""A path with orientations, compared with a reference that was recorded by other clocks: the paper's Tables 7 and 8.

The paper (technical validation, "ArUco markers") shifts the path along the reference, takes the offset with the
smallest mean distance, and states distances and differences of angles at corresponding frames. Here the offset is found
to a fraction of a sample (`offsets`). Orientations may have their own clock, such as an IMU's: their offset is found
from the rotation of the camera.

Two constant differences are no errors: the lever arm, from the reference's point on the drone to the camera, and the
turn from the camera's axes to the axes of the reference's body. Each can be estimated and removed, and is returned.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError
from psotrack.evaluation.offsets import ShiftedPair, refused
from psotrack.support import finite_or_none
from psotrack.trajectories import (
    GATE_M,
    Status,
    Trajectories,
    resample,
    roll_pitch_yaw_deg,
    rotation_matrices,
)

_Quaternions = Float[np.ndarray, "frames 4"]
_Points = Float[np.ndarray, "frames 3"]
_Values = Float[np.ndarray, "frames"]
#: Number of neighbouring frames whose median position shows jumps.
_NEIGHBOURS = 9
#: Number of iterations of the mean rotation.
_MEAN_STEPS = 10
#: Three points stand for the axes of a body: their distance from its origin, which is within the gate of a pairing, and
#: the distance between the three origins, metres.
_OUT_M, _APART_M = 0.1, 10.0


@dataclass(frozen=True)
class PathSettings:
    """How a path is compared with its reference.

    Attributes:
        with_lever_arm: find a constant lever arm from the reference's point to the path's.
        with_turn: find a constant turn between the axes of the path and of the reference's body.
        axes: axes of the path, for roll, pitch and yaw: of a camera (x right, y down, z ahead) or of a body (x ahead,
            y left, z up).
        max_offset_s: largest offset that is tried, seconds; None: half of the shorter recording overlaps.
    """

    with_lever_arm: bool = True
    with_turn: bool = True
    axes: Literal["camera", "body"] = "camera"
    max_offset_s: float | None = None


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
class OrientationComparison:
    """Orientations of a path and its reference at corresponding frames. Values that are not known are NaN.

    Attributes:
        offset_s: the reference's orientation at t + offset_s corresponds to the path at t, seconds.
        turn_wxyz: (4,), constant turn from the axes of the path to those of the reference's body; the identity if it
            is not estimated.
        reference_wxyz: (frames, 4), orientation by the reference, with the turn, in the path's axes to world.
        difference_deg: (frames, 3), in roll, pitch and yaw (`roll_pitch_yaw_deg`): path minus reference, each wrapped
            to (-180, 180]. Table 8.
        angle_deg: (frames,), angle of the rotation between the two orientations.
    """

    offset_s: float
    turn_wxyz: Float[np.ndarray, "4"]
    reference_wxyz: _Quaternions
    difference_deg: _Points
    angle_deg: _Values


@dataclass(frozen=True)
class PathComparison:
    """A path and its reference at corresponding frames. Values that are not known are NaN.

    Attributes:
        frame: (frames,), frame numbers of the path.
        time_s: (frames,), times of the path, seconds.
        position_m: (frames, 3), positions of the path, world; NaN in lost frames.
        offset_s: the reference's position at t + offset_s corresponds to the path at t, seconds.
        offset_std_s: standard deviation of `offset_s`, from motion and remaining distances; NaN if it was given.
        lever_arm_m: (3,), from the reference's point to the camera, in the axes of the reference's body, or of the
            camera where the reference has no orientations; zeros if it is not estimated.
        reference_m: (frames, 3), position of the camera by the reference, with the lever arm, world.
        distance_m: (frames,), from `reference_m` to the path. Table 7.
        distance_to_point_m: (frames,), from the reference's point to the path, without the lever arm.
        turning: comparison of orientations; None where the path or the reference has none.
    """

    frame: Int[np.ndarray, "frames"]
    time_s: _Values
    position_m: _Points
    offset_s: float
    offset_std_s: float
    lever_arm_m: Float[np.ndarray, "3"]
    reference_m: _Points
    distance_m: _Values
    distance_to_point_m: _Values
    turning: OrientationComparison | None

    @property
    def path_length_m(self) -> float:
        """Length of the reference's path over the frames in which it is known, metres."""
        known_m = self.reference_m[np.isfinite(self.reference_m).all(axis=-1)]
        return float(np.linalg.norm(np.diff(known_m, axis=0), axis=-1).sum())

    @property
    def statistics(self) -> dict[str, Statistics]:
        """The rows of Tables 7 and 8: distances in metres, signed and absolute differences of angles in degrees."""
        rows = {"distance_m": self.distance_m, "distance_to_point_m": self.distance_to_point_m}
        if self.turning is not None:
            names = ("roll_deg", "pitch_deg", "yaw_deg")
            angles_deg = dict(zip(names, self.turning.difference_deg.T, strict=True))
            rows |= angles_deg | {f"abs_{name}": np.abs(values) for name, values in angles_deg.items()}
            rows["angle_deg"] = self.turning.angle_deg
        return {name: Statistics.of(values) for name, values in rows.items()}

    def to_dict(self) -> dict[str, Any]:
        """Offsets, constants and statistics, fit for JSON; None for what is not known."""
        turning = self.turning
        return {
            "offset_s": self.offset_s,
            "offset_std_s": finite_or_none(self.offset_std_s),
            "orientation_offset_s": None if turning is None else turning.offset_s,
            "lever_arm_m": self.lever_arm_m.tolist(),
            "turn_wxyz": None if turning is None else turning.turn_wxyz.tolist(),
            "path_length_m": self.path_length_m,
        } | {
            name: {key: None if value != value else value for key, value in asdict(one).items()}
            for name, one in self.statistics.items()
        }


def compare_paths(
    path: Trajectories,
    reference: Trajectories,
    turns: Trajectories | None = None,
    settings: PathSettings | None = None,
    *,
    offset_s: float | None = None,
) -> PathComparison:
    """Compare a path with a reference of any rate, whose clocks differ from the video's.

    Between samples of the reference, positions and orientations are splines, but not over gaps longer than
    `resampling.MAX_GAP_S`. Lost poses are left out; all others count, even if they are wrong.

    Args:
        path: path of one drone or camera at the times of the video, with orientations if they are to be compared.
        reference: poses of one drone by the reference, at its own times.
        turns: orientations of the reference if they have a clock of their own; their positions are not used. None: the
            orientations of `reference`, if it has any.
        settings: how they are compared; None: the defaults.
        offset_s: the offset of all clocks of the reference, seconds; None finds it.

    Raises:
        SettingsError: the range is smaller than a step of the reference.
        InputError: there are several drones, path and reference do not overlap, or the motion does not determine the
            offset; see `find_offset`.
    """
    for name, each in (("path", path), ("reference", reference)):
        if each.num_drones != 1:
            raise InputError(name, expected="one drone", found=f"{', '.join(each.drones) or 'none'}")
    settings = settings or PathSettings()
    pose_wxyz, turn_offset_s = _seen_orientations(path), offset_s
    if turns is not None and offset_s is None:
        turn_offset_s = _orientation_offset(path, turns, settings)
    placed = ShiftedPair.of(
        _without_jumps(path),
        reference.time_s,
        reference.position_m,
        reference.orientation_wxyz if settings.with_lever_arm and turns is None else None,
        settings.with_lever_arm,
    )
    if settings.with_lever_arm and placed.rotation is None:
        # Orientations that do not depend on the offset turn the arm.
        turned = pose_wxyz if turns is None else _at_frames(turns, path, turn_offset_s or 0.0)
        if turned is not None:
            rotation = rotation_matrices(turned)[:, None]
            placed = replace(placed, rotation=lambda _: rotation)
    std_s = np.nan
    if offset_s is None:
        found = placed.search(*_offset_range(placed, reference, settings.max_offset_s))
        offset_s, std_s = found.offset_s, found.std_s
    position_m = np.where(path.seen, path.position_m[:, 0], np.nan)
    placed = replace(placed, est_m=position_m[:, None])
    arm_m, residual_m = placed.residuals(offset_s, np.zeros(1, int))
    turning, by_s = None, offset_s if turn_offset_s is None else turn_offset_s
    reference_wxyz = _at_frames(reference if turns is None else turns, path, by_s)
    if reference_wxyz is not None and pose_wxyz is not None:
        turning = _compare_orientations(pose_wxyz, reference_wxyz, by_s, settings)
    point_m = placed.position_m(path.time_s + offset_s)[:, 0]
    return PathComparison(
        frame=path.frame,
        time_s=path.time_s,
        position_m=position_m,
        offset_s=offset_s,
        offset_std_s=std_s,
        lever_arm_m=arm_m[0],
        reference_m=placed.placed_m(offset_s, arm_m)[:, 0],
        distance_m=np.linalg.norm(residual_m[:, 0], axis=-1),
        distance_to_point_m=np.linalg.norm(position_m - point_m, axis=-1),
        turning=turning,
    )


def drone_of(reference: Trajectories, name: str | None = None) -> Trajectories:
    """The reference of the drone of this name, or of its only drone.

    Raises:
        InputError: there are several drones, and none has the name.
    """
    if name not in reference.drones and reference.num_drones > 1:
        drones = ", ".join(reference.drones)
        raise InputError(
            "reference",
            expected=f"a drone {name or ''}".rstrip(),
            found=drones,
            remedy="name one with --drone",
        )
    index = reference.drones.index(name) if name in reference.drones else 0
    return reference.of_drones([index])


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


def _orientation_offset(path: Trajectories, turns: Trajectories, settings: PathSettings) -> float:
    """The clock offset of orientations, seconds, from orientations alone.

    At the right offset, points on the path's axes are at rest in the body: their lever arms are the columns of the
    constant turn from the path's axes to the body's. The remaining distances are chords of the remaining angles.
    """
    path, middles_m = _without_jumps(path), _APART_M * np.eye(3)
    pose_wxyz = _seen_orientations(path)
    if pose_wxyz is None or turns.orientation_wxyz is None:
        raise refused("orientations of both", "none")
    axes_m = middles_m + _OUT_M * _axes(pose_wxyz)
    estimate = Trajectories(path.frame, path.time_s, ("x", "y", "z"), axes_m)
    body_wxyz = turns.orientation_wxyz[:, 0]
    known = np.isfinite(body_wxyz).all(axis=-1)[:, None, None]
    points_m = (
        np.where(known, middles_m, np.nan) if settings.with_turn else middles_m + _OUT_M * _axes(body_wxyz)
    )
    turned = np.repeat(turns.orientation_wxyz, 3, axis=1) if settings.with_turn else None
    pair = ShiftedPair.of(estimate, turns.time_s, points_m, turned, settings.with_turn)
    marks = replace(turns, drones=estimate.drones, position_m=points_m, orientation_wxyz=None)
    return pair.search(*_offset_range(pair, marks, settings.max_offset_s)).offset_s


def _offset_range(
    pair: ShiftedPair, reference: Trajectories, max_offset_s: float | None
) -> tuple[float, float]:
    """Middle and half width of the range of offsets; by default half of the shorter recording always overlaps."""
    if max_offset_s is not None:
        return 0.0, max_offset_s
    spans_s = (
        pair.time_s[np.isfinite(pair.est_m).any(axis=(1, 2))],
        reference.time_s[np.isfinite(reference.position_m).any(axis=(1, 2))],
    )
    if not all(map(len, spans_s)):
        raise refused("poses of both", f"{len(spans_s[0])} and {len(spans_s[1])}")
    middles_s = [(span_s[0] + span_s[-1]) / 2 for span_s in spans_s]
    return float(middles_s[1] - middles_s[0]), float(max(map(np.ptp, spans_s)) / 2)


def _without_jumps(path: Trajectories) -> Trajectories:
    """The path without poses far from the poses before and after, which say nothing about time.

    They would move the smallest mean distance little, but would hide how distinct it is.
    """
    seen = np.flatnonzero(path.seen[:, 0])
    position_m = path.position_m[seen, 0]
    jump_m = np.linalg.norm(position_m - median_filter(position_m, (_NEIGHBOURS, 1), mode="nearest"), axis=-1)
    status = np.where(path.seen, int(Status.TRACKED), int(Status.LOST))
    status[seen[jump_m > GATE_M]] = Status.LOST
    return replace(path, status=status)


def _at_frames(body: Trajectories, path: Trajectories, later_s: float) -> _Quaternions | None:
    """Orientations of the reference at the path's frames; None if it has none."""
    turned = resample(body, path.frame, path.time_s, later_s=later_s).orientation_wxyz
    return None if turned is None else turned[:, 0]


def _compare_orientations(
    pose_wxyz: _Quaternions, body_wxyz: _Quaternions, offset_s: float, settings: PathSettings
) -> OrientationComparison:
    known = np.isfinite(body_wxyz).all(axis=-1)
    both = known & np.isfinite(pose_wxyz).all(axis=-1)
    if not both.any():
        raise refused("orientations of both in some frame", "none")
    bodies, poses = (Rotation.from_quat(wxyz[both], scalar_first=True) for wxyz in (body_wxyz, pose_wxyz))
    turn = mean_rotation(bodies.inv() * poses) if settings.with_turn else Rotation.identity()
    reference_wxyz, angle_deg = np.full_like(body_wxyz, np.nan), np.full(len(body_wxyz), np.nan)
    every = Rotation.from_quat(body_wxyz[known], scalar_first=True)
    reference_wxyz[known] = (every * turn).as_quat(scalar_first=True)
    angle_deg[both] = np.degrees(((bodies * turn).inv() * poses).magnitude())
    pose_deg, reference_deg = (
        roll_pitch_yaw_deg(wxyz, is_camera=settings.axes == "camera") for wxyz in (pose_wxyz, reference_wxyz)
    )
    return OrientationComparison(
        offset_s,
        turn.as_quat(scalar_first=True),
        reference_wxyz,
        wrap_deg(pose_deg - reference_deg),
        angle_deg,
    )


def _seen_orientations(path: Trajectories) -> _Quaternions | None:
    if path.orientation_wxyz is None:
        return None
    return np.where(path.seen, path.orientation_wxyz[:, 0], np.nan)


def _axes(orientation_wxyz: Float[np.ndarray, "times 4"]) -> Float[np.ndarray, "times 3 3"]:
    """The axes of each frame in the world, one per row."""
    return rotation_matrices(orientation_wxyz).swapaxes(-1, -2)
