"""Middles of the foreground in single cameras: where each camera alone sees a drone.

The tracker's position is what all cameras agree on. How far the middle of the foreground in one camera is from the
projection of this position shows the errors of the camera: of its place, its direction, its lens and its clock, and of
its silhouettes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from psotrack._typing import Array, Positions
from psotrack.geometry import Boxes, Camera, make_extents, project_boxes
from psotrack.silhouettes import Exposures, Silhouettes
from psotrack.support import stored_jit
from psotrack.tracking.chunks import on_device
from psotrack.tracking.patches import FULL, ExpectedDrones, Windows, cut_windows
from psotrack.tracking.sizes import MIN_FILLED, SizeProgram, usable_views

#: Number of times that the window is moved to the middle of the foreground that it contains.
_MOVES = 3
#: Number of frames of silhouettes that are read together.
_CHUNK_FRAMES = 25


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CameraMiddles:
    """Middles of the drones' foreground, and the drones' boxes.

    Attributes:
        middle_px: (..., drones, cameras, 2), middles of the foreground, pixels; pixel centres are at whole numbers.
            NaN where the camera does not show the drone whole and clear of other drones.
        half_px: (frames, drones, cameras, 2), half lengths of the drone's box; NaN where the drone is not in the image.
    """

    middle_px: Float[Array, "*frames drones cameras 2"]
    half_px: Float[Array, "*frames drones cameras 2"]


@partial(stored_jit, static_argnames="program")
def camera_middles(
    coverage: UInt8[Array, "frames cameras height width"],
    position_m: Float[Array, "frames drones 3"],
    size_m: Positions,
    cameras: Camera,
    program: SizeProgram,
    exposed: tuple[Float[Array, "frames drones 3"], Exposures] | None = None,
) -> CameraMiddles:
    """The middles of the foreground of all drones in all cameras.

    Args:
        coverage: (frames, cameras, height, width), 0..255, silhouettes reduced by `program.reduction`.
        position_m: (frames, drones, 3), the tracks, metres; NaN where a drone is not found.
        size_m: (drones, 3), full lengths, metres.
        cameras: cameras with one leading axis, float32.
        program: ring and reduction.
        exposed: velocities, (frames, drones, 3), m/s, and exposures of the frames; None where all cameras' frames were
            exposed at the instant.
    """

    def one(frame: tuple[Array, Array, Any]) -> CameraMiddles:
        image, position, exposed = frame
        seen = jnp.isfinite(position).all(axis=-1)
        position = jnp.where(seen[:, None], position, 0.0)
        if exposed is None:
            extents = make_extents(cameras, size_m)
        else:
            velocity, exposures = exposed
            velocity = jnp.where(seen[:, None], velocity, 0.0)
            extents = exposures.moved(make_extents(exposures.seeing(cameras), size_m), position, velocity)
        boxes = project_boxes(extents, position)
        expected = ExpectedDrones(position, reach_m=size_m.max(axis=-1) / 2)
        windows = cut_windows(image, extents, expected, reduction=program.reduction, ring=program.ring)
        middle_px, filled = _middles(windows, boxes, program.ring)
        counts = usable_views(boxes, windows, program.ring, seen) & (filled >= MIN_FILLED)
        width_px, height_px = windows.size_wh_px
        inside = (boxes.x_middle >= 0) & (boxes.x_middle <= width_px) & boxes.in_front & seen[:, None]
        inside &= (boxes.y_middle >= 0) & (boxes.y_middle <= height_px)
        return CameraMiddles(
            # Pixel centres are at whole numbers, edges of boxes between pixels.
            middle_px=jnp.where(counts[..., None], middle_px - 0.5, jnp.nan),
            half_px=jnp.where(inside[..., None], jnp.stack([boxes.x_half, boxes.y_half], axis=-1), jnp.nan),
        )

    return jax.lax.map(one, (coverage, position_m, exposed))


def _middles(
    windows: Windows, boxes: Boxes, ring: float
) -> tuple[Float[Array, "drones cameras 2"], Float[Array, "drones cameras"]]:
    """Middles of the foreground in a window as large as the ring that follows them, and its share of the box."""
    image = windows.value.astype(jnp.float32) / FULL
    cells = jnp.arange(image.shape[-1], dtype=jnp.float32) + 0.5
    x_px, y_px = (
        first[..., None] + cells * windows.pixel_px[..., None] for first in (windows.x_px, windows.y_px)
    )

    def inside(at_px: Array, middle_px: Array, half_px: Array) -> Array:
        to_edge = (ring * half_px - jnp.abs(at_px - middle_px)) / windows.pixel_px[..., None]
        return jnp.clip(to_edge + 0.5, 0, 1)

    x_middle, y_middle = boxes.x_middle, boxes.y_middle
    total: Array = jnp.zeros_like(x_middle)
    for _ in range(_MOVES):
        across = inside(x_px, x_middle[..., None], boxes.x_half[..., None])
        down = inside(y_px, y_middle[..., None], boxes.y_half[..., None])
        total = jnp.einsum("dci,dcij,dcj->dc", down, image, across)
        least = jnp.maximum(total, 1e-6)
        new_x = jnp.einsum("dci,dcij,dcj->dc", down, image, across * x_px) / least
        new_y = jnp.einsum("dci,dcij,dcj->dc", down * y_px, image, across) / least
        x_middle, y_middle = jnp.where(total > 0, new_x, x_middle), jnp.where(total > 0, new_y, y_middle)
    area = 4 * boxes.x_half * boxes.y_half / jnp.square(windows.pixel_px)
    return jnp.stack([x_middle, y_middle], axis=-1), total / jnp.maximum(area, 1e-6)


def middles_in_cameras(
    cameras: Camera,
    silhouettes: Silhouettes,
    size_m: Float[np.ndarray, "drones 3"],
    position_m: Float[np.ndarray, "frames drones 3"],
    velocity_m_s: Float[np.ndarray, "frames drones 3"],
) -> CameraMiddles:
    """The middles of the foreground in all frames of a recording, as NumPy arrays.

    Args:
        cameras: cameras with one leading axis.
        silhouettes: silhouettes of all cameras.
        size_m: (drones, 3), full lengths of the drones, metres.
        position_m, velocity_m_s: (frames, drones, 3), the tracks, metres and m/s; NaN where a drone is not found.
    """
    program = SizeProgram(reduction=silhouettes.reduction)
    size, cameras = jnp.asarray(size_m, jnp.float32), on_device(cameras)
    chunks = []
    for first in range(0, silhouettes.num_frames, _CHUNK_FRAMES):
        part = slice(first, min(first + _CHUNK_FRAMES, silhouettes.num_frames))
        missing = _CHUNK_FRAMES - (part.stop - part.start)
        # The last chunk is filled up: every length would be compiled.
        coverage, position, velocity = (
            np.pad(value, [(0, missing), *[(0, 0)] * (value.ndim - 1)], constant_values=empty)
            for value, empty in (
                (silhouettes.read(part.start, part.stop), 0),
                (position_m[part].astype(np.float32), np.nan),
                (np.nan_to_num(velocity_m_s[part]).astype(np.float32), 0),
            )
        )
        exposures = silhouettes.exposures
        exposed = None if exposures is None else (velocity, exposures[part].padded(_CHUNK_FRAMES))
        # The device works on a chunk while the next one is read.
        chunks.append(camera_middles(coverage, position, size, cameras, program, exposed))
        if len(chunks) > 1:
            jax.block_until_ready(chunks[-2])
    return jax.tree.map(lambda *parts: np.concatenate(parts)[: len(position_m)], *jax.device_get(chunks))
