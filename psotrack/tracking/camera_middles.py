"""Middles of the foreground in single cameras: where each camera alone sees a drone.

The tracker's position is what all cameras agree on. How far the middle of the foreground in one camera is from the
projection of this position shows the errors of the camera: of its place, its direction, its lens and its clock, and of
its silhouettes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from psotrack._typing import Array
from psotrack.geometry import Boxes, Camera, make_extents, project_boxes
from psotrack.silhouettes import Exposures, Silhouettes
from psotrack.support import stored_jit
from psotrack.tracking.chunks import on_device
from psotrack.tracking.devices import computes_side_by_side
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


@dataclass(frozen=True)
class FoundDrones:
    """The drones of one run, as its tracks have them.

    Attributes:
        size_m: (drones, 3), full lengths, metres.
        position_m, velocity_m_s: (frames, drones, 3), metres and m/s; NaN where a drone is not found.
    """

    size_m: Float[np.ndarray, "drones 3"]
    position_m: Float[np.ndarray, "frames drones 3"]
    velocity_m_s: Float[np.ndarray, "frames drones 3"]


#: Positions and velocities of the drones of a run in some frames, and the drones' sizes; for several runs side by side
#: with a leading axis of runs.
_Drones = tuple[
    Float[Array, "*runs frames drones 3"],
    Float[Array, "*runs frames drones 3"],
    Float[Array, "*runs drones 3"],
]


@partial(stored_jit, static_argnames=("program", "side_by_side"))
def _middles_of_runs(
    drones: _Drones,
    coverage: UInt8[Array, "frames cameras height width"],
    cameras: Camera,
    exposures: Exposures | None,
    program: SizeProgram,
    side_by_side: bool,
) -> CameraMiddles:
    """The middles of one run; side by side those of several runs, whose arrays have a leading axis of runs."""

    # Leaves instead of records: arrays of many runs have an axis that the records do not declare.
    def leaves_of(one_run: Any) -> tuple[Array, Array]:
        found = _middles_in_frames(one_run, coverage, cameras, exposures, program)
        return found.middle_px, found.half_px

    return CameraMiddles(*(jax.vmap(leaves_of) if side_by_side else leaves_of)(drones))


def _middles_in_frames(
    drones: _Drones,
    coverage: UInt8[Array, "frames cameras height width"],
    cameras: Camera,
    exposures: Exposures | None,
    program: SizeProgram,
) -> CameraMiddles:
    """The middles of the foreground of all drones in all cameras.

    Args:
        drones: the drones; positions are NaN where a drone is not found.
        coverage: (frames, cameras, height, width), 0..255, silhouettes reduced by `program.reduction`.
        cameras: cameras with one leading axis, float32.
        exposures: exposures of the frames; None where all cameras' frames were exposed at the instant.
        program: ring and reduction.
    """
    positions_m, velocities_m_s, size_m = drones

    def one(frame: tuple[Array, Array, Array, Exposures | None]) -> CameraMiddles:
        image, position, velocity, exposures = frame
        seen = jnp.isfinite(position).all(axis=-1)
        position = jnp.where(seen[:, None], position, 0.0)
        if exposures is None:
            extents = make_extents(cameras, size_m)
        else:
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

    return jax.lax.map(one, (coverage, positions_m, velocities_m_s, exposures))


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
    runs: Sequence[FoundDrones],
    *,
    side_by_side: bool | None = None,
) -> list[CameraMiddles]:
    """The middles of the foreground in all frames of a recording, as NumPy arrays, for each of some runs.

    The silhouettes are read once for all runs. On a CPU each run gives the same bits as alone.

    Args:
        cameras: cameras with one leading axis.
        silhouettes: silhouettes of all cameras.
        runs: the drones of each run.
        side_by_side: whether runs with the same number of drones are computed side by side, not one after the other;
            None is the choice for the device.
    """
    if side_by_side is None:
        side_by_side = computes_side_by_side(jax.default_backend())
    together = _together(runs, side_by_side)
    program, on_the_device = SizeProgram(reduction=silhouettes.reduction), on_device(cameras)
    chunks: list[list[CameraMiddles]] = []
    for first in range(0, silhouettes.num_frames, _CHUNK_FRAMES):
        part = slice(first, min(first + _CHUNK_FRAMES, silhouettes.num_frames))
        coverage = jnp.asarray(_filled_up(silhouettes.read(part.start, part.stop), 0.0))
        exposures = silhouettes.exposures
        shared = (
            coverage,
            on_the_device,
            None if exposures is None else exposures[part].padded(_CHUNK_FRAMES),
        )
        # The device works on a chunk while the next one is read.
        chunks.append(
            [
                _middles_of_runs(
                    _drones_of(runs, numbers, part, side_by_side), *shared, program, side_by_side
                )
                for numbers in together
            ]
        )
        if len(chunks) > 1:
            jax.block_until_ready(chunks[-2])
    axis = 1 if side_by_side else 0
    found: dict[int, CameraMiddles] = {}
    for numbers, parts in zip(together, zip(*jax.device_get(chunks), strict=True), strict=True):
        middle_px, half_px = (
            np.concatenate([getattr(part, name) for part in parts], axis=axis)
            for name in ("middle_px", "half_px")
        )
        for place, number in enumerate(numbers):
            of_run = (place, slice(silhouettes.num_frames)) if side_by_side else slice(silhouettes.num_frames)
            found[number] = CameraMiddles(middle_px[of_run], half_px[of_run])
    return [found[number] for number in range(len(runs))]


def _together(runs: Sequence[FoundDrones], side_by_side: bool) -> list[list[int]]:
    """Numbers of the runs that are computed together: those with as many drones if side by side, else each alone."""
    if not side_by_side:
        return [[number] for number in range(len(runs))]
    by_count: dict[int, list[int]] = {}
    for number, run in enumerate(runs):
        by_count.setdefault(len(run.size_m), []).append(number)
    return list(by_count.values())


def _drones_of(
    runs: Sequence[FoundDrones], numbers: Sequence[int], part: slice, side_by_side: bool
) -> tuple[np.ndarray, ...]:
    """The drones of some runs in a chunk, in float32; side by side with a leading axis of runs."""
    drones = [
        (
            _filled_up(run.position_m[part].astype(np.float32), np.nan),
            _filled_up(np.nan_to_num(run.velocity_m_s[part]).astype(np.float32), 0.0),
            run.size_m.astype(np.float32),
        )
        for run in (runs[number] for number in numbers)
    ]
    return tuple(map(np.stack, zip(*drones, strict=True))) if side_by_side else drones[0]


def _filled_up(value: np.ndarray, empty: float) -> np.ndarray:
    """The frames of a chunk, and after them empty ones up to its length: every length would be compiled."""
    missing = _CHUNK_FRAMES - len(value)
    if not missing:
        return value
    return np.concatenate([value, np.full((missing, *value.shape[1:]), empty, value.dtype)])
