"""Lenses whose model folds within the image: their detections as a lens without distortion would show them.

A polynomial is a lens as far as the points of its calibration reach, and may turn back beyond: no ray leads to the
pixels there, though the camera shows them. No lens bends more than an orthographic one, of which the distance from the
axis is the sine of the ray's angle. From where a model bends more it is continued straight.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from psotrack.geometry import Camera, Rig, undistort, undistortion_stretch
from psotrack.tracking.matching.sightings import Sightings

#: Directions from the axis in which the lens is looked at.
_ANGLES = np.linspace(0.0, 2 * np.pi, 64, endpoint=False)
#: Pixels that are looked at along each side of an image.
_PER_SIDE = 16


def straightened(rig: Rig, sightings: Sightings) -> tuple[Rig, Sightings, tuple[str, ...]]:
    """A rig and its detections, without distortion where a lens folds within the image; the names of these cameras.

    Args:
        rig: the cameras.
        sightings: detections of all frames.
    """
    cameras = rig.cameras
    folded = [number for number in range(len(rig)) if _folds(cameras[number])]
    centre_px, size_px, noise_px = (
        np.array(each) for each in (sightings.centre_px, sightings.size_px, sightings.noise_px)
    )
    dist = np.array(cameras.dist)
    for number in folded:
        there = np.isfinite(noise_px[:, number])
        centre_px[:, number][there], stretch = _straight(cameras[number], centre_px[:, number][there])
        size_px[:, number][there] *= stretch[:, None]
        noise_px[:, number][there] *= stretch
        dist[number] = 0
    straight = replace(rig, cameras=replace(cameras, dist=dist))
    seen = replace(sightings, centre_px=centre_px, size_px=size_px, noise_px=noise_px)
    return straight, seen, tuple(rig.names[number] for number in folded)


def _folds(camera: Camera) -> bool:
    """Whether a lens has no ray for some pixel of the image's border. A fisheye ends at 90 degrees, as real ones do."""
    if camera.dist.shape[-1] == 0 or (camera.fisheye is not None and bool(camera.fisheye)):
        return False
    share = np.linspace(0.0, 1.0, _PER_SIDE)
    sides = [np.stack(np.broadcast_arrays(share, end), axis=-1) for end in (0.0, 1.0)]
    border = np.concatenate([each[:, axes] for each in sides for axes in ([0, 1], [1, 0])])
    return bool(np.isnan(undistort(camera, border * (np.asarray(camera.image_size_wh) - 1.0))).any())


def _straight(
    camera: Camera, pixels: Float[np.ndarray, "pixels 2"]
) -> tuple[Float[np.ndarray, "pixels 2"], Float[np.ndarray, "pixels"]]:
    """Pixels without distortion, and by how much small lengths grow there."""
    focal_px, middle_px = np.diagonal(camera.K)[:2], camera.K[:2, 2]
    off = (pixels - middle_px) / focal_px
    bent = np.maximum(np.linalg.norm(off, axis=-1), 1e-9)
    angle = np.arctan2(off[:, 1], off[:, 0])
    end, slope = (np.interp(angle, _ANGLES, each, period=2 * np.pi) for each in _ends(camera))
    within = np.minimum(bent, end)
    rays = undistort(camera, middle_px + (within / bent)[:, None] * off * focal_px)
    length = np.maximum(np.linalg.norm(rays, axis=-1), 1e-9)
    straight = rays * (1 + slope * (bent - within) / length)[:, None]
    return straight * focal_px + middle_px, undistortion_stretch(camera, rays)


def _ends(camera: Camera) -> tuple[Float[np.ndarray, "angles"], Float[np.ndarray, "angles"]]:
    """For each direction, the distance from the axis up to which a model is a lens, and the slope of rays beyond.

    Distances are normalised, in the image with distortion; the slope is the change of the distance without distortion.
    """
    bent = np.arange(1, 200)[:, None] / 100
    across = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=-1)
    pixels = camera.K[:2, 2] + bent[..., None] * across * np.diagonal(camera.K)[:2]
    ray = np.linalg.norm(undistort(camera, pixels), axis=-1)
    with np.errstate(invalid="ignore"):
        # Of an orthographic lens, ray = bent / sqrt(1 - bent^2), whose slope is (1 + ray^2) ray / bent.
        slope = np.diff(ray, axis=0) / np.diff(bent, axis=0)
        is_lens = slope <= (1 + ray[1:] ** 2) * (ray / bent)[1:]
    last = np.minimum(np.cumprod(is_lens, axis=0).sum(axis=0), len(is_lens) - 1)
    direction = np.arange(len(_ANGLES))
    # Beyond, the truth is between the slope that the model has there, and that of no distortion.
    of_model, of_none = slope[np.maximum(last - 1, 0), direction], ray[last, direction] / bent[last, 0]
    return bent[last, 0], 2 / (1 / of_model + 1 / of_none)
