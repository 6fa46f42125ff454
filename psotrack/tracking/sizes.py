"""How large each drone is, learned while it flies.

A drone's size does not change, and the first frames, from which the initial size comes, may be poor. `measure_sizes`
measures the size that every frame shows, `learn_sizes` takes a chunk of such measurements into the running estimate.

The spread of a silhouette about its own middle is measured, so the result does not depend on how well the drone is
placed. The variance of a filled ellipse along a direction is a quarter of the squared half length (M. R. Teague, Image
analysis via the general theory of moments, JOSA 70(8), 1980), and the squared half lengths of an ellipsoid's outlines
are nearly linear in the squared half lengths of the ellipsoid (Hartley & Zisserman 2004, section 8.3): the views of a
frame give the horizontal and the vertical length by least squares. The two horizontal lengths change together, because
drones turn.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int, UInt8

from psotrack._typing import Array, Coverage, Positions
from psotrack.geometry import Boxes, Camera, Extents, make_extents, project_boxes
from psotrack.silhouettes import Exposures
from psotrack.tracking.patches import FULL, ExpectedDrones, Windows, cut_windows
from psotrack.tracking.shadows import is_low

#: Half length over the standard deviation of the foreground: 2 for an ellipse, the square root of 6 for a rhombus.
#: Drones, whose arms end in points and whose rotors are widest, lie between the two.
HALF_PER_STD = 2.2
#: Largest ratio of a learned length and the initial length, in either direction.
RANGE = 2.0
#: Weight of the initial size, in frames, and its standard deviation, of the logarithm of a length.
START_FRAMES, START_STD = 5, 0.15
#: Least number of good frames in a chunk: the median of fewer frames is not robust against bad frames.
MIN_FRAMES = 5
#: Least share of the drone's box that must be foreground in a camera that shows the drone whole.
MIN_FILLED = 0.15
#: Scale of a neighbour's ellipse within which the neighbour may have foreground: outlines are no ellipses.
NEIGHBOUR = 1.15
#: Standard deviation of squared lengths of single views, as a share of the squared length, from yaw and tilt; views
#: that deviate more have less weight.
VIEW_STD = 0.25
#: Weight of the present size in the fit, in views that show one length alone; and least share of a fitted length that
#: must come from the frame's own views, otherwise the length is NaN.
PRIOR_VIEWS, MIN_SHARE = 0.01, 0.9
#: Iterations in which views are weighted by their deviation.
REWEIGHTINGS = 2


@dataclass(frozen=True)
class SizeProgram:
    """What is compiled into the measurement of sizes.

    Attributes:
        windows: scales of the drone's box whose filling is measured.
        ring: scale of the box that bounds the foreground which belongs to the drone.
        reduction: image pixels per silhouette pixel, along each side.
    """

    windows: tuple[float, ...] = (0.4, 0.7, 1.0)
    ring: float = 1.5
    reduction: int = 4


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SizeMeasurements:
    """Sizes that single frames show; NaN where a drone was not clearly seen.

    Attributes:
        size_m: (frames, drones, 3), full lengths along the world's axes, metres. The height alone is NaN for a flat
            drone that is only seen from above.
        fill: (frames, drones, windows), share of each window that is foreground, mean over the views.
    """

    size_m: Float[Array, "*frames drones 3"]
    fill: Float[Array, "*frames drones windows"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SizeState:
    """The running estimate of every drone's size.

    Attributes:
        start_m, size_m: (drones, 3), full lengths along the world's axes, metres: initial and present.
        pinned: (drones, 3), lengths that stay as they are.
        num_frames, num_chunks: (drones, 3), numbers of frames and chunks from which each length was learned.
        scatter: (drones, 3), squared deviations of the chunks' logarithms from their mean, times frames.
        fill: (drones, windows), share of each window that is foreground; NaN before any frame.
    """

    start_m: Positions
    size_m: Positions
    pinned: Bool[Array, "drones 3"]
    num_frames: Int[Array, "drones 3"]
    num_chunks: Int[Array, "drones 3"]
    scatter: Float[Array, "drones 3"]
    fill: Float[Array, "drones windows"]

    @property
    def std_m(self) -> Positions:
        """(drones, 3), standard errors, metres.

        They come from the scatter of chunks, because errors within a chunk are correlated.
        """
        weight = (self.num_frames + START_FRAMES) * (self.num_chunks + 1)
        std = self.size_m * jnp.sqrt(self.scatter / weight.astype(jnp.float32))
        return jnp.where(self.pinned, 0.0, std)


def init(size_m: Positions, pinned: Bool[Array, "drones 3"], num_windows: int) -> SizeState:
    """The estimate before the first frame.

    Args:
        size_m: (drones, 3), initial full lengths, metres.
        pinned: (drones, 3), lengths that stay as they are; where x or y is pinned, both are.
        num_windows: number of windows whose filling is measured.
    """
    size_m = jnp.asarray(size_m, jnp.float32)
    none = jnp.zeros(size_m.shape, jnp.int32)
    level = pinned[:, :2].any(axis=1)
    return SizeState(
        start_m=size_m,
        size_m=size_m,
        pinned=jnp.stack([level, level, jnp.asarray(pinned)[:, 2]], axis=1),
        num_frames=none,
        num_chunks=none,
        scatter=jnp.full(size_m.shape, START_FRAMES * START_STD**2, jnp.float32),
        fill=jnp.full((size_m.shape[0], num_windows), jnp.nan, jnp.float32),
    )


def with_added_drones(state: SizeState, added: SizeState) -> SizeState:
    """Estimate with the drones of `state` first and the drones of `added` last."""
    return jax.tree.map(lambda first, last: jnp.concatenate([first, last]), state, added)


@jax.jit
def learn_sizes(state: SizeState, measured: SizeMeasurements) -> SizeState:
    """The estimate after one more chunk of frames.

    The chunk's median, which a minority of bad frames does not move, enters a mean over all frames. So the estimate
    settles, and the influence of the initial size fades.
    """
    ratio = jnp.log(measured.size_m / state.size_m)
    frames = jnp.isfinite(ratio).sum(axis=0, dtype=jnp.int32)
    enough = frames >= MIN_FRAMES
    off = jnp.where(enough, jnp.nanmedian(ratio, axis=0), 0.0)
    new = jnp.where(enough, frames, 0).astype(jnp.float32)
    gain = new / (new + (START_FRAMES + state.num_frames).astype(jnp.float32))
    size_m = state.size_m * jnp.exp(gain * off)
    size_m = jnp.clip(size_m, state.start_m / RANGE, state.start_m * RANGE)

    # The filling has no initial value.
    seen = state.num_frames[:, :1].astype(jnp.float32)
    fill_gain = new[:, :1] / jnp.maximum(new[:, :1] + seen, 1.0)
    before = jnp.where(seen > 0, state.fill, 0.0)
    fill = before + fill_gain * (jnp.nan_to_num(jnp.nanmedian(measured.fill, axis=0)) - before)
    return replace(
        state,
        size_m=jnp.where(state.pinned, state.size_m, size_m),
        num_frames=state.num_frames + jnp.where(enough, frames, 0),
        num_chunks=state.num_chunks + enough.astype(jnp.int32),
        scatter=state.scatter + new * (1 - gain) * jnp.square(off),
        fill=jnp.where(new[:, :1] + seen > 0, fill, jnp.nan),
    )


@partial(jax.jit, static_argnames="program")
def measure_sizes(
    coverage: UInt8[Array, "frames cameras height width"],
    position_m: Float[Array, "frames drones 3"],
    size_m: Positions,
    cameras: Camera,
    program: SizeProgram,
    floor_z_m: Float[Array, ""] | None = None,
    exposed: tuple[Float[Array, "frames drones 3"], Exposures] | None = None,
) -> SizeMeasurements:
    """The size of every drone in every frame.

    A view counts if the drone's surroundings are inside the image and clear of other drones; a frame counts if two
    views count.

    Args:
        coverage: (frames, cameras, height, width), 0..255, silhouettes reduced by `program.reduction`.
        position_m: (frames, drones, 3), world, metres; NaN where a drone is not well seen.
        size_m: (drones, 3), present full lengths, metres; the result hardly depends on them within a factor of 1.5.
        cameras: cameras with one leading axis.
        program: windows, ring and reduction.
        floor_z_m: height of the floor, metres. The silhouette of a drone that is low over the floor may contain its
            shadow, so such a drone is not measured.
        exposed: velocities, (frames, drones, 3), m/s, and exposures of the frames, with which the drones' places in the
            frames follow; None where all cameras' frames were exposed at the instant.
    """

    def one(frame: tuple[Array, Array, Array, Any]) -> SizeMeasurements:
        image, position, seen, exposed = frame
        position = jnp.where(seen[:, None], position, 0.0)

        def in_cameras(size_m: Array) -> Extents:
            if exposed is None:
                return make_extents(cameras, size_m)
            velocity, exposures = exposed
            moving = jnp.where(seen[:, None], velocity, 0.0)
            return exposures.moved(make_extents(exposures.seeing(cameras), size_m), position, moving)

        return _measure(image, position, seen, size_m, in_cameras, program, floor_z_m)

    well_seen = jnp.isfinite(position_m).all(axis=-1)
    return jax.lax.map(one, (coverage, position_m, well_seen, exposed))


def _measure(
    coverage: Coverage,
    position_m: Positions,
    well_seen: Bool[Array, "drones"],
    size_m: Positions,
    in_cameras: Callable[[Array], Extents],
    program: SizeProgram,
    floor_z_m: Float[Array, ""] | None,
) -> SizeMeasurements:
    """The sizes that one frame shows; `in_cameras` gives the extents of drones of some sizes."""

    def boxes_of(factors: Float[Array, "2"]) -> Boxes:
        factor = jnp.sqrt(jnp.stack([factors[0], factors[0], factors[1]]))
        return project_boxes(in_cameras(size_m * factor), position_m)

    def squares(factors: Float[Array, "2"]) -> Float[Array, "drones cameras 2"]:
        boxes = boxes_of(factors)
        return jnp.square(jnp.stack([boxes.x_half, boxes.y_half], axis=-1))

    same = jnp.ones(2)
    boxes, slope = boxes_of(same), jax.jacfwd(squares)(same)
    design = slope / slope.sum(axis=-1, keepdims=True)
    windows = cut_windows(
        coverage,
        in_cameras(size_m),
        # Views in which another drone could occlude the drone do not count.
        ExpectedDrones(position_m, reach_m=jnp.zeros_like(size_m[:, 0])),
        reduction=program.reduction,
        ring=program.ring,
    )
    spread, fill, filled = _moments(windows, boxes, program)
    counts = usable_views(boxes, windows, program.ring, well_seen) & (filled >= MIN_FILLED)
    if floor_z_m is not None:
        counts &= ~is_low(position_m, size_m, floor_z_m)[:, None]
    factors, share = _fit_lengths(design, HALF_PER_STD**2 * spread, counts)
    good = (counts.sum(axis=-1) >= 2)[:, None] & (share >= MIN_SHARE) & (factors > 0)
    factors = jnp.where(good, jnp.sqrt(jnp.where(good, factors, 1.0)), jnp.nan)
    views = jnp.where(good[:, :1], counts.sum(axis=-1, keepdims=True).astype(jnp.float32), jnp.nan)
    return SizeMeasurements(
        size_m=size_m * jnp.stack([factors[:, 0], factors[:, 0], factors[:, 1]], axis=-1),
        fill=jnp.where(counts[..., None], fill, 0.0).sum(axis=1) / views,
    )


def _moments(
    windows: Windows, boxes: Boxes, program: SizeProgram
) -> tuple[
    Float[Array, "drones cameras 2"], Float[Array, "drones cameras windows"], Float[Array, "drones cameras"]
]:
    """Moments of the foreground in the ring.

    Returns:
        Variances along columns and rows in squared half lengths of the box, the filled share of each window, and the
        filled share of the box.
    """
    image = windows.value.astype(jnp.float32) / FULL
    scales = jnp.asarray((*program.windows, 1.0, program.ring))

    def line(first_px: Array, middle_px: Array, half_px: Array) -> tuple[Array, Array, Array]:
        pixel = (windows.pixel_px / half_px)[..., None]
        cells = jnp.arange(image.shape[-1], dtype=jnp.float32) + 0.5
        at = ((first_px - middle_px) / half_px)[..., None] + cells * pixel
        inside = jnp.clip((scales[:, None] - jnp.abs(at[..., None, :])) / pixel[..., None] + 0.5, 0, 1)
        return at, inside, pixel

    x, x_inside, x_pixel = line(windows.x_px, boxes.x_middle, boxes.x_half)
    y, y_inside, y_pixel = line(windows.y_px, boxes.y_middle, boxes.y_half)
    sums = jnp.einsum("dcsi,dcij,dcsj->dcs", y_inside, image, x_inside)
    full = sums * x_pixel * y_pixel / jnp.square(2 * scales)

    def variance(of: Array, at: Array, pixel: Array) -> Array:
        of = of / jnp.maximum(of.sum(axis=-1, keepdims=True), 1e-6)
        middle = (of * at).sum(axis=-1, keepdims=True)
        # Sheppard's correction for the width of a pixel.
        return (of * jnp.square(at - middle)).sum(axis=-1) - jnp.square(pixel[..., 0]) / 12

    across = jnp.einsum("dci,dcij,dcj->dcj", y_inside[..., -1, :], image, x_inside[..., -1, :])
    down = jnp.einsum("dci,dcij,dcj->dci", y_inside[..., -1, :], image, x_inside[..., -1, :])
    spread = jnp.stack([variance(across, x, x_pixel), variance(down, y, y_pixel)], axis=-1)
    return spread, full[..., :-2], full[..., -2]


def usable_views(
    boxes: Boxes, windows: Windows, ring: float, well_seen: Bool[Array, "drones"]
) -> Bool[Array, "drones cameras"]:
    """Which views show the drone alone and whole: the ring is inside the image, and no other drone is in the ring."""
    width_px, height_px = windows.size_wh_px

    def within(middle: Array, half: Array, length_px: Array) -> Array:
        return (middle - ring * half >= 0) & (middle + ring * half <= length_px)

    def meet(middle: Array, half: Array) -> Array:
        return jnp.abs(middle[:, None] - middle) < ring * half[:, None] + NEIGHBOUR * half

    others = ~jnp.eye(len(well_seen), dtype=bool) & well_seen
    met = meet(boxes.x_middle, boxes.x_half) & meet(boxes.y_middle, boxes.y_half) & boxes.in_front
    whole = within(boxes.x_middle, boxes.x_half, width_px) & within(boxes.y_middle, boxes.y_half, height_px)
    return whole & boxes.in_front & ~(met & others[..., None]).any(axis=1) & well_seen[:, None]


def _fit_lengths(
    design: Float[Array, "drones cameras 2 2"],
    squares: Float[Array, "drones cameras 2"],
    counts: Bool[Array, "drones cameras"],
) -> tuple[Float[Array, "drones 2"], Float[Array, "drones 2"]]:
    """Squared horizontal and vertical lengths by least squares that outlying views influence little.

    Returns:
        (drones, 2), the squared lengths as factors of the present squared lengths; and (drones, 2), the share of each
        length that comes from the views and not from the present size.
    """
    counting = jnp.broadcast_to(counts[..., None], squares.shape).astype(jnp.float32)

    def solved(weight: Array) -> tuple[Array, Array]:
        weighted = weight[..., None] * design
        normal = jnp.einsum("dcki,dckj->dij", weighted, design) + PRIOR_VIEWS * jnp.eye(2)
        right = jnp.einsum("dcki,dck->di", weighted, squares) + PRIOR_VIEWS
        cross, other = normal[:, :1, 1], jnp.stack([normal[:, 1, 1], normal[:, 0, 0]], axis=-1)
        inverse = other / (other[:, :1] * other[:, 1:] - jnp.square(cross))
        factors = inverse * (right - cross * right[:, ::-1] / other)
        return factors, 1 - PRIOR_VIEWS * inverse

    factors, share = solved(counting)
    for _ in range(REWEIGHTINGS):
        residual = squares - jnp.einsum("dcki,di->dck", design, factors)
        factors, share = solved(counting / (1 + jnp.square(residual / VIEW_STD)))
    return factors, share
