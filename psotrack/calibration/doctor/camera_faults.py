"""Large faults of one camera, found with points on which all other cameras agree.

The points are projected into the camera and compared with its sightings. Each kind of fault is a family of modified
cameras (at another place, with another focal length) or of lags of the video. The member that explains most sightings
is taken.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from psotrack.calibration import locate_camera
from psotrack.errors import InputError
from psotrack.geometry import NEAR_M, Camera, project_visible, undistort

#: Smallest number of points of the other cameras with which a camera is checked.
MIN_POINTS_OF_CAMERA = 30
#: Largest squared distance of a sighting from the projection of its point, squared standard deviations: 1 in 1000 right
#: sightings is farther (χ² distribution, two degrees of freedom).
_MAX_SQUARED_DISTANCE = 13.8
#: Factors of the focal length and lags (frames) that are tried.
_SCALES = np.exp(np.arange(-0.7, 0.7001, 0.01))
_LAGS = np.arange(-5.0, 5.01, 0.25)
#: Side of a cell of the histogram of image shifts, pixels.
_CELL_PX = 16.0
#: Factors of the noise with which sightings are paired anew: a cell is wider than the noise, and a camera that was
#: moved far has few sightings near the projections at first.
_WIDE_FIRST = (3.0, 3.0, 1.0, 1.0)


@dataclass(frozen=True)
class SuspectViews:
    """Points of the other cameras, and a camera's sightings in the same frames.

    Attributes:
        point_m: (points, 3), points from the other cameras alone, metres.
        velocity_m: (points, 3), metres per frame.
        box_px: (points, boxes, 2), the camera's sightings in each point's frame, pixels; NaN for no sighting.
        noise_px: (points, boxes), standard deviations of the sightings, pixels.
    """

    point_m: Float[np.ndarray, "points 3"]
    velocity_m: Float[np.ndarray, "points 3"]
    box_px: Float[np.ndarray, "points boxes 2"]
    noise_px: Float[np.ndarray, "points boxes"]


@dataclass(frozen=True)
class CameraFault:
    """A possible fault of a camera.

    Attributes:
        kind: clock, focal length, turned, or turned and moved; sound for no fault.
        explained: fraction of the points that the camera's sightings explain: each counts 1 - squared distance /
            largest squared distance, and 0 if it is farther.
        camera: the camera with the fault corrected; the camera as it was read if the fault is not one of the camera.
        lag_frames: frames by which the video is late.
    """

    kind: str
    explained: float
    camera: Camera
    lag_frames: float = 0.0


def explain_camera(camera: Camera, views: SuspectViews) -> list[CameraFault]:
    """The camera as it was read, and the best fault of each kind, the simplest kinds first."""
    lag = max(_LAGS.tolist(), key=lambda lag: _explained(camera, views, lag))
    lens = max((_scaled(camera, scale) for scale in _SCALES), key=lambda each: _explained(each, views))
    moved = _placed_anew(camera, views)
    turned = _turned(camera, moved, views)
    return [
        CameraFault("sound", _explained(camera, views), camera),
        CameraFault("clock", _explained(camera, views, lag), camera, lag),
        CameraFault("focal length", _explained(lens, views), lens),
        CameraFault("turned", _explained(turned, views), turned),
        CameraFault("turned and moved", _explained(moved, views), moved),
    ]


def _scaled(camera: Camera, scale: float) -> Camera:
    """The camera with its focal lengths multiplied by `scale`."""
    K = camera.K.copy()
    K[..., :2, :2] *= scale
    return replace(camera, K=K)


def _explained(camera: Camera, views: SuspectViews, lag_frames: float = 0.0) -> float:
    return float(_fits(camera, views, lag_frames)[0].mean())


def _fits(
    camera: Camera, views: SuspectViews, lag_frames: float = 0.0, widen: float = 1.0
) -> tuple[Float[np.ndarray, "points"], Int[np.ndarray, "points"]]:
    """How well each point is explained, from 0 to 1, and the index of the sighting that explains it."""
    pixels, depth = project_visible(camera, views.point_m - lag_frames * views.velocity_m)
    squared = np.sum((views.box_px - pixels[:, None]) ** 2, axis=-1) / (widen * views.noise_px) ** 2
    squared = np.where(np.isfinite(squared) & (depth > NEAR_M)[:, None], squared, np.inf)
    best = squared.argmin(axis=1)
    return np.maximum(0.0, 1 - squared[np.arange(len(best)), best] / _MAX_SQUARED_DISTANCE), best


def _placed_anew(camera: Camera, views: SuspectViews) -> Camera:
    """The camera at the place that its sightings give; first it is turned by the most frequent shift of the image."""
    return max(
        (_located(start, views) for start in (camera, _shifted(camera, views))),
        key=lambda each: _explained(each, views),
    )


def _turned(camera: Camera, moved: Camera, views: SuspectViews) -> Camera:
    """The camera turned until its rays agree with the points that the moved camera explains."""
    fit, best = _fits(moved, views)
    paired = np.flatnonzero(fit > 0)
    rays = undistort(camera, views.box_px[paired, best[paired]])
    kept = np.isfinite(rays).all(axis=-1)
    if kept.sum() < MIN_POINTS_OF_CAMERA:
        return camera
    rays, centre_m = np.column_stack([rays, np.ones(len(rays))])[kept], camera.centre_world
    ahead_m = views.point_m[paired][kept] - centre_m
    rays, ahead = (each / np.linalg.norm(each, axis=-1, keepdims=True) for each in (rays, ahead_m))
    R = Rotation.align_vectors(rays, ahead, weights=fit[paired][kept])[0].as_matrix()
    T = camera.T_cam_world.copy()
    T[:3, :3], T[:3, 3] = R, -R @ centre_m
    return replace(camera, T_cam_world=T)


def _shifted(camera: Camera, views: SuspectViews) -> Camera:
    """The camera turned so that most points fall on sightings, to the precision of a cell of the histogram."""
    pixels, depth = project_visible(camera, views.point_m)
    shift_px = (views.box_px - pixels[:, None])[depth > NEAR_M].reshape(-1, 2)
    reach = float(camera.image_size_wh.max()) / 2
    edges = np.arange(-reach, reach + _CELL_PX, _CELL_PX)
    shift_px = shift_px[np.isfinite(shift_px).all(axis=-1)]
    count, _, _ = np.histogram2d(shift_px[:, 0], shift_px[:, 1], bins=[edges, edges])
    most = np.array(np.unravel_index(count.argmax(), count.shape)) * _CELL_PX - reach + _CELL_PX / 2
    angle_y, angle_x = np.arctan(most / np.diag(camera.K)[:2])
    T = camera.T_cam_world.copy()
    # A camera whose image is to the right of where it should be looks too far left.
    T[:3] = Rotation.from_rotvec([-angle_x, angle_y, 0.0]).as_matrix() @ T[:3]
    return replace(camera, T_cam_world=T)


def _located(camera: Camera, views: SuspectViews) -> Camera:
    """The camera at the place that its sightings give."""
    K, dist, fisheye = np.asarray(camera.K), np.asarray(camera.dist), bool(camera.fisheye)
    for widen in _WIDE_FIRST:
        fit, best = _fits(camera, views, widen=widen)
        paired = np.flatnonzero(fit > 0)
        if len(paired) < MIN_POINTS_OF_CAMERA:
            break
        seen_px, noise_px = (each[paired, best[paired]] for each in (views.box_px, views.noise_px))
        noise = float(np.median(noise_px))
        try:
            located = locate_camera(views.point_m[paired], seen_px, K, dist, noise, fisheye=fisheye)
        except InputError:
            break
        camera = replace(camera, T_cam_world=located.T_cam_world)
    return camera
