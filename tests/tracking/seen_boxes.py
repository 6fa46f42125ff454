"""Boxes in which cameras see drones: one simulation for all tests that track by lines of sight."""

import numpy as np
from helpers import ROOM_M

from psotrack.geometry import project
from psotrack.settings import TrackSettings
from psotrack.tracking.lines import track_detections
from psotrack.tracking.matching import NOISE_PX, NOISE_SHARE, Sightings

FPS = 25.0


def true_boxes(rig, position_m, span_m):
    """Middles and sizes (..., cameras, drones, 2) in which the cameras see drones at (..., drones, 3), pixels."""
    pixels, depth = project(rig.cameras, np.asarray(position_m)[..., None, :])
    focal_px = np.diagonal(rig.cameras.K, axis1=-2, axis2=-1)[:, :2]
    size_px = np.asarray(span_m)[..., None, :] * focal_px / depth[..., None]
    return pixels.swapaxes(-2, -3), size_px.swapaxes(-2, -3)


def see(rig, position_m, span_m, *, jitter=0.0, clutter=0, seed=0, unseen=()):
    """Sightings of drones at (frames, drones, 3), of the given widths and heights.

    Args:
        rig: the cameras.
        position_m: places of the drones, metres.
        span_m: (2,) or (drones, 2), widths and heights, metres.
        jitter: error of the middles as a share of the sides.
        clutter: false alarms in each image.
        seed: of what is random.
        unseen: parts of (frames, cameras, drones) without boxes, as indices or masks.
    """
    rng = np.random.default_rng(seed)
    centre_px, size_px = true_boxes(rig, position_m, span_m)
    wide_px = rig.cameras.image_size_wh[:, None].astype(float)
    gone = ((centre_px < -0.5) | (centre_px > wide_px - 0.5)).any(axis=-1)
    for part in unseen:
        gone[part] = True
    centre_px = centre_px + jitter * size_px * rng.standard_normal(centre_px.shape)
    false_px = rng.uniform(0, wide_px, (*gone.shape[:2], clutter, 2))
    centre_px = np.concatenate([np.where(gone[..., None], np.nan, centre_px), false_px], axis=2)
    size_px = np.concatenate([size_px, rng.uniform(10, 100, false_px.shape)], axis=2)
    return boxes_of(centre_px, size_px)


def boxes_of(centre_px, size_px):
    """Sightings whose noise is that of detections; NaN for no box."""
    size_px = np.where(np.isfinite(centre_px), size_px, np.nan)
    return Sightings(centre_px, size_px, NOISE_PX + NOISE_SHARE * np.sqrt(size_px.prod(axis=-1)))


def joined(one, other, axis):
    """The sightings of both, one after the other along frames (0) or boxes (2)."""
    return boxes_of(
        *(
            np.concatenate([getattr(each, name) for each in (one, other)], axis=axis)
            for name in ("centre_px", "size_px")
        )
    )


def track(rig, seen, settings=None, *, bounds_m=ROOM_M, known=None):
    """The tracks by lines of sight."""
    settings = settings or TrackSettings()
    return track_detections(rig.cameras, seen, settings, fps=FPS, bounds_m=bounds_m, known=known)[0]
