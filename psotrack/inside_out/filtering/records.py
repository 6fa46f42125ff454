"""Input and output of the filter: its parameters, measured poses, and estimates."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from psotrack.errors import SettingsError, check_positive
from psotrack.inside_out.filtering.manifold import rotation_matrices
from psotrack.inside_out.frame_motion import FrameMotion


@dataclass(frozen=True)
class PoseFilterParams:
    """Parameters of the pose filter.

    Attributes:
        false_alarm: probability that a good pose is gated.
        longest_gap_s: time without a fitting pose after which no pose is returned until poses are confirmed again,
            seconds.
        confirm: number of poses that must agree before the first pose is returned, unless the markers of one pose agree
            so well that it is wrong less often than `false_alarm`. 1 accepts every first pose.
        restart_after: number of successive poses that agree with one another and not with the state, after which they
            replace the state. A state that rests on fewer poses needs fewer, unless the markers of one of its poses
            agree beyond chance.
    """

    false_alarm: float = 1e-3
    longest_gap_s: float = 0.5
    confirm: int = 3
    restart_after: int = 10

    def __post_init__(self) -> None:
        check_positive("longest_gap_s", self.longest_gap_s)
        if not 0 < self.false_alarm < 1:
            raise SettingsError(
                "false_alarm", expected="a probability above 0 and below 1", found=f"{self.false_alarm:g}"
            )
        for name in ("confirm", "restart_after"):
            if getattr(self, name) < 1:
                raise SettingsError(name, expected="at least 1", found=f"{getattr(self, name)}")

    def within(self, num_frames: int | None) -> PoseFilterParams:
        """Parameters for a recording of `num_frames` frames: `confirm` is at most this number. None is a stream."""
        return self if num_frames is None else replace(self, confirm=max(1, min(self.confirm, num_frames)))


@dataclass(frozen=True)
class MeasuredPose:
    """The pose of a camera from one frame alone.

    Attributes:
        time_s: time of the frame, seconds.
        position_m, orientation_wxyz, ambiguity: as in `CameraPath`.
        covariance: (6, 6), as in `CameraPath`, without the part that `common` describes.
        common: (6, errors), change of the pose by one standard deviation of each error that is the same in all frames.
        chance: upper bound on the probability that the used markers agree by chance.
        motion: of a rolling shutter, what the frame says about pose and motion together; its covariance too is without
            the part that `common` describes. None of a global shutter.
    """

    time_s: float
    position_m: Float[np.ndarray, "3"]
    orientation_wxyz: Float[np.ndarray, "4"]
    covariance: Float[np.ndarray, "6 6"]
    ambiguity: float = 0.0
    common: Float[np.ndarray, "6 errors"] = field(default_factory=lambda: np.zeros((6, 0)))
    chance: float = 1.0
    motion: FrameMotion | None = None

    def scaled(self, factor: float) -> MeasuredPose:
        """The pose with covariances that are multiplied by a factor; the part of `common` stays."""
        motion = self.motion and replace(
            self.motion,
            covariance=factor * self.motion.covariance,
            measured_covariance=factor * self.motion.measured_covariance,
        )
        return replace(self, covariance=factor * self.covariance, motion=motion)

    @property
    def p_wrong(self) -> float:
        """Upper bound on the probability that the pose is wrong, from its frame alone."""
        return self.chance + self.ambiguity


@dataclass(frozen=True)
class PoseEstimate:
    """An estimated pose with its velocity and covariance.

    Attributes:
        position_m: (3,), the camera's centre, world, metres.
        orientation_wxyz: (4,), unit quaternion, camera to world.
        covariance: (6, 6), as in `CameraPath`.
        velocity_m_s: (3,), world.
        rate_rad_s: (3,), turn rate about the camera's axes.
        motion_covariance: (6, 6), covariance of velocity and turn rate.
        acceleration_m_s2: root mean square of the acceleration along an axis.
        wobble_density_rad2_s3: power spectral density of the angular acceleration about each axis.
    """

    position_m: Float[np.ndarray, "3"]
    orientation_wxyz: Float[np.ndarray, "4"]
    covariance: Float[np.ndarray, "6 6"]
    velocity_m_s: Float[np.ndarray, "3"]
    rate_rad_s: Float[np.ndarray, "3"]
    motion_covariance: Float[np.ndarray, "6 6"]
    acceleration_m_s2: float
    wobble_density_rad2_s3: float

    @property
    def R_world_cam(self) -> Float[np.ndarray, "3 3"]:
        """(3, 3), rotation from camera to world."""
        return rotation_matrices(self.orientation_wxyz[None])[0]
