"""Where the drones are in the first frames, how fast, and how large: found from the silhouettes alone.

Blobs of foreground are matched over three or more viewpoints in each of the first frames; what persists is a drone.
Its size comes from the blobs that nobody shares.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.optimize import linear_sum_assignment

from psotrack.cameras import Camera, project
from psotrack.triangulation import match_views, triangulate

#: Foreground smaller than this, in pixels of the image, is no drone.
MIN_BLOB_PX = 60
#: What has its middle nearer to the floor is a shadow: a drone that stands on its legs is higher.
FLOOR_CLEARANCE_M = 0.08
#: A cell of the reduced silhouettes belongs to a blob when so much of it (of 255) is foreground.
MIN_COVERAGE = 64


@dataclass(frozen=True)
class Blobs:
    """Connected foreground in one image.

    Attributes:
        centre_px: (blobs, 2), middles of the boxes, pixel centres at whole numbers.
        size_px: (blobs, 2), widths and heights of the boxes.
        whole: (blobs,), whether the blob is clear of the image's border.
    """

    centre_px: Float[np.ndarray, "blobs 2"]
    size_px: Float[np.ndarray, "blobs 2"]
    whole: Bool[np.ndarray, "blobs"]


@dataclass(frozen=True)
class Start:
    """Drones at frame 0.

    Attributes:
        position_m: (drones, 3).
        velocity_m_s: (drones, 3).
        size_m: (drones, 3), full lengths along the world's axes.
        num_cameras: (drones,), cameras that saw the drone, on average.
    """

    position_m: Float[np.ndarray, "drones 3"]
    velocity_m_s: Float[np.ndarray, "drones 3"]
    size_m: Float[np.ndarray, "drones 3"]
    num_cameras: Float[np.ndarray, "drones"]


@dataclass(frozen=True)
class _Sighting:
    """A drone in one frame: where, and the size of the blob that each camera sees (NaN where none or shared)."""

    frame: int
    position_m: Float[np.ndarray, "3"]
    num_cameras: int
    size_px: Float[np.ndarray, "cameras 2"]


def find_blobs(coverage: UInt8[np.ndarray, "height width"], reduction: int) -> Blobs:
    """Connected foreground of one silhouette."""
    foreground = (coverage >= MIN_COVERAGE).astype(np.uint8)
    # Rotors and arms fall apart in thin silhouettes; a gap of one cell is none.
    closed = cv2.morphologyEx(foreground, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    _, _, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    stats = stats[1:][stats[1:, cv2.CC_STAT_AREA] * reduction**2 >= MIN_BLOB_PX]
    corner, size = stats[:, :2].astype(float), stats[:, 2:4].astype(float)
    height, width = coverage.shape
    whole = ((corner > 0) & (corner + size < (width, height))).all(axis=-1)
    return Blobs((corner + size / 2) * reduction - 0.5, size * reduction, whole)


def find_drones(
    cameras: Camera,
    coverage: UInt8[np.ndarray, "frames cameras height width"],
    *,
    reduction: int,
    fps: float,
    bounds_m: Float[np.ndarray, "2 3"],
    max_speed_m_s: float,
) -> Start:
    """The drones that are there throughout the first frames, best seen first.

    Args:
        cameras: with one leading axis, of the image (not reduced).
        coverage: (frames, cameras, height, width), silhouettes of the first frames; ten are plenty.
        reduction: image pixels per silhouette pixel, along each side.
        fps: frames per second.
        bounds_m: (2, 3), corners of the room; its lowest z is the floor, on which shadows lie.
        max_speed_m_s: of a drone.

    Returns:
        As many drones as were seen in at least half of the frames; possibly none.
    """
    tracks: list[list[_Sighting]] = []
    # Shadows on the floor agree between all views as drones do, and they move with them; but they are flat on it.
    bounds_m = bounds_m + np.array([[0.0, 0.0, FLOOR_CLEARANCE_M], [0.0, 0.0, 0.0]])
    for frame, images in enumerate(coverage):
        sightings = _sightings(frame, cameras, [find_blobs(image, reduction) for image in images], bounds_m)
        _extend(tracks, sightings, max_speed_m_s / fps)
    tracks = [track for track in tracks if 2 * len(track) >= len(coverage)]
    seen = np.array([np.sum([one.num_cameras for one in track]) / len(coverage) for track in tracks])
    tracks = [tracks[i] for i in np.argsort(-seen, kind="stable")]
    fits = [_fit(track, fps) for track in tracks]
    return Start(
        position_m=np.array([position for position, _ in fits]).reshape(-1, 3),
        velocity_m_s=np.array([velocity for _, velocity in fits]).reshape(-1, 3),
        size_m=np.array([_size(cameras, track) for track in tracks]).reshape(-1, 3),
        num_cameras=np.sort(seen)[::-1],
    )


def _sightings(
    frame: int, cameras: Camera, blobs: list[Blobs], bounds_m: Float[np.ndarray, "2 3"]
) -> list[_Sighting]:
    centres = [one.centre_px for one in blobs]
    # Half of the blob's smaller side: the middle of a drone's blob is nearer to its projection than that.
    radius = [np.maximum(one.size_px.min(axis=-1) / 2, 6.0) for one in blobs]
    points, support = match_views(cameras, centres, radius, bounds_m)
    sightings = []
    for row, point in enumerate(points):
        centre_px, size_px = np.full((2, len(blobs), 2), np.nan)
        for camera, blob in enumerate(support[row]):
            shared = np.count_nonzero(support[:, camera] == blob) > 1
            if blob >= 0 and not shared and blobs[camera].whole[blob]:
                centre_px[camera], size_px[camera] = centres[camera][blob], blobs[camera].size_px[blob]
        # The middle of a blob that drones share, or that the border cuts, is the middle of none of them.
        if np.isfinite(centre_px).all(axis=-1).sum() >= 3:
            point = triangulate(cameras, centre_px)
        sightings.append(_Sighting(frame, point, int((support[row] >= 0).sum()), size_px))
    return sightings


def _extend(tracks: list[list[_Sighting]], sightings: list[_Sighting], reach_m: float) -> None:
    """Append each sighting to the track that it continues, or start a new one."""
    cost = np.array(
        [
            [np.linalg.norm(s.position_m - t[-1].position_m) / (s.frame - t[-1].frame) for t in tracks]
            for s in sightings
        ]
    ).reshape(len(sightings), len(tracks))
    # A blob's middle jumps by centimetres when a rotor appears, so a slow drone may seem faster than it is.
    gate = reach_m + 0.1
    rows, columns = linear_sum_assignment(np.minimum(cost, 2 * gate))
    continued = {
        int(row): int(column) for row, column in zip(rows, columns, strict=True) if cost[row, column] <= gate
    }
    for row, sighting in enumerate(sightings):
        if row in continued:
            tracks[continued[row]].append(sighting)
        else:
            tracks.append([sighting])


def _fit(track: list[_Sighting], fps: float) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Position at frame 0 and velocity: a straight line through the sightings."""
    time = np.array([one.frame for one in track]) / fps
    points = np.array([one.position_m for one in track])
    if len(track) < 3:
        return points[0], np.zeros(3)
    velocity, position = np.polyfit(time, points, 1)
    return position, velocity


def _size(cameras: Camera, track: list[_Sighting]) -> Float[np.ndarray, "3"]:
    """Full lengths of an ellipsoid, equal along x and y, whose outlines are as wide and as high as the blobs.

    Seen at elevation e, an ellipsoid of semi-axes a (level) and c (upright) is a wide and
    sqrt(a² sin² e + c² cos² e) high. Medians over cameras and frames, so that a few bad blobs do not count.
    """
    position = np.array([one.position_m for one in track])
    size_px = np.array([one.size_px for one in track])
    _, depth = project(cameras, position[:, None, :])
    ray = position[:, None, :] - cameras.centre_world
    sin2 = (ray[..., 2] / np.linalg.norm(ray, axis=-1)) ** 2
    semi = size_px / 2 * depth[..., None] / np.stack([cameras.K[:, 0, 0], cameras.K[:, 1, 1]], axis=-1)
    seen = np.isfinite(semi).all(axis=-1)
    if not seen.any():
        return np.full(3, np.nan)
    level = np.median(semi[..., 0][seen])
    upright2 = (semi[..., 1] ** 2 - level**2 * sin2)[seen] / (1 - sin2)[seen]
    # Flat drones seen from above say little of their height; it is never below a tenth of the span.
    upright = np.sqrt(max(float(np.median(upright2)), (0.1 * level) ** 2))
    return 2 * np.array([level, level, upright])
