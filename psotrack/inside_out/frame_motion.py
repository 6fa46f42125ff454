"""`FrameMotion`: what one frame of a rolling shutter says about the camera's pose and its motion together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class FrameMotion:
    """Pose and motion of a camera by one frame whose rows were exposed one after the other.

    A frame's pose was computed with an assumed motion. With another motion it is the frame's pose less
    `by_motion @ (motion - assumed)`. Its errors, if the motion were known, and the errors of `measured` are
    independent, apart from `common`. A motion is a velocity along the world's axes (m/s) and a turn rate about the
    camera's axes (rad/s).

    Attributes:
        assumed: (6,), motion with which the pose was computed.
        by_motion: (6, 6), change of the pose, metres and radians, by the true motion.
        covariance: (6, 6), covariance of the pose if the motion were known, as in `CameraPath`; `common` is in it.
        measured: (6,), motion by the rows of this frame alone.
        measured_covariance: (6, 6), its covariance; wide in directions that the markers do not show. `common` is in it.
        common: (12, errors), change of the pose for a known motion, and of the measured motion, by one standard
            deviation of each error that is the same in all frames.
    """

    assumed: Float[np.ndarray, "6"]
    by_motion: Float[np.ndarray, "6 6"]
    covariance: Float[np.ndarray, "6 6"]
    measured: Float[np.ndarray, "6"]
    measured_covariance: Float[np.ndarray, "6 6"]
    common: Float[np.ndarray, "12 errors"]

    def backwards(self) -> FrameMotion:
        """The same frame in a time that runs backwards."""
        common = np.concatenate([self.common[:6], -self.common[6:]])
        return replace(
            self,
            assumed=-self.assumed,
            by_motion=-self.by_motion,
            measured=-self.measured,
            common=common,
        )
