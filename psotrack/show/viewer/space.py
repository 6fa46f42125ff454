"""What is in the world: cameras, markers, drones with their trails and ellipsoids, and the reference."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.inside_out import MarkerMap, read_marker_table
from psotrack.show.flights import FlightTracks, TrackedFlight, colour_rgb, ellipsoids_90, intervals, statuses
from psotrack.show.viewer.camera_images import CameraKey
from psotrack.show.viewer.entity_log import (
    EntityLog,
    Instants,
    camera_path,
    drone_path,
    instants,
    part,
    shown_rgb,
)
from psotrack.trajectories import Status

MARKER_RGB = (255, 90, 200)
_GREY_RGB = (110, 110, 110)
_TRUTH_RGBA = (128, 128, 128, 200)
#: Opacity of the whole path of a drone, 0 to 255: the trail is in front of it.
_PATH_OPACITY = 110
#: Distance of the images from the cameras, metres.
_IMAGE_DISTANCE_M = 1.0


def log_world(log: EntityLog, flight: TrackedFlight) -> None:
    """Log what does not move: cameras, bounds and markers."""
    log.static("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    recording = flight.recording
    if recording is None:
        return
    for index, name in enumerate(recording.rig.names):
        camera = recording.rig.cameras[index]
        T_world_cam = np.linalg.inv(np.asarray(camera.T_cam_world, np.float64))
        path = camera_path(CameraKey(name))
        log.static(path, rr.Transform3D(translation=T_world_cam[:3, 3], mat3x3=T_world_cam[:3, :3]))
        log.static(path, pinhole(np.asarray(camera.K), np.asarray(camera.image_size_wh), _IMAGE_DISTANCE_M))
    if recording.bounds_m is not None:
        low, high = np.array(recording.bounds_m).reshape(3, 2).T
        bounds = rr.Boxes3D(centers=[(low + high) / 2], half_sizes=[(high - low) / 2], colors=[_GREY_RGB])
        log.static("world/bounds", bounds)
    table = None if recording.marker_corners is None else read_marker_table(recording.marker_corners)
    if isinstance(table, MarkerMap):
        outlines_m = table.all_corners_m[:, [0, 1, 2, 3, 0]]
        log.static("world/markers", rr.LineStrips3D(outlines_m, colors=[MARKER_RGB], radii=[0.004]))


def log_flight(log: EntityLog, flight: TrackedFlight) -> None:
    """Log the drones of all tracks with their trails and paths, and the reference."""
    for tracks in flight.tracks:
        for drone, name in enumerate(tracks.trajectories.drones):
            path = drone_path("world/drones", tracks, name)
            log_drones(log, path, tracks, [drone])
            _log_path(log, tracks, drone, path)
    truth = flight.truth
    for drone, name in enumerate(() if truth is None else truth.drones):
        assert truth is not None
        position_m, path = truth.position_m[:, drone], f"world/truth/{part(name)}"
        known = np.isfinite(position_m).all(axis=-1)
        log.static(f"{path}/point", rr.Points3D.from_fields(colors=[_TRUTH_RGBA], radii=[0.03]))
        at = Instants(truth.frame, truth.time_s)
        log.rows(f"{path}/point", at, rr.Points3D, known.astype(int), positions=position_m[known])
        log.static(f"{path}/path", rr.LineStrips3D([position_m[known]], colors=[_TRUTH_RGBA], radii=[0.004]))


def log_drones(log: EntityLog, path: str, tracks: FlightTracks, drones: Sequence[int]) -> None:
    """Log the bodies and ellipsoids of some drones as one entity.

    Args:
        log: receives the values.
        path: path of the entity.
        tracks: the tracks.
        drones: indices of the drones.
    """
    flown, at = tracks.trajectories, instants(tracks)
    position_m, status = flown.position_m[:, drones], statuses(flown)[:, drones]
    rgb, half_m = shown_rgb(tracks)[:, drones], np.broadcast_to(tracks.size_m[drones] / 2, position_m.shape)
    known = np.isfinite(position_m).all(axis=-1)
    names = [tracks.names[drones[each]] for each in np.nonzero(known)[1].tolist()]
    labels = [
        name if each == Status.TRACKED else f"{name} {Status(each).label}"
        for name, each in zip(names, status[known].tolist(), strict=True)
    ]
    shapes = {"centers": position_m[known], "half_sizes": half_m[known], "colors": rgb[known]}
    log.rows(f"{path}/body", at, rr.Boxes3D, known.sum(axis=1), **shapes, labels=labels)
    if flown.covariance_m2 is None:
        return
    ellipsoids = ellipsoids_90(flown.covariance_m2[:, drones])
    # The ellipsoid of a lost drone grows to the size of the room.
    shown = known & np.isfinite(ellipsoids.half_axes_m).all(axis=-1) & (status != Status.LOST)
    turned = Rotation.from_matrix(ellipsoids.rotation[shown]).as_quat()
    # A large ellipsoid must not hide what is behind.
    fill = rr.components.FillMode.TransparentFillMajorWireframe
    log.static(f"{path}/ellipsoid", rr.Ellipsoids3D.from_fields(fill_mode=fill))
    shapes = {"centers": position_m[shown], "half_sizes": ellipsoids.half_axes_m[shown], "colors": rgb[shown]}
    log.rows(f"{path}/ellipsoid", at, rr.Ellipsoids3D, shown.sum(axis=1), **shapes, quaternions=turned)


def pinhole(K: Float[np.ndarray, "3 3"], image_size_wh: np.ndarray, distance_m: float) -> rr.Pinhole:
    """A lens without distortion.

    Args:
        K: (3, 3), intrinsics, pixels.
        image_size_wh: (2,), width and height, pixels.
        distance_m: distance of the image from the camera in the view of space, metres.
    """
    shifted = np.array(K, np.float64)
    # Pixel centres are at whole numbers in K, and half a pixel further in Rerun.
    shifted[:2, 2] += 0.5
    width, height = (int(side) for side in image_size_wh)
    return rr.Pinhole(
        image_from_camera=shifted,
        width=width,
        height=height,
        image_plane_distance=distance_m,
        color=_GREY_RGB,
    )


def _log_path(log: EntityLog, tracks: FlightTracks, drone: int, path: str) -> None:
    """Log the trail of a drone, from each row before to this one, and the whole path where it is not lost."""
    position_m, rgb = tracks.trajectories.position_m[:, drone], shown_rgb(tracks)[:, drone]
    known = np.isfinite(position_m).all(axis=-1)
    follows = known & np.roll(known, 1) & (np.arange(len(known)) > 0)
    strips_m = np.stack([np.roll(position_m, 1, axis=0), position_m], axis=1)[follows]
    lines = {"strips": strips_m, "colors": rgb[follows]}
    log.rows(f"{path}/trail", instants(tracks), rr.LineStrips3D, follows.astype(int), **lines)
    flown = intervals(known & (statuses(tracks.trajectories)[:, drone] != Status.LOST))
    own = (*colour_rgb(tracks.colours[drone]), _PATH_OPACITY)
    whole_m = [position_m[start:stop] for start, stop in flown]
    log.static(f"{path}/path", rr.LineStrips3D(whole_m, colors=[own], radii=[0.006]))
