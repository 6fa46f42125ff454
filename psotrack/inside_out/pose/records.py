"""Records of pose estimation: its settings, the pose that motion predicts, and the pose that a frame's markers give."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

from psotrack.errors import SettingsError, check_positive
from psotrack.inside_out.frame_motion import FrameMotion


@dataclass(frozen=True)
class PoseSettings:
    """Settings of pose estimation.

    Attributes:
        min_markers: smallest number of markers that a pose is estimated from, 1 or more.
        noise_px: standard deviation of a corner along x and along y, pixels; corrected by the residuals if there are
            enough residuals.
        place_m: standard deviation of the error that all corners of a marker share in one frame, along each axis of
            the world, metres; corrected by the residuals too.
        map_error_m: standard deviation of a marker's position in the map along each axis, metres; the same error in
            every frame.
        focal_error: standard deviation of the focal length, as a share of the focal length; the same error in every
            frame.
        centre_scale: deviation of the mean error of a marker's corners, as a multiple of the deviation that it would
            have if the errors of the corners were independent; None is estimated from a recording, and is 1 otherwise.
        usual_px: standard deviation of a corner in the other frames, which counts together with a frame's own
            residuals; None is estimated from a recording, and is `noise_px` otherwise. Whether markers agree at all is
            judged by `noise_px`.
        usual_place_m: the same of `place_m`.
        shift_px: standard deviation of an error that all corners of a frame share, along x and along y, pixels. It
            looks like a turn of the camera, so that no residual shows it; in drawn videos it was 0.012 to 0.017 px.
    """

    min_markers: int = 4
    noise_px: float = 0.2
    place_m: float = 0.0001
    map_error_m: float = 0.0
    focal_error: float = 0.0
    centre_scale: float | None = None
    usual_px: float | None = None
    usual_place_m: float | None = None
    shift_px: float = 0.015

    def __post_init__(self) -> None:
        check_positive("noise_px", self.noise_px)
        check_positive("place_m", self.place_m)
        for name in ("centre_scale", "usual_px", "usual_place_m"):
            value = getattr(self, name)
            if value is not None:
                check_positive(name, value)
        if self.min_markers < 1:
            raise SettingsError("min_markers", expected="at least 1", found=f"{self.min_markers}")
        for name in ("map_error_m", "focal_error", "shift_px"):
            if not 0 <= getattr(self, name) < 1:
                raise SettingsError(
                    name, expected="a number from 0 to below 1", found=f"{getattr(self, name):g}"
                )


@dataclass(frozen=True)
class RollingShutter:
    """Rolling shutter of a camera: its rows are exposed one after the other.

    Attributes:
        line_time_s: time from the exposure of one row to that of the next row, seconds; negative if the rows are
            exposed from the last row to the first.
        std_s: standard deviation of the line time, seconds.
    """

    line_time_s: float
    std_s: float = 0.0


@dataclass(frozen=True)
class ExpectedMotion:
    """Motion of a camera as the frames before predict it.

    Attributes:
        motion: (6,), velocity along the world's axes (m/s) and turn rate about the camera's axes (rad/s).
        covariance: (6, 6), its covariance.
        acceleration_std: (6,), standard deviations of the acceleration along the world's axes (m/s²) and of the angular
            acceleration about the camera's axes (rad/s²), by which the motion changes during a frame.
    """

    motion: Float[np.ndarray, "6"]
    covariance: Float[np.ndarray, "6 6"]
    acceleration_std: Float[np.ndarray, "6"] = field(default_factory=lambda: np.zeros(6))


@dataclass(frozen=True)
class ExpectedPose:
    """Pose of a camera as its motion predicts it.

    Attributes:
        position_m: (3,), the camera's centre, world, metres.
        R_world_cam: (3, 3), camera to world.
        covariance: (6, 6), as in `CameraPath`.
    """

    position_m: Float[np.ndarray, "3"]
    R_world_cam: Float[np.ndarray, "3 3"]
    covariance: Float[np.ndarray, "6 6"]


@dataclass(frozen=True)
class CornerResiduals:
    """Residuals of one frame: of the corners, and of the markers' means.

    Attributes:
        squares_px2: sum of squares of the corners' own errors, square pixels.
        freedom: its degrees of freedom.
        observed: sum of the squares of the markers' mean residuals, each times the number of the marker's corners, in
            units of the variance of a corner's own error.
        expected: the sum that the covariances of errors and fit let expect.
        by_places: share of the errors of the markers' places in the variance of the means, 0 to 1.
    """

    squares_px2: float
    freedom: float
    observed: float
    expected: float
    by_places: float


@dataclass(frozen=True)
class MarkerPose:
    """Pose of a camera from the markers in one frame, with its uncertainty.

    Attributes:
        position_m: (3,), the camera's centre, world, metres.
        R_world_cam: (3, 3), camera to world; camera axes x right, y down, z ahead.
        covariance: (6, 6), as in `CameraPath`: of the position along the world's axes (m) and of a small turn about the
            camera's axes (rad).
        used: (markers,), True for the markers that the pose explains.
        reprojection_px: root mean square distance, over the used corners, between image and projection, pixels.
        ambiguity: probability that another pose is the right one, 0 to 1/2.
        common: (6, 3 markers + 1), a matrix square root of the part of the covariance that comes from errors common
            to all frames: one column per axis of each marker's position in the map, and one for the focal length, each
            for an error of one standard deviation.
        chance: upper bound on the probability that the used markers agree by chance although all ids are wrong.
        residuals: residuals of the corners and of the markers' means; None if unknown.
        motion: of a rolling shutter, what the frame says about pose and motion; None of a global shutter. Columns of
            its `common` are those of `common`, and one for the line time if `by_line_time` is not None.
        by_line_time: (6,), change of the pose by an error of the line time of one standard deviation; None if the line
            time is exact.
    """

    position_m: Float[np.ndarray, "3"]
    R_world_cam: Float[np.ndarray, "3 3"]
    covariance: Float[np.ndarray, "6 6"]
    used: Bool[np.ndarray, "markers"]
    reprojection_px: float
    ambiguity: float
    common: Float[np.ndarray, "6 errors"]
    chance: float
    residuals: CornerResiduals | None = None
    motion: FrameMotion | None = None
    by_line_time: Float[np.ndarray, "6"] | None = None
