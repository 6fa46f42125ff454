"""A scene in memory: ellipsoidal drones fly on closed paths, and their outlines are drawn into the images of cameras.

In coordinates in which the ellipsoid is a unit sphere, its outline is a circle. So every outline is exact, and does not
depend on the quadrics of `psotrack.geometry.boxes`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from psotrack.geometry import Camera, Rig, look_at, make_camera, make_rig, project

IMAGE_SIZE_WH = (1920, 1080)
REDUCTION = 4
FPS = 25.0
BOUNDS_M = np.array([[-6.0, -5.0, -0.2], [6.0, 5.0, 4.0]])

#: Full lengths of every drone, metres.
DRONE_SIZE_M = np.array([0.48, 0.48, 0.24])

#: Full lengths of the drones of a formation, metres.
SMALL_DRONE_SIZE_M = DRONE_SIZE_M / 2

#: Period of the closed paths, frames.
PERIOD_FRAMES = 250

_OUTLINE_POINTS = 64
#: Bits of a pixel's fraction in OpenCV's drawing.
_SHIFT = 4


@dataclass(frozen=True)
class Scene:
    """Cameras around a room and the drones' paths in it.

    Attributes:
        rig: cameras without lens distortion.
        position_m: (frames, drones, 3), true positions, metres.
        velocity_m_s: (frames, drones, 3), true velocities, metres per second.
        size_m: (drones, 3), full lengths, metres.
    """

    rig: Rig
    position_m: np.ndarray
    velocity_m_s: np.ndarray
    size_m: np.ndarray

    def picture(self, background: np.ndarray, camera: int, frame: int) -> np.ndarray:
        """(height, width, 3), uint8: a camera's picture of dark drones before a background of the image's size."""
        image = background.copy()
        one = self.rig.cameras[camera]
        for centre_m, size_m in zip(self.position_m[frame], self.size_m, strict=True):
            points = np.round(_outline_px(one, centre_m, size_m) * 2**_SHIFT).astype(np.int32)
            cv2.fillConvexPoly(image, points, (30, 30, 30), cv2.LINE_AA, _SHIFT)
        return image

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of one silhouette."""
        return IMAGE_SIZE_WH[1] // REDUCTION, IMAGE_SIZE_WH[0] // REDUCTION

    def coverage(self, frames: slice = slice(None)) -> np.ndarray:
        """Silhouettes (frames, cameras, height, width), uint8, 0 to 255."""
        return np.stack(list(self._drawn(frames)))

    def _drawn(self, frames: slice) -> Iterator[np.ndarray]:
        cameras = [self.rig.cameras[index] for index in range(len(self.rig))]
        for position_m in self.position_m[frames]:
            image = np.zeros((len(cameras), *self.shape), np.uint8)
            for one, canvas in zip(cameras, image, strict=True):
                for centre_m, size_m in zip(position_m, self.size_m, strict=True):
                    _draw(canvas, _outline_px(one, centre_m, size_m))
            yield image


def scene(num_frames: int, num_drones: int, num_cameras: int) -> Scene:
    """Make the scene; it is the same in every call.

    Cameras hang on an ellipse of 10 x 8 m, 3 m high, and look at the middle of the room. Drones fly on Lissajous
    curves at up to about 2 m/s, one above another, so that they never touch but occlude each other in images.
    """
    rate = 2 * np.pi / PERIOD_FRAMES * FPS
    time_s = np.arange(num_frames)[:, None] / FPS
    drone = np.arange(num_drones)
    turns = np.array([1.0, 2.0, 3.0]) * rate
    phases = np.stack([2.4 * drone, 1.7 * drone + 0.5, 0.9 * drone], axis=-1)
    amplitudes_m = np.array([1.2, 0.8, 0.1])
    level_m = 0.7 + (drone + 0.5) / num_drones * 1.6
    angles = turns * time_s[..., None] + phases
    position_m = amplitudes_m * np.sin(angles)
    position_m[..., 2] += level_m
    return Scene(
        rig=_ring(num_cameras, IMAGE_SIZE_WH),
        position_m=position_m,
        velocity_m_s=amplitudes_m * turns * np.cos(angles),
        size_m=np.tile(DRONE_SIZE_M, (num_drones, 1)),
    )


def formation(num_frames: int, num_drones: int, num_cameras: int, image_size_wh: tuple[int, int]) -> Scene:
    """A scene for up to 60 drones, which fly a circle together, each at its own place of a grid.

    Places are 0.95 m apart in the plane and 0.8 m in height, so that drones never touch and the room does not get
    denser where few drones are added. The circle has a radius of 0.7 m and takes 3 s. The drones are small, because
    fifty large ones hide each other.

    Args:
        num_frames, num_drones, num_cameras: numbers of frames, drones and cameras.
        image_size_wh: width and height of the images, pixels; lenses have the same angle of view at all sizes.
    """
    grid_m = np.stack(np.meshgrid(np.arange(5), np.arange(4), np.arange(3), indexing="ij"), axis=-1)
    places_m = (grid_m.reshape(-1, 3) - [2.0, 1.5, 0.0]) * [0.95, 0.95, 0.8] + [0.0, 0.0, 0.6]
    places_m = np.random.default_rng(0).permutation(places_m)[:num_drones]
    turn = 2 * np.pi / 3.0
    angle = turn * np.arange(num_frames) / FPS
    moved_m = 0.7 * np.stack([np.cos(angle), np.sin(angle), np.zeros(num_frames)], axis=-1)
    velocity_m_s = 0.7 * turn * np.stack([-np.sin(angle), np.cos(angle), np.zeros(num_frames)], axis=-1)
    return Scene(
        rig=_ring(num_cameras, image_size_wh),
        position_m=moved_m[:, None] + places_m,
        velocity_m_s=np.repeat(velocity_m_s[:, None], num_drones, axis=1),
        size_m=np.tile(SMALL_DRONE_SIZE_M, (num_drones, 1)),
    )


def _ring(num_cameras: int, image_size_wh: tuple[int, int]) -> Rig:
    """Cameras on an ellipse of 10 x 8 m, 3 m high, that look at the middle of the room."""
    width, height = image_size_wh
    focal_px = 1156.3 / 1920 * width
    K = np.array([[focal_px, 0.0, width / 2], [0.0, focal_px, height / 2], [0.0, 0.0, 1.0]])
    named = {}
    for index in range(num_cameras):
        angle = 2 * np.pi * (index + 0.5) / num_cameras
        R, t_m = look_at((5 * np.cos(angle), 4 * np.sin(angle), 3.0), (0.0, 0.0, 1.2))
        named[f"camera{index}"] = make_camera(R=R, t_m=t_m, K=K, image_size_wh=image_size_wh)
    return make_rig(named)


def _outline_px(one: Camera, centre_m: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """(points, 2), the outline of an ellipsoid in an image."""
    eye = (one.centre_world - centre_m) / (size_m / 2)
    distance = np.linalg.norm(eye)
    towards = eye / distance
    across = np.linalg.svd(towards[None])[2][1:]
    angle = np.linspace(0, 2 * np.pi, _OUTLINE_POINTS, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1) @ across
    on_sphere = towards / distance + circle * np.sqrt(1 - 1 / distance**2)
    return project(one, centre_m + on_sphere * size_m / 2)[0]


def _draw(canvas: np.ndarray, outline_px: np.ndarray) -> None:
    """Fill an outline at full size, in the patch that contains it, and add its coverage to the reduced canvas."""
    size = canvas.shape[1], canvas.shape[0]
    low = np.clip(np.floor((outline_px.min(axis=0) - 1) / REDUCTION), 0, size).astype(int)
    high = np.clip(np.ceil((outline_px.max(axis=0) + 2) / REDUCTION), 0, size).astype(int)
    width, height = high - low
    if width == 0 or height == 0:
        return
    patch = np.zeros((height * REDUCTION, width * REDUCTION), np.uint8)
    points = np.round((outline_px - low * REDUCTION) * 2**_SHIFT).astype(np.int32)
    cv2.fillConvexPoly(patch, points, 255, shift=_SHIFT)
    cells = patch.reshape(height, REDUCTION, width, REDUCTION).mean(axis=(1, 3)).round().astype(np.uint8)
    there = canvas[low[1] : high[1], low[0] : high[0]]
    np.maximum(there, cells, out=there)
