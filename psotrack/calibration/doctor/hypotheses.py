"""Hypotheses of what is wrong with a rig: one camera turned, moved, late or with another focal length, or all lenses.

Each hypothesis has a few parameters θ, the correction of the rig as it was read. Their prior distribution is normal
with mean 0: faults of calibrated rigs are small, and a hypothesis with many parameters must explain more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.geometry import Rig, cross_matrices, project_visible, project_with_jacobian, to_camera

#: Standard deviations of the parameters: turns, degrees; ways, as a share of the distance of the bodies; logarithm of
#: the focal length; lag of a video, frames.
TURN_DEG, WAY, ZOOM, LAG_FRAMES = 0.7, 0.02, 0.03, 1.5
#: Logarithms of the prior probabilities of rarer kinds, relative to the others: who pushes a camera turns it, and the
#: perspective of extended bodies and boxes that merge look a little like a fault of all lenses.
LOG_PRIOR = {"moved": -0.5, "turned and moved": -2.0, "focal lengths": -7.0}
#: Parameters of a camera: a turn about its axes (3), a way of its centre in the world (3), focal length, lag.
PER_CAMERA = 8
_PARTS = {
    "turned": (0, 1, 2),
    "moved": (3, 4, 5),
    "turned and moved": (0, 1, 2, 3, 4, 5),
    "focal length": (6,),
    "clock": (7,),
}


@dataclass(frozen=True)
class Hypothesis:
    """A possible fault.

    Attributes:
        kind: turned, moved, turned and moved, focal length or clock; focal lengths for all lenses together.
        camera: index of the camera; -1 for all cameras.
        columns: indices of the parameters among those of the whole rig.
    """

    kind: str
    camera: int
    columns: tuple[int, ...]


def list_hypotheses(num_cameras: int, cameras: Sequence[int]) -> list[Hypothesis]:
    """All hypotheses about some cameras of a rig, and the one about all lenses."""
    found = [
        Hypothesis(kind, camera, tuple(PER_CAMERA * camera + part for part in parts))
        for camera in cameras
        for kind, parts in _PARTS.items()
    ]
    return [*found, Hypothesis("focal lengths", -1, (PER_CAMERA * num_cameras,))]


def prior_std(num_cameras: int, distance_m: Float[np.ndarray, "cameras"]) -> Float[np.ndarray, "parameters"]:
    """Standard deviations of all parameters of a rig, given how far the bodies are from each camera, metres."""
    turn, way = np.full((num_cameras, 3), np.deg2rad(TURN_DEG)), np.tile(WAY * distance_m[:, None], 3)
    rest = np.tile([ZOOM, LAG_FRAMES], (num_cameras, 1))
    return np.append(np.hstack([turn, way, rest]).ravel(), ZOOM)


def parameters_of(values: Float[np.ndarray, "parameters"], camera: int) -> Float[np.ndarray, "8"]:
    """The values of one camera: turn (3), way (3), logarithm of the focal length, lag."""
    return values[PER_CAMERA * camera : PER_CAMERA * (camera + 1)]


@dataclass(frozen=True)
class Corrected:
    """A rig after a correction.

    Attributes:
        rig: the cameras.
        lag_frames: (cameras,), frames by which each video shows the scene late.
    """

    rig: Rig
    lag_frames: Float[np.ndarray, "cameras"]

    def by(self, step: Float[np.ndarray, "parameters"]) -> Corrected:
        """The rig after a further correction in all parameters."""
        cameras = self.rig.cameras
        T, K = cameras.T_cam_world.copy(), cameras.K.copy()
        each = step[:-1].reshape(-1, PER_CAMERA)
        for index, (of, centre) in enumerate(zip(each, cameras.centre_world, strict=True)):
            R = Rotation.from_rotvec(of[:3]).as_matrix() @ T[index, :3, :3]
            T[index, :3, :3], T[index, :3, 3] = R, -R @ (centre + of[3:6])
            K[index, :2, :2] *= np.exp(of[6] + step[-1])
        rig = Rig(self.rig.names, replace(cameras, T_cam_world=T, K=K))
        return Corrected(rig, self.lag_frames + each[:, 7])


@dataclass(frozen=True)
class Slopes:
    """Sightings minus projections, and derivatives of the projections.

    Attributes:
        off_px: (points, cameras, 2), sightings minus projections, pixels; NaN for no sighting.
        by_point: (points, cameras, 2, 3), derivatives by the points, pixels per metre.
        by_parameter: (points, cameras, 2, parameters), derivatives by the correction.
    """

    off_px: Float[np.ndarray, "points cameras 2"]
    by_point: Float[np.ndarray, "points cameras 2 3"]
    by_parameter: Float[np.ndarray, "points cameras 2 parameters"]


def linearise(
    corrected: Corrected,
    point_m: Float[np.ndarray, "points 3"],
    velocity_m: Float[np.ndarray, "points 3"],
    centre_px: Float[np.ndarray, "points cameras 2"],
    offset_frames: Float[np.ndarray, "points cameras"],
) -> Slopes:
    """Compare sightings with projections, and differentiate by points and corrections.

    Args:
        corrected: the rig.
        point_m: (points, 3), positions at whole frames, metres.
        velocity_m: (points, 3), metres per frame.
        centre_px: (points, cameras, 2), sightings, pixels; NaN for no sighting.
        offset_frames: (points, cameras), time of the camera's frame minus time of the point's frame, frames.
    """
    cameras, num_cameras = corrected.rig.cameras, len(corrected.rig)
    # A video that lags shows where a body was before.
    ahead_frames = offset_frames - corrected.lag_frames
    there_m = point_m[:, None] + ahead_frames[..., None] * velocity_m[:, None]
    pixels, depth, by_world = project_with_jacobian(cameras, there_m)
    by_camera_frame = by_world @ cameras.T_cam_world[:, :3, :3].swapaxes(-1, -2)
    slopes = np.zeros((*pixels.shape, PER_CAMERA * num_cameras + 1))
    turn = -by_camera_frame @ cross_matrices(np.asarray(to_camera(cameras, there_m)))
    zoom = pixels - cameras.K[:, :2, 2]
    lag = -(by_world @ velocity_m[:, None, :, None])[..., 0]
    for index in range(num_cameras):
        first = PER_CAMERA * index
        slopes[:, index, :, first : first + 3] = turn[:, index]
        slopes[:, index, :, first + 3 : first + 6] = -by_world[:, index]
        slopes[:, index, :, first + 6] = zoom[:, index]
        slopes[:, index, :, first + 7] = lag[:, index]
    slopes[..., -1] = zoom
    visible_px, _ = project_visible(cameras, there_m)
    off_px = np.where((depth > 0)[..., None], centre_px - visible_px, np.nan)
    # Beyond the fold of a lens's model there is no projection: such a sighting does not count.
    return Slopes(off_px, np.nan_to_num(by_world), np.nan_to_num(slopes))
