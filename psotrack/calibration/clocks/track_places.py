"""Where each camera shows each tracked drone: the sightings that belong to the tracks."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from psotrack.foreground.silhouettes import Silhouettes
from psotrack.geometry import NEAR_M, Camera, project
from psotrack.recordings import Timeline
from psotrack.tracking.matching import NOISE_PX, NOISE_SHARE, Sightings
from psotrack.trajectories.resampling import interpolated

#: Largest error of a clock before the estimate, in intervals between instants: sightings are searched this far along a
#: drone's motion.
MAX_OFFSET_FRAMES = 5.0
#: A sighting whose noise is larger than this multiple of the usual noise is cut by the image's border.
_CUT = 2.0
#: Sightings are interpolated over at most this many intervals of the camera.
_MAX_GAP = 1.6
#: Cells around a sighting's box in which foreground counts: the box has no faint edges.
_MARGIN_CELLS = 3.0
#: Number of instants of silhouettes that are read together.
_CHUNK_FRAMES = 25


def places_of_tracks(
    cameras: Camera,
    sightings: Sightings,
    timeline: Timeline,
    position_m: Float[np.ndarray, "instants drones 3"],
    velocity_m_s: Float[np.ndarray, "instants drones 3"],
    silhouettes: Silhouettes | None = None,
) -> Float[np.ndarray, "instants drones cameras 2"]:
    """The place of each drone in each camera, interpolated to the instants on the camera's given clock.

    The place is the middle of a sighting, or of the foreground in the sighting's box. A sighting counts if it is the
    one nearest to the drone's projection, no farther than half its box and the drone's motion in `MAX_OFFSET_FRAMES`
    instants, and no other drone is in its box.

    Args:
        cameras: cameras with one leading axis.
        sightings: sightings at the instants.
        timeline: the instants, and times of the cameras' frames.
        position_m, velocity_m_s: (instants, drones, 3), the tracks, metres and m/s; NaN where a drone is not tracked.
        silhouettes: silhouettes at the instants, from which the sightings were made; None where a detector made the
            sightings.

    Returns:
        (instants, drones, cameras, 2), pixels; NaN where a camera does not show the drone.
    """
    box = np.full((*position_m.shape[:2], len(timeline.cameras)), -1)
    for camera in range(box.shape[2]):
        shown_m = position_m + velocity_m_s * timeline.offset_s[:, camera, None, None]
        reach_m = velocity_m_s * MAX_OFFSET_FRAMES / timeline.rate_hz
        # (instants, drones, 2), and the drone's motion in the image.
        one = cameras[np.array([camera])]
        (middle_px, depth), (moved_px, _) = (
            project(one, np.nan_to_num(at_m)[:, :, None]) for at_m in (shown_m, shown_m + reach_m)
        )
        known = np.isfinite(shown_m).all(axis=-1) & (depth[..., 0] > NEAR_M)
        middle_px = np.where(known[..., None], middle_px[:, :, 0], np.nan)
        flow_px = np.linalg.norm(moved_px[:, :, 0] - middle_px, axis=-1)
        box[:, :, camera] = _own_sightings(sightings, camera, middle_px, flow_px)
    box = np.where((timeline.frame >= 0)[:, None], box, -1)
    places = (
        _middles(sightings.centre_px, box)
        if silhouettes is None
        else _foreground_middles(silhouettes, sightings, box)
    )
    for camera in range(box.shape[2]):
        _interpolate(places[:, :, camera], timeline, camera)
    return places


def _own_sightings(
    sightings: Sightings,
    camera: int,
    middle_px: Float[np.ndarray, "instants drones 2"],
    flow_px: Float[np.ndarray, "instants drones"],
) -> Int[np.ndarray, "instants drones"]:
    """Indices of one camera's sightings that are each drone's alone; -1 where there is none."""
    centre_px, size_px, noise_px = (
        values[:, None, camera] for values in (sightings.centre_px, sightings.size_px, sightings.noise_px)
    )
    off_px = middle_px[:, :, None] - centre_px
    distance_px = np.linalg.norm(off_px, axis=-1)
    side_px = np.sqrt(size_px.prod(axis=-1))
    whole = noise_px < _CUT * (NOISE_PX + NOISE_SHARE * side_px)
    reach_px = size_px.max(axis=-1) / 2 + flow_px[..., None]
    held = (np.abs(off_px) < size_px / 2).all(axis=-1)
    fits = whole & (distance_px <= reach_px) & (held.sum(axis=1, keepdims=True) <= 1)
    distance_px = np.where(fits, distance_px, np.inf)
    box = distance_px.argmin(axis=-1)
    nearest_px = np.take_along_axis(distance_px, box[..., None], axis=-1)[..., 0]
    # A box is the sighting of the drone that is nearest to it.
    of_box_px = np.take_along_axis(distance_px.min(axis=1), box, axis=-1)
    return np.where(np.isfinite(nearest_px) & (nearest_px <= of_box_px), box, -1)


def _middles(
    centre_px: Float[np.ndarray, "instants cameras boxes 2"], box: Int[np.ndarray, "instants drones cameras"]
) -> Float[np.ndarray, "instants drones cameras 2"]:
    """The boxes' values; NaN where there is no box."""
    instant, _, camera = np.indices(box.shape)
    return np.where((box >= 0)[..., None], centre_px[instant, camera, box], np.nan)


def _foreground_middles(
    silhouettes: Silhouettes, sightings: Sightings, box: Int[np.ndarray, "instants drones cameras"]
) -> Float[np.ndarray, "instants drones cameras 2"]:
    """Middles of the foreground in the boxes, which move evenly where edges of boxes move in steps."""
    reduction = silhouettes.reduction
    centre, half = (
        _middles(values, box) / reduction for values in (sightings.centre_px + 0.5, sightings.size_px / 2)
    )
    low, high = centre - half - _MARGIN_CELLS, centre + half + _MARGIN_CELLS
    places = np.full(centre.shape, np.nan)
    height, width = silhouettes.shape
    for first in range(0, silhouettes.num_frames, _CHUNK_FRAMES):
        chunk = silhouettes.read(first, min(first + _CHUNK_FRAMES, silhouettes.num_frames))
        for at, drone, camera in np.argwhere(box[first : first + len(chunk)] >= 0).tolist():
            where = (first + at, drone, camera)
            (x0, y0), (x1, y1) = (np.rint(ends[where]).astype(int) for ends in (low, high))
            x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, width), min(y1, height)
            shown = chunk[at, camera, y0:y1, x0:x1].astype(float)
            columns, rows, total = shown.sum(axis=0), shown.sum(axis=1), shown.sum()
            if total > 0:
                x = x0 + 0.5 + columns @ np.arange(len(columns)) / total
                y = y0 + 0.5 + rows @ np.arange(len(rows)) / total
                places[where] = reduction * x - 0.5, reduction * y - 0.5
    return places


def _interpolate(places_px: Float[np.ndarray, "instants drones 2"], timeline: Timeline, camera: int) -> None:
    """Interpolate one camera's places, which are at the times of its frames, to the instants, in place."""
    offset_s, frame = timeline.offset_s[:, camera], timeline.frame[:, camera]
    if not offset_s.any():
        return
    # The first instant of each frame that is shown.
    first = np.flatnonzero((frame >= 0) & (np.diff(frame, prepend=-1) != 0))
    frame_s = (timeline.time_s + offset_s)[first]
    gap_s = _MAX_GAP * float(np.median(np.diff(frame_s))) if len(first) > 1 else 0.0
    places_px[:] = interpolated(frame_s, places_px[first], gap_s)(timeline.time_s)
