"""Large faults of one camera, found with points on which all other cameras agree.

The points are projected into the camera and compared with its sightings. Each kind of fault is a family of modified
cameras (turned, moved, with another focal length, exchanged with another camera) or of lags of the video. The member
that explains most sightings is taken.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from psotrack.calibration import locate_camera
from psotrack.calibration.doctor.agreement import (
    MAX_SQUARED_DISTANCE,
    MIN_VIEWPOINTS,
    Agreement,
    num_viewpoints,
)
from psotrack.errors import InputError
from psotrack.geometry import NEAR_M, Camera, Rig, project_visible, reconstruct, undistort
from psotrack.tracking.matching import Sightings

#: Smallest number of points of the other cameras with which a camera is checked.
MIN_POINTS_OF_CAMERA = 30
#: Factors of the focal length and lags (frames) that are tried.
_SCALES = np.exp(np.arange(-0.7, 0.7001, 0.02))
_FINER = np.exp(np.arange(-0.02, 0.0201, 0.005))
_LAGS = np.arange(-5.0, 5.01, 0.25)
#: Side of a cell of the histogram of image shifts, pixels, and number of rounds in which sightings are paired anew.
_CELL_PX, _ROUNDS = 16.0, 6
#: Largest motion of a drone between two frames, metres; smaller than the distance between two drones.
_STEP_M = 0.3


@dataclass(frozen=True)
class DetectionViews:
    """Points of the other cameras, and a camera's sightings in the same frames.

    Attributes:
        point_m: (points, 3), points from the other cameras alone, metres.
        velocity_m: (points, 3), velocities, metres per frame; NaN if a neighbouring frame does not show the drone.
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
        kind: clock, focal length, exchanged, turned or moved; sound for no fault.
        gain: share of the points that the camera's sightings explain (`explained_share`).
        camera: the camera with the fault corrected; the camera as it was read if the fault is not one of the camera.
        amount: frames by which the video is late, factor of the focal length, or index of the exchanged camera.
    """

    kind: str
    gain: float
    camera: Camera
    amount: float = 0.0


def collect_views(rig: Rig, found: Agreement, sightings: Sightings, index: int) -> DetectionViews:
    """Points on which the other cameras agree without the camera at `index`, and the sightings of this camera."""
    others = np.arange(len(rig)) != index
    kept = num_viewpoints(rig.cameras, found.used & others) >= MIN_VIEWPOINTS
    centre_px, used, frame = found.centre_px[kept], found.used[kept] & others, found.frame[kept]
    noise_px = np.nan_to_num(found.noise_px[kept], nan=1.0)
    lines = reconstruct(rig.cameras, centre_px, used.astype(float), noise_px=noise_px, robust=False)
    there = np.isfinite(lines.position_m).all(axis=-1)
    point_m, frame = lines.position_m[there], frame[there]
    return DetectionViews(
        point_m,
        velocities(frame, point_m),
        sightings.centre_px[frame, index],
        sightings.noise_px[frame, index],
    )


def velocities(frame: Int[np.ndarray, "points"], point_m: Float[np.ndarray, "points 3"]) -> np.ndarray:
    """(points, 3), velocities from the nearest points of both neighbouring frames, metres per frame; NaN if missing."""
    steps = []
    for direction in (-1, 1):
        step = np.full(point_m.shape, np.nan)
        for number in np.unique(frame):
            here, there = np.flatnonzero(frame == number), np.flatnonzero(frame == number + direction)
            if len(there):
                off = point_m[there] - point_m[here][:, None]
                distance = np.linalg.norm(off, axis=-1)
                nearest = distance.argmin(axis=1)
                rows = np.arange(len(here))
                near = distance[rows, nearest] < _STEP_M
                step[here[near]] = off[rows, nearest][near]
        steps.append(direction * step)
    return (steps[0] + steps[1]) / 2


def explained_share(camera: Camera, views: DetectionViews, lag_frames: float = 0.0) -> float:
    """Share of explained points: each counts 1 - distance² / `MAX_SQUARED_DISTANCE`, and 0 if it is farther."""
    return float(np.sum(_fits(camera, views, lag_frames)[0])) / max(len(views.point_m), 1)


def explain_camera(rig: Rig, views: DetectionViews, index: int) -> list[CameraFault]:
    """The camera as it was read, and the best fault of each kind, the simplest kinds first."""
    camera = rig.cameras[index]
    sound = CameraFault("sound", explained_share(camera, views), camera)
    lag = max(_LAGS.tolist(), key=lambda lag: explained_share(camera, views, lag))
    scale = max(_SCALES.tolist(), key=lambda scale: explained_share(scale_focal_length(camera, scale), views))
    scale = max(
        (scale * _FINER).tolist(), key=lambda scale: explained_share(scale_focal_length(camera, scale), views)
    )
    lenses = scale_focal_length(camera, scale)
    turned = _turned(camera, views)
    moved = _moved(turned, views)
    faults = [
        CameraFault("clock", explained_share(camera, views, lag), camera, lag),
        CameraFault("focal length", explained_share(lenses, views), lenses, scale),
    ]
    for other in range(len(rig)):
        if other != index:
            there = rig.cameras[other]
            faults.append(CameraFault("exchanged", explained_share(there, views), there, float(other)))
    faults.append(CameraFault("turned", explained_share(turned, views), turned))
    faults.append(CameraFault("moved", explained_share(moved, views), moved))
    return [sound, *faults]


def scale_focal_length(camera: Camera, scale: float) -> Camera:
    """The camera with its focal lengths multiplied by `scale`."""
    K = camera.K.copy()
    K[..., :2, :2] *= scale
    return replace(camera, K=K)


def pose_difference(before: Camera, after: Camera) -> tuple[float, float]:
    """The angle by which a camera is turned, degrees, and the distance by which it is moved, metres."""
    R = after.T_cam_world[:3, :3] @ before.T_cam_world[:3, :3].T
    turn_deg = float(np.rad2deg(Rotation.from_matrix(R).magnitude()))
    return turn_deg, float(np.linalg.norm(after.centre_world - before.centre_world))


def _fits(
    camera: Camera, views: DetectionViews, lag_frames: float = 0.0, widen: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """How well each point is explained, from 0 to 1, and the index of the sighting that explains it."""
    moved_m = lag_frames * np.nan_to_num(views.velocity_m)
    pixels, depth = project_visible(camera, views.point_m - moved_m)
    off = np.sum((views.box_px - pixels[:, None]) ** 2, axis=-1) / (widen * views.noise_px) ** 2
    off = np.where(np.isfinite(off) & (depth > NEAR_M)[:, None], off, np.inf)
    best = off.argmin(axis=1)
    return np.maximum(0.0, 1 - off[np.arange(len(off)), best] / MAX_SQUARED_DISTANCE), best


def _turned(camera: Camera, views: DetectionViews) -> Camera:
    """The camera turned about its centre: first by the most frequent shift of the image, then until rays agree."""
    starts = [camera, _shifted(camera, views)]
    return max((_aligned(start, views) for start in starts), key=lambda each: explained_share(each, views))


def _shifted(camera: Camera, views: DetectionViews) -> Camera:
    """The camera turned so that most points fall on sightings, to the precision of a cell of the histogram."""
    pixels, depth = project_visible(camera, views.point_m)
    off = (views.box_px - pixels[:, None])[depth > NEAR_M].reshape(-1, 2)
    reach = float(camera.image_size_wh.max()) / 2
    off = off[(np.abs(off) < reach).all(axis=-1)]
    if not len(off):
        return camera
    edges = np.arange(-reach, reach + _CELL_PX, _CELL_PX)
    count, _, _ = np.histogram2d(off[:, 0], off[:, 1], bins=[edges, edges])
    x, y = np.unravel_index(count.argmax(), count.shape)
    shift = np.array([edges[x], edges[y]]) + _CELL_PX / 2
    angle_y, angle_x = np.arctan(shift / np.diag(camera.K)[:2])
    # A camera whose image is to the right of where it should be looks too far left.
    return _turned_by(camera, Rotation.from_rotvec([-angle_x, angle_y, 0.0]).as_matrix())


def _turned_by(camera: Camera, R: Float[np.ndarray, "3 3"]) -> Camera:
    T = camera.T_cam_world.copy()
    T[:3] = R @ T[:3]
    return replace(camera, T_cam_world=T)


def _aligned(camera: Camera, views: DetectionViews) -> Camera:
    for round_ in range(_ROUNDS):
        # The first rounds accept larger distances, because a cell is wider than the noise.
        fit, best = _fits(camera, views, widen=3.0 if round_ < _ROUNDS // 2 else 1.0)
        pairs = np.flatnonzero(fit > 0)
        if len(pairs) < MIN_POINTS_OF_CAMERA:
            return camera
        rays = _rays(undistort(camera, views.box_px[pairs, best[pairs]]))
        # Pixels that the lens's model cannot undistort have no ray.
        pairs, seen = pairs[np.isfinite(rays[:, 0])], rays[np.isfinite(rays[:, 0])]
        if len(pairs) < MIN_POINTS_OF_CAMERA:
            return camera
        T = camera.T_cam_world
        expected = views.point_m[pairs] @ T[:3, :3].T + T[:3, 3]
        expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
        U, _, Vt = np.linalg.svd((seen * fit[pairs, None]).T @ expected)
        camera = _turned_by(camera, U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)
    return camera


def _moved(camera: Camera, views: DetectionViews) -> Camera:
    """The camera at the position that its sightings give."""
    start = camera
    # A camera that was moved far has few sightings near the projections at first, and more in every round.
    for widen in (3.0, 1.0, 1.0):
        fit, best = _fits(camera, views, widen=widen)
        pairs = np.flatnonzero(fit > 0)
        if len(pairs) < MIN_POINTS_OF_CAMERA:
            return start
        seen_px = views.box_px[pairs, best[pairs]]
        noise_px = float(np.median(views.noise_px[pairs, best[pairs]]))
        try:
            located = locate_camera(
                views.point_m[pairs],
                seen_px,
                np.asarray(camera.K),
                np.asarray(camera.dist),
                noise_px,
                fisheye=bool(camera.fisheye),
            )
        except InputError:
            return start
        camera = replace(camera, T_cam_world=located.T_cam_world)
    return max((start, camera), key=lambda each: explained_share(each, views))


def _rays(x: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    rays = np.column_stack([x, np.ones(len(x))])
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)
