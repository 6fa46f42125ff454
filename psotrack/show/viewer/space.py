"""What is in the world: cameras, markers, drones with their trails and ellipsoids, and the reference."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import rerun as rr
from jaxtyping import Float

from psotrack.inside_out import MarkerMap, read_marker_table
from psotrack.show.flights import (
    FlightTracks,
    TrackedFlight,
    ellipsoids_90,
    status_colours,
    status_rgb,
    statuses,
)
from psotrack.show.viewer.camera_images import CameraKey
from psotrack.show.viewer.entity_log import EntityLog, camera_path, drone_label, drone_path, part, shown_rgb
from psotrack.trajectories import Status, Trajectories

MARKER_RGB = (255, 90, 200)
_GREY_RGB = (110, 110, 110)
_TRUTH_RGBA = (255, 255, 255, 130)
#: Opacity of the whole path of a drone, 0 to 255: the trail is in front of it.
_PATH_OPACITY = 110
#: How ellipsoids are drawn: a large one must not hide what is behind.
ELLIPSOID_FILL = rr.components.FillMode.TransparentFillMajorWireframe
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
        log.static(
            "world/bounds",
            rr.Boxes3D(centers=[(low + high) / 2], half_sizes=[(high - low) / 2], colors=[_GREY_RGB]),
        )
    if recording.marker_corners is not None:
        _log_marker_map(log, recording.marker_corners)


def log_drones(log: EntityLog, flight: TrackedFlight) -> None:
    """Log the drones of all tracks, and the reference."""
    for number, tracks in enumerate(flight.tracks):
        for drone, colour in enumerate(flight.colours(number)):
            _log_drone(log, flight, tracks, drone, shown_rgb(colour))
    if flight.truth is not None:
        for drone, name in enumerate(flight.truth.drones):
            _log_truth(log, flight.truth, drone, name)


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


def quaternions_xyzw(rotation: Float[np.ndarray, "rows 3 3"]) -> Float[np.ndarray, "rows 4"]:
    """Unit quaternions of rotation matrices, in the order of Rerun."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat() if len(rotation) else np.zeros((0, 4))


def status_label(label: str, status: int) -> str:
    """Name of a drone, with its status where it is not tracked."""
    return label if status == Status.TRACKED else f"{label} {Status(status).label}"


def _log_marker_map(log: EntityLog, path: Path) -> None:
    table = read_marker_table(path)
    if isinstance(table, MarkerMap):
        outlines_m = table.all_corners_m[:, [0, 1, 2, 3, 0]]
        log.static("world/markers", rr.LineStrips3D(outlines_m, colors=[MARKER_RGB], radii=[0.004]))


def _log_drone(
    log: EntityLog, flight: TrackedFlight, tracks: FlightTracks, drone: int, rgb: tuple[int, int, int]
) -> None:
    trajectories, name = tracks.trajectories, tracks.trajectories.drones[drone]
    path = drone_path("world/drones", flight, tracks, name)
    position_m, status = trajectories.position_m[:, drone], statuses(trajectories)[:, drone]
    known = np.isfinite(position_m).all(axis=-1)
    colours = status_colours(status, rgb)
    label = drone_label(flight, tracks, name)
    half_m = tracks.size_m[drone] / 2
    at = (trajectories.frame, trajectories.time_s)
    log.rows_where(
        f"{path}/body",
        *at,
        known,
        lambda rows: rr.Boxes3D.columns(
            centers=position_m[rows],
            half_sizes=np.broadcast_to(half_m, (len(rows), 3)),
            colors=colours[rows],
            labels=[status_label(label, int(each)) for each in status[rows]],
        ),
    )
    # From the row before to this one; nothing over a gap.
    before_m = np.roll(position_m, 1, axis=0)
    log.rows_where(
        f"{path}/trail",
        *at,
        known & np.roll(known, 1) & (np.arange(len(known)) > 0),
        lambda rows: rr.LineStrips3D.columns(
            strips=np.stack([before_m[rows], position_m[rows]], axis=1), colors=colours[rows]
        ),
    )
    if trajectories.covariance_m2 is not None:
        ellipsoids = ellipsoids_90(trajectories.covariance_m2[:, drone])
        stated = np.isfinite(ellipsoids.half_axes_m).all(axis=-1)
        # The ellipsoid of a lost drone grows to the size of the room.
        log.static(f"{path}/ellipsoid", rr.Ellipsoids3D.from_fields(fill_mode=ELLIPSOID_FILL))
        log.rows_where(
            f"{path}/ellipsoid",
            *at,
            known & stated & (status != Status.LOST),
            lambda rows: rr.Ellipsoids3D.columns(
                centers=position_m[rows],
                half_sizes=ellipsoids.half_axes_m[rows],
                quaternions=quaternions_xyzw(ellipsoids.rotation[rows]),
                colors=colours[rows],
            ),
        )
    pieces = _pieces(trajectories, drone)
    log.static(
        f"{path}/path",
        rr.LineStrips3D(
            [piece_m for piece_m, _ in pieces],
            colors=[(*status_rgb(each, rgb), _PATH_OPACITY) for _, each in pieces],
            radii=[0.006],
        ),
    )


def _log_truth(log: EntityLog, truth: Trajectories, drone: int, name: str) -> None:
    position_m = truth.position_m[:, drone]
    known = np.isfinite(position_m).all(axis=-1)
    path = f"world/truth/{part(name)}"
    log.static(f"{path}/point", rr.Points3D.from_fields(colors=[_TRUTH_RGBA], radii=[0.03]))
    log.rows_where(
        f"{path}/point",
        truth.frame,
        truth.time_s,
        known,
        lambda rows: rr.Points3D.columns(positions=position_m[rows]),
    )
    log.static(f"{path}/path", rr.LineStrips3D([position_m[known]], colors=[_TRUTH_RGBA], radii=[0.004]))


def _pieces(trajectories: Trajectories, drone: int) -> list[tuple[Float[np.ndarray, "points 3"], int]]:
    """The path where a drone is not lost, in pieces of one status, each with the first point of the next piece."""
    known = np.isfinite(trajectories.position_m[:, drone]).all(axis=-1)
    status = np.where(known, statuses(trajectories)[:, drone], Status.LOST).astype(int)
    borders = np.flatnonzero(np.diff(status, prepend=-1, append=-1)).tolist()
    found = []
    for start, stop in itertools.pairwise(borders):
        if status[start] != Status.LOST:
            goes_on = stop < len(status) and status[stop] != Status.LOST
            found.append((trajectories.position_m[start : stop + goes_on, drone], int(status[start])))
    return found
