"""Fusion of one drone: the path of its camera and the outside track of its middle."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.inside_out.camera_path import CameraPath
from psotrack.inside_out.fusing.error_models import CHI2_3_MEDIAN, expected_model, fit_error_model
from psotrack.inside_out.fusing.gating import gate_readings
from psotrack.inside_out.fusing.joint_filter import INSIDE, OUTSIDE, Arm, ErrorModel, Joint, Readings, smooth
from psotrack.inside_out.fusing.resampling import (
    ResampledPath,
    arm_covariance_m2,
    estimate_arm,
    resample_path,
)
from psotrack.trajectories import Status

#: Tracked point of a drone: the centre of its camera, or the middle of its silhouette.
Point = Literal["camera", "middle"]

#: Longest time to the nearest frame with a source during which a drone coasts, seconds; beyond, it is lost.
MAX_COASTING_S = 0.5
#: Prior standard deviation of an arm along each axis, metres: the size of a drone.
_ARM_STD_M = 0.3
#: Smallest prior standard deviation of an arm, metres: the silhouette's middle moves in the body.
_LEAST_ARM_STD_M = 0.01
#: Standard deviation of the first estimate of the arm, in its standard errors; the distribution is not known.
_ARM_ERRORS = 3.0
#: Smallest part of every stated variance, m2: no pose is known to a hundredth of a millimetre.
_LEAST_M2 = 1e-10
#: Smallest scale of stated variances, for sources that never differ at all.
_LEAST_SCALE = 1e-6


@dataclass(frozen=True)
class SourceErrors:
    """Error model of one source, estimated from the differences between the two sources.

    Attributes:
        scale: standard deviation of its errors divided by the stated one.
        lasting_share: share of the variance that lasts over several frames.
        lasting_s: time in which such an error decays to 1 / e, seconds.
        gated: number of frames in which it was grossly wrong and was not used.
    """

    scale: float
    lasting_share: float
    lasting_s: float
    gated: int

    def to_dict(self) -> dict[str, float]:
        """The error model, fit for JSON."""
        return {
            "scale": self.scale,
            "lasting_share": self.lasting_share,
            "lasting_s": self.lasting_s,
            "gross_frames": self.gated,
        }


@dataclass(frozen=True)
class DroneTrack:
    """Track of one drone; NaN where unknown.

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
    """A fused drone, with its arm and error models.

    Attributes:
        track: track of the drone.
        arm_m, arm_std_m: (3,), from the camera's centre to the middle, in the camera's axes, and standard errors.
        inside, outside: error models of the sources.
    """

    track: DroneTrack
    arm_m: Float[np.ndarray, "3"]
    arm_std_m: Float[np.ndarray, "3"]
    inside: SourceErrors
    outside: SourceErrors


def fuse_drone(
    path: CameraPath,
    frame: Int[np.ndarray, "frames"],
    time_s: Float[np.ndarray, "frames"],
    clock_s: float,
    middle_m: Float[np.ndarray, "frames 3"],
    middle_covariance_m2: Float[np.ndarray, "frames 3 3"],
    point: Point,
) -> DroneFusion:
    """Fuse a path and an outside track that have frames in common.

    Args:
        path: path of the camera, by its own clock.
        frame, time_s: (frames,), numbers and times by the clock of the outside tracks, seconds.
        clock_s: the path at t + clock_s belongs to the frame at t, seconds.
        middle_m: (frames, 3), positions of the track; NaN where it is not tracked.
        middle_covariance_m2: (frames, 3, 3), covariances of `middle_m`.
        point: tracked point of the result.
    """
    camera = resample_path(path, time_s, clock_s)
    arm_m, arm_error_m = estimate_arm(camera, middle_m)
    near = Arm(
        arm_m, max(_ARM_ERRORS * arm_error_m, _LEAST_ARM_STD_M) if np.isfinite(arm_error_m) else _ARM_STD_M
    )
    open_arm = Arm(arm_m, _ARM_STD_M)
    middle = middle_m, middle_covariance_m2
    readings = _make_readings(path, camera, time_s, *middle, arm_m, point)
    expected = expected_model(_variance_ratio(_differences_m(camera, middle_m, arm_m), readings))
    out, added_m2 = gate_readings(readings, expected, near)
    gross = out[:, INSIDE].copy()
    if gross.any():
        # The orientation of a gross pose is wrong too: take it from the neighbouring poses.
        camera = resample_path(_without_poses(path, camera.index[gross]), time_s, clock_s)
        readings = _make_readings(path, camera, time_s, *middle, arm_m, point)
        out, added_m2 = gate_readings(readings, expected, near)
    difference_m = _differences_m(camera, middle_m, arm_m)
    covariance_m2, model = fit_error_model(_with_gating(readings, out, added_m2), difference_m, open_arm)
    readings = replace(readings, covariance_m2=covariance_m2)
    out, added_m2 = gate_readings(readings, model, near)
    joint = smooth(_with_gating(readings, out, added_m2), model, open_arm)
    used = readings.known & ~out
    out[:, INSIDE] |= gross
    return DroneFusion(
        track=_make_track(joint, path, camera, time_s, used),
        arm_m=joint.arm_m,
        arm_std_m=np.sqrt(np.diag(joint.arm_covariance_m2)),
        inside=_source_errors(model, INSIDE, out),
        outside=_source_errors(model, OUTSIDE, out),
    )


def unfused_path(path: CameraPath, time_s: Float[np.ndarray, "frames"], clock_s: float) -> DroneTrack:
    """A path without fusion, at its samples nearest to the frames."""
    camera = resample_path(path, time_s, clock_s, coasting=True)
    known = camera.index >= 0

    def rows(values: Float[np.ndarray, "samples *rest"]) -> Float[np.ndarray, "frames *rest"]:
        chosen = values[camera.index].astype(np.float64)
        chosen[~known] = np.nan
        return chosen

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


def _make_readings(
    path: CameraPath,
    camera: ResampledPath,
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
    # The source of the other point includes the arm, and the part of its uncertainty that is due to the orientation.
    of_arm, sign = (OUTSIDE, 1.0) if point == "camera" else (INSIDE, -1.0)
    lever[:, of_arm] = sign * camera.rotation
    added_m2[:, of_arm] = arm_covariance_m2(camera, arm_m)
    return Readings(
        time_s=time_s,
        position_m=np.where(known[..., None], position_m, 0.0),
        covariance_m2=covariance_m2,
        known=known,
        ahead_s=np.stack([camera.ahead_s, np.zeros(len(time_s))], axis=1),
        lever=lever,
        added_m2=added_m2,
    )


def _differences_m(
    camera: ResampledPath, middle_m: Float[np.ndarray, "frames 3"], arm_m: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "frames 3"]:
    """(frames, 3), position by the outside less that by inside and arm; NaN where either is unknown."""
    return middle_m - camera.position_m - camera.rotation @ arm_m


def _variance_ratio(difference_m: Float[np.ndarray, "frames 3"], readings: Readings) -> float:
    """Median of the squared differences, divided by its expectation from the stated variances."""
    both = np.isfinite(difference_m).all(axis=1) & readings.known.all(axis=1)
    if not both.any():
        return 1.0
    normalised = np.linalg.solve(readings.covariance_m2[both].sum(axis=1), difference_m[both][..., None])[
        ..., 0
    ]
    return max(float(np.median((difference_m[both] * normalised).sum(axis=1))) / CHI2_3_MEDIAN, _LEAST_SCALE)


def _with_gating(
    readings: Readings, out: Bool[np.ndarray, "frames 2"], added_m2: Float[np.ndarray, "frames 2 3 3"]
) -> Readings:
    return replace(readings, known=readings.known & ~out, added_m2=readings.added_m2 + added_m2)


def _without_poses(path: CameraPath, rows: Int[np.ndarray, "rows"]) -> CameraPath:
    status = path.status.copy()
    status[rows] = Status.LOST
    return replace(path, status=status)


def _source_errors(model: ErrorModel, source: int, out: Bool[np.ndarray, "frames 2"]) -> SourceErrors:
    white, lasting = float(model.white[0, source]), float(model.lasting[0, source])
    return SourceErrors(
        scale=float(np.sqrt(white + lasting)),
        lasting_share=lasting / (white + lasting),
        lasting_s=float(model.time_s[0, source]),
        gated=int(out[:, source].sum()),
    )


def _make_track(
    joint: Joint,
    path: CameraPath,
    camera: ResampledPath,
    time_s: Float[np.ndarray, "frames"],
    used: Bool[np.ndarray, "frames 2"],
) -> DroneTrack:
    """The fused drone; lost, with NaN, where neither source has a reading for too long."""
    tracked = used.any(axis=1)
    seen_s = time_s[tracked]
    after = np.clip(np.searchsorted(seen_s, time_s), 1, max(len(seen_s) - 1, 1))
    nearest_s = np.minimum(
        np.abs(time_s - seen_s[after - 1]), np.abs(time_s - seen_s[np.minimum(after, len(seen_s) - 1)])
    )
    lost = nearest_s > MAX_COASTING_S
    status = np.where(tracked, int(Status.TRACKED), np.where(lost, int(Status.LOST), int(Status.COASTING)))
    orientation_wxyz = np.full((len(time_s), 4), np.nan)
    orientation_wxyz[camera.has_orientation] = camera.orientation_wxyz[camera.has_orientation]
    return DroneTrack(
        position_m=np.where(lost[:, None], np.nan, joint.position_m),
        velocity_m_s=np.where(lost[:, None], np.nan, joint.velocity_m_s),
        covariance_m2=np.where(lost[:, None, None], np.nan, joint.covariance_m2),
        orientation_wxyz=orientation_wxyz,
        status=status,
        used=used,
    )
