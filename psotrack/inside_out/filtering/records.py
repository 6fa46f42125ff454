"""What goes into the filter and what comes out of it: its parameters, measured poses, and estimates."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from psotrack.errors import SettingsError, check_positive
from psotrack.inside_out.filtering.manifold import rotation_matrices


@dataclass(frozen=True)
class PoseFilterParams:
    """What may be chosen of the filter.

    Attributes:
        false_alarm: probability with which a good pose is gated.
        longest_gap_s: after so long without a pose that fits, none is told until there are poses again.
        confirm: poses that must agree before the first is told, unless the markers of one of them agree beyond chance:
            it is wrong less often than good poses are gated. 1 believes every start.
        restart_after: poses in a row that agree with one another and not with the state, after which the state is
            given up; fewer, where it rests on fewer itself, and on none whose markers agree beyond chance.
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
        """The same for a recording of so many frames: where there are no more that could confirm a start, it counts."""
        return self if num_frames is None else replace(self, confirm=max(1, min(self.confirm, num_frames)))


@dataclass(frozen=True)
class MeasuredPose:
    """What one frame says of a camera by itself.

    Attributes:
        time_s: of the frame.
        position_m, orientation_wxyz, ambiguity: as in `CameraPath`.
        covariance: (6, 6), as there, without `common`.
        common: (6, errors), what one standard deviation of each error that never changes does to the pose.
        chance: probability at most that so many markers agree by chance.
    """

    time_s: float
    position_m: Float[np.ndarray, "3"]
    orientation_wxyz: Float[np.ndarray, "4"]
    covariance: Float[np.ndarray, "6 6"]
    ambiguity: float = 0.0
    common: Float[np.ndarray, "6 errors"] = field(default_factory=lambda: np.zeros((6, 0)))
    chance: float = 1.0

    @property
    def doubt(self) -> float:
        """Probability at most that it is wrong, by itself."""
        return self.chance + self.ambiguity


@dataclass(frozen=True)
class PoseEstimate:
    """A pose and how sure it is.

    Attributes:
        position_m: (3,), the camera's centre, world.
        orientation_wxyz: (4,), unit quaternion, camera to world.
        covariance: (6, 6), as in `CameraPath`.
        velocity_m_s: (3,), world.
    """

    position_m: Float[np.ndarray, "3"]
    orientation_wxyz: Float[np.ndarray, "4"]
    covariance: Float[np.ndarray, "6 6"]
    velocity_m_s: Float[np.ndarray, "3"]

    @property
    def R_world_cam(self) -> Float[np.ndarray, "3 3"]:
        """(3, 3), camera to world."""
        return rotation_matrices(self.orientation_wxyz[None])[0]
