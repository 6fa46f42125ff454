"""Records of pose estimation: its settings, the pose that motion predicts, and the pose that a frame's markers give."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

from psotrack.errors import SettingsError, check_positive
from psotrack.inside_out.pose.equations import Equations


@dataclass(frozen=True)
class CornerNoise:
    """Errors of the markers in a recording.

    Attributes:
        scale: standard deviation of a corner, as a multiple of the one that its detection states.
        place_m: standard deviation of the error that all corners of a marker have in one frame, along each axis of the
            world, metres.
        shift_px: standard deviation of a shift of all corners of a frame along x and along y, pixels, such as by a
            shaken sensor. It looks like a turn of the camera, so that no residual shows it and it is not learned; in
            drawn videos it was 0.012 to 0.017 px.
    """

    scale: float = 1.0
    place_m: float = 0.0003
    shift_px: float = 0.015

    def __post_init__(self) -> None:
        for name in ("scale", "place_m", "shift_px"):
            check_positive(name, getattr(self, name))


@dataclass(frozen=True)
class PoseSettings:
    """Settings of pose estimation.

    Attributes:
        min_markers: smallest number of markers that a pose is estimated from, 1 or more.
        map_error_m: standard deviation of the position along each axis of markers whose map states none, metres; the
            same error in every frame.
        focal_error: standard deviation of the focal length, as a fraction of it; the same error in every frame.
        noise: errors of the corners; None is estimated from a recording, and is `CornerNoise()` otherwise.
    """

    min_markers: int = 4
    map_error_m: float = 0.0
    focal_error: float = 0.0
    noise: CornerNoise | None = None

    def __post_init__(self) -> None:
        if self.min_markers < 1:
            raise SettingsError("min_markers", expected="at least 1", found=f"{self.min_markers}")
        for name in ("map_error_m", "focal_error"):
            if not 0 <= getattr(self, name) < 1:
                found = f"{getattr(self, name):g}"
                raise SettingsError(name, expected="a number from 0 to below 1", found=found)


@dataclass(frozen=True)
class CameraPose:
    """Pose of a camera, with its uncertainty.

    Attributes:
        position_m: (3,), the camera's centre, world, metres.
        R_world_cam: (3, 3), camera to world; camera axes x right, y down, z ahead.
        covariance: (6, 6), as in `CameraPath`: of the position along the world's axes (m) and of a small turn about the
            camera's axes (rad).
        constant: (6, 6), the part of the covariance by errors that are the same in all frames, such as those of the map
            and of the focal length: no number of frames averages them out.
        ambiguity: probability that another pose is the right one, 0 to 1/2.
        num_markers: number of markers behind the pose.
    """

    position_m: Float[np.ndarray, "3"]
    R_world_cam: Float[np.ndarray, "3 3"]
    covariance: Float[np.ndarray, "6 6"]
    constant: Float[np.ndarray, "6 6"] = field(default_factory=lambda: np.zeros((6, 6)))
    ambiguity: float = 0.0
    num_markers: int = 0

    @property
    def varying(self) -> Float[np.ndarray, "6 6"]:
        """(6, 6), covariance without the constant part."""
        return self.covariance - self.constant


@dataclass(frozen=True, kw_only=True)
class MarkerPose(CameraPose):
    """Pose of a camera from the markers in one frame.

    Attributes:
        used: (markers,), True for the markers that the pose explains.
        reprojection_px: root mean square distance, over the used corners, between image and projection, pixels.
        equations: linear equations of the corners at this pose; None if unknown.
        log_evidence: logarithm of the probability density of all corners, integrated over poses near this pose.
    """

    used: Bool[np.ndarray, "markers"]
    reprojection_px: float
    equations: Equations | None = None
    log_evidence: float = 0.0

    @property
    def fits(self) -> Bool[np.ndarray, "markers 4"]:
        """(markers, 4), True for the corners that the pose explains."""
        return np.repeat(self.used[:, None], 4, axis=1) if self.equations is None else self.equations.fits
