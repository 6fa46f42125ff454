"""One drone: the path of its camera and the outside track of its middle, fused."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.inside_out.camera_path import CameraPath
from psotrack.inside_out.fusing.error_models import CHI2_3_MEDIAN, expected_model, fitted
from psotrack.inside_out.fusing.gating import gated
from psotrack.inside_out.fusing.joint_filter import INSIDE, OUTSIDE, Arm, ErrorModel, Joint, Readings, smooth
from psotrack.inside_out.fusing.mounting import Mounted, mounted, robust_arm, swept_m2
from psotrack.trajectories import Status

#: The point of a drone whose track it is: the centre of its camera, or the middle of its silhouette.
Point = Literal["camera", "middle"]

#: Over gaps of both sources a drone coasts so long, from either side; then it is lost.
MAX_COASTING_S = 0.5
#: Beforehand an arm is no longer than a drone, along each axis.
_ARM_STD_M = 0.3
#: No arm is known better beforehand than this: the silhouette's middle wanders about in the body.
_LEAST_ARM_STD_M = 0.01
#: Standard errors of the arm that is found first; nobody knows how the rest is distributed.
_ARM_ERRORS = 3.0
#: Kept on every stated variance, m2: no pose is known to a hundredth of a millimetre.
_LEAST_M2 = 1e-10
#: Sources that never differ at all are no better than this part of what they state, as a variance.
_LEAST_SCALE = 1e-6


@dataclass(frozen=True)
class Errors:
    """How one source errs, as the differences between the two tell.

    Attributes:
        scale: its standard deviations are so many times what it states.
        lasting_share: of the variance, what lasts over frames.
        lasting_s: after which 1 / e of such an error is left.
        gated: frames in which it was grossly off and did not count.
    """

    scale: float
    lasting_share: float
    lasting_s: float
    gated: int


@dataclass(frozen=True)
class DroneTrack:
    """One drone over frames; NaN where nothing is known.

    Attributes:
        position_m, velocity_m_s: (frames, 3), world.
        covariance_m2: (frames, 3, 3), of the position.
        orientation_wxyz: (frames, 4), camera to world.
        status: (frames,), values of `Status`.
        used: (frames, 2), whether the inside and the outside were used.
    """

    position_m: Float[np.ndarray, "frames 3"]
    velocity_m_s: Float[np.ndarray, "frames 3"]
    covariance_m2: Float[np.ndarray, "frames 3 3"]
    orientation_wxyz: Float[np.ndarray, "frames 4"]
    status: Int[np.ndarray, "frames"]
    used: Bool[np.ndarray, "frames 2"]


@dataclass(frozen=True)
class DroneFusion:
    """A fused drone, and what was found on the way.

    Attributes:
        track: of the drone.
        arm_m, arm_std_m: (3,), from the camera's centre to the middle, in the camera's axes, and standard errors.
        inside, outside: how each source errs.
    """

    track: DroneTrack
    arm_m: Float[np.ndarray, "3"]
    arm_std_m: Float[np.ndarray, "3"]
    inside: Errors
    outside: Errors


def fuse_drone(
    path: CameraPath,
    frame: Int[np.ndarray, "frames"],
    time_s: Float[np.ndarray, "frames"],
    clock_s: float,
    middle_m: Float[np.ndarray, "frames 3"],
    middle_covariance_m2: Float[np.ndarray, "frames 3 3"],
    point: Point,
) -> DroneFusion:
    """Fuse a path and an outside track, which have frames in common.

    Args:
        path: of the camera, by its own clock.
        frame, time_s: (frames,), numbers and times by the clock of the outside tracks.
        clock_s: the path at t + clock_s belongs to the frame at t.
        middle_m: (frames, 3), NaN where the track is not tracked.
        middle_covariance_m2: (frames, 3, 3), of that.
        point: whose track it is to be.
    """
    camera = mounted(path, time_s, clock_s)
    arm_m, arm_error_m = robust_arm(camera, middle_m, frame)
    near = Arm(
        arm_m, max(_ARM_ERRORS * arm_error_m, _LEAST_ARM_STD_M) if np.isfinite(arm_error_m) else _ARM_STD_M
    )
    open_arm = Arm(arm_m, _ARM_STD_M)
    middle = middle_m, middle_covariance_m2
    readings = _readings(path, camera, time_s, *middle, arm_m, point)
    expected = expected_model(_excess(_difference_m(camera, middle_m, arm_m), readings))
    out, added_m2 = gated(readings, expected, near)
    gross = out[:, INSIDE].copy()
    if gross.any():
        # A gross pose turns the arm wrongly as well: its turn is between its neighbours'.
        camera = mounted(_without(path, camera.index[gross]), time_s, clock_s)
        readings = _readings(path, camera, time_s, *middle, arm_m, point)
        out, added_m2 = gated(readings, expected, near)
    difference_m = _difference_m(camera, middle_m, arm_m)
    covariance_m2, model = fitted(_used(readings, out, added_m2), difference_m, open_arm)
    readings = replace(readings, covariance_m2=covariance_m2)
    out, added_m2 = gated(readings, model, near)
    joint = smooth(_used(readings, out, added_m2), model, open_arm)
    used = readings.known & ~out
    out[:, INSIDE] |= gross
    return DroneFusion(
        track=_track(joint, path, camera, time_s, used),
        arm_m=joint.arm_m,
        arm_std_m=np.sqrt(np.diag(joint.arm_covariance_m2)),
        inside=_errors(model, INSIDE, out),
        outside=_errors(model, OUTSIDE, out),
    )


def path_alone(path: CameraPath, time_s: Float[np.ndarray, "frames"], clock_s: float) -> DroneTrack:
    """A path as it is, at its samples that are nearest to the frames."""
    camera = mounted(path, time_s, clock_s, coasting=True)
    known = camera.index >= 0

    def rows(values: Float[np.ndarray, "samples *rest"]) -> Float[np.ndarray, "frames *rest"]:
        picked = values[camera.index].astype(np.float64)
        picked[~known] = np.nan
        return picked

    velocity_m_s = np.full_like(path.position_m, np.nan) if path.velocity_m_s is None else path.velocity_m_s
    status = np.where(known, path.status[camera.index], int(Status.LOST))
    return DroneTrack(
        position_m=rows(path.position_m),
        velocity_m_s=rows(velocity_m_s),
        covariance_m2=rows(path.covariance[:, :3, :3]),
        orientation_wxyz=rows(path.orientation_wxyz),
        status=status,
        used=np.stack([status == Status.TRACKED, np.zeros(len(status), bool)], axis=1),
    )


def _readings(
    path: CameraPath,
    camera: Mounted,
    time_s: Float[np.ndarray, "frames"],
    middle_m: Float[np.ndarray, "frames 3"],
    middle_covariance_m2: Float[np.ndarray, "frames 3 3"],
    arm_m: Float[np.ndarray, "3"],
    point: Point,
) -> Readings:
    known = np.stack([camera.known, np.isfinite(middle_m).all(axis=1)], axis=1)
    position_m = np.stack([path.position_m[camera.index], middle_m], axis=1)
    covariance_m2 = np.stack([path.covariance[camera.index, :3, :3], middle_covariance_m2], axis=1)
    covariance_m2 = np.where(known[..., None, None], covariance_m2, np.eye(3)) + _LEAST_M2 * np.eye(3)
    lever, added_m2 = np.zeros(covariance_m2.shape), np.zeros(covariance_m2.shape)
    # The one that is not of the point has the arm between it and the point, and what the turn does not tell of it.
    of_arm, sign = (OUTSIDE, 1.0) if point == "camera" else (INSIDE, -1.0)
    lever[:, of_arm] = sign * camera.rotation
    added_m2[:, of_arm] = swept_m2(camera, arm_m)
    return Readings(
        time_s=time_s,
        position_m=np.where(known[..., None], position_m, 0.0),
        covariance_m2=covariance_m2,
        known=known,
        ahead_s=np.stack([camera.ahead_s, np.zeros(len(time_s))], axis=1),
        lever=lever,
        added_m2=added_m2,
    )


def _difference_m(
    camera: Mounted, middle_m: Float[np.ndarray, "frames 3"], arm_m: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "frames 3"]:
    """(frames, 3), the outside less the inside and the arm; NaN where either is not known."""
    return middle_m - camera.position_m - camera.rotation @ arm_m


def _excess(difference_m: Float[np.ndarray, "frames 3"], readings: Readings) -> float:
    """By how much the squared differences exceed the stated variances, in the median."""
    both = np.isfinite(difference_m).all(axis=1) & readings.known.all(axis=1)
    if not both.any():
        return 1.0
    normalised = np.linalg.solve(readings.covariance_m2[both].sum(axis=1), difference_m[both][..., None])[
        ..., 0
    ]
    return max(float(np.median((difference_m[both] * normalised).sum(axis=1))) / CHI2_3_MEDIAN, _LEAST_SCALE)


def _used(
    readings: Readings, out: Bool[np.ndarray, "frames 2"], added_m2: Float[np.ndarray, "frames 2 3 3"]
) -> Readings:
    return replace(readings, known=readings.known & ~out, added_m2=readings.added_m2 + added_m2)


def _without(path: CameraPath, rows: Int[np.ndarray, "rows"]) -> CameraPath:
    status = path.status.copy()
    status[rows] = Status.LOST
    return replace(path, status=status)


def _errors(model: ErrorModel, source: int, out: Bool[np.ndarray, "frames 2"]) -> Errors:
    white, lasting = float(model.white[0, source]), float(model.lasting[0, source])
    return Errors(
        scale=float(np.sqrt(white + lasting)),
        lasting_share=lasting / (white + lasting),
        lasting_s=float(model.time_s[0, source]),
        gated=int(out[:, source].sum()),
    )


def _track(
    joint: Joint,
    path: CameraPath,
    camera: Mounted,
    time_s: Float[np.ndarray, "frames"],
    used: Bool[np.ndarray, "frames 2"],
) -> DroneTrack:
    """The fused drone; lost, and unknown, where neither source says anything for long."""
    tracked = used.any(axis=1)
    seen_s = time_s[tracked]
    after = np.clip(np.searchsorted(seen_s, time_s), 1, max(len(seen_s) - 1, 1))
    nearest_s = np.minimum(
        np.abs(time_s - seen_s[after - 1]), np.abs(time_s - seen_s[np.minimum(after, len(seen_s) - 1)])
    )
    lost = nearest_s > MAX_COASTING_S
    status = np.where(tracked, int(Status.TRACKED), np.where(lost, int(Status.LOST), int(Status.COASTING)))
    orientation_wxyz = np.full((len(time_s), 4), np.nan)
    orientation_wxyz[camera.turned] = camera.orientation_wxyz[camera.turned]
    return DroneTrack(
        position_m=np.where(lost[:, None], np.nan, joint.position_m),
        velocity_m_s=np.where(lost[:, None], np.nan, joint.velocity_m_s),
        covariance_m2=np.where(lost[:, None, None], np.nan, joint.covariance_m2),
        orientation_wxyz=orientation_wxyz,
        status=status,
        used=used,
    )
