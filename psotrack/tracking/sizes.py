"""How large each drone is, learned while it flies.

A drone's size does not change, and the first frames, from which the initial size comes, may be poor. `measure_sizes`
measures the size that every frame shows, `learn_sizes` takes a chunk of such measurements into the running estimate.

What is measured is the spread of a silhouette about its own middle, so that it does not matter how well the drone is
placed. Of a filled ellipse the variance along a direction is a quarter of the squared half length (M. R. Teague, Image
analysis via the general theory of moments, JOSA 70(8), 1980), and the squared half lengths of an ellipsoid's outlines
are nearly linear in those of the ellipsoid (Hartley & Zisserman 2004, section 8.3): the views of a frame give level and
upright length by least squares. The two level lengths change together, because drones turn.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int, UInt8

from psotrack._typing import Array, Coverage, Positions
from psotrack.geometry import Boxes, Camera, make_extents, project_boxes
from psotrack.tracking.fitness import ScoreSettings
from psotrack.tracking.patches import FULL, Patches, cut
from psotrack.tracking.shadows import low

#: Half lengths per standard deviation of the foreground: 2 for an ellipse, the root of 6 for a rhombus. Drones, with
#: arms that end in points and rotors at their widest, are between.
HALF_PER_STD = 2.2
#: What a learned length may be at most, and one divided by it at least, of the start's.
RANGE = 2.0
#: A start counts as so many frames, and its lengths are off by so much, as a standard deviation of their logarithms.
START_FRAMES, START_STD = 5, 0.15
#: A chunk with fewer good frames says nothing: its median is not safe from bad ones.
MIN_FRAMES = 5
#: A camera in which less of the drone's box is foreground does not see it, or not all of it.
MIN_FILLED = 0.15
#: Neighbours reach so much farther than their ellipses: outlines are no ellipses.
NEIGHBOUR = 1.15
#: Squared lengths of single views scatter by this share, with yaw and tilt; views that are farther off count less.
VIEW_STD = 0.25
#: What is believed of a length counts as so much of a view that shows it alone. Of what comes out the frame's own views
#: must make up the second share, or the frame says too little.
BELIEVED_VIEWS, MIN_SHARE = 0.01, 0.9
#: How often views are weighed by how far off they are.
REWEIGHTINGS = 2


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SizeMeasurements:
    """What frames show, each by itself. NaN where a drone was not clearly seen.

    Attributes:
        size_m: (frames, drones, 3), full lengths along the world's axes. Of flat drones that are only seen from above
            the height is NaN alone.
        fill: (frames, drones, windows), share of each of the score's windows that is foreground, mean over the views.
    """

    size_m: Float[Array, "*frames drones 3"]
    fill: Float[Array, "*frames drones windows"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SizeState:
    """What is known of every drone's size.

    Attributes:
        start_m, size_m: (drones, 3), full lengths along the world's axes: first, and now.
        pinned: (drones, 3), lengths that stay as they are.
        num_frames, num_chunks: (drones, 3), from which each length was learned.
        scatter: (drones, 3), squared deviations of the chunks from their mean, of logarithms, times frames.
        fill: (drones, windows), the profile: how full each of the score's windows is; NaN before any frame.
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
        """(drones, 3), standard errors: from how far chunks scatter, because frames of one chunk are much alike."""
        weight = (self.num_frames + START_FRAMES) * (self.num_chunks + 1)
        std = self.size_m * jnp.sqrt(self.scatter / weight.astype(jnp.float32))
        return jnp.where(self.pinned, 0.0, std)


def init(size_m: Positions, pinned: Bool[Array, "drones 3"], settings: ScoreSettings) -> SizeState:
    """What is known before the first frame; where x or y is pinned, both are."""
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
        fill=jnp.full((size_m.shape[0], len(settings.windows)), jnp.nan, jnp.float32),
    )


def with_added_drones(state: SizeState, added: SizeState) -> SizeState:
    """The state with more drones at its end."""
    return jax.tree.map(lambda first, last: jnp.concatenate([first, last]), state, added)


@jax.jit
def learn_sizes(state: SizeState, looks: SizeMeasurements) -> SizeState:
    """The estimate with a chunk of frames in it.

    The chunk's median, which bad frames do not move as long as they are the fewer, enters a mean over all frames. So
    the estimate settles, and the start's part in it fades.
    """
    ratio = jnp.log(looks.size_m / state.size_m)
    frames = jnp.isfinite(ratio).sum(axis=0, dtype=jnp.int32)
    enough = frames >= MIN_FRAMES
    off = jnp.where(enough, jnp.nanmedian(ratio, axis=0), 0.0)
    new = jnp.where(enough, frames, 0).astype(jnp.float32)
    gain = new / (new + (START_FRAMES + state.num_frames).astype(jnp.float32))
    size_m = state.size_m * jnp.exp(gain * off)
    size_m = jnp.clip(size_m, state.start_m / RANGE, state.start_m * RANGE)

    # The profile has no start that would be worth anything.
    seen = state.num_frames[:, :1].astype(jnp.float32)
    fill_gain = new[:, :1] / jnp.maximum(new[:, :1] + seen, 1.0)
    before = jnp.where(seen > 0, state.fill, 0.0)
    fill = before + fill_gain * (jnp.nan_to_num(jnp.nanmedian(looks.fill, axis=0)) - before)
    return replace(
        state,
        size_m=jnp.where(state.pinned, state.size_m, size_m),
        num_frames=state.num_frames + jnp.where(enough, frames, 0),
        num_chunks=state.num_chunks + enough.astype(jnp.int32),
        scatter=state.scatter + new * (1 - gain) * jnp.square(off),
        fill=jnp.where(new[:, :1] + seen > 0, fill, jnp.nan),
    )


@partial(jax.jit, static_argnames="settings")
def measure_sizes(
    coverage: UInt8[Array, "frames cameras height width"],
    position_m: Float[Array, "frames drones 3"],
    well_seen: Bool[Array, "frames drones"],
    size_m: Positions,
    cameras: Camera,
    settings: ScoreSettings,
    floor_z_m: Float[Array, ""] | None = None,
) -> SizeMeasurements:
    """The size that every frame shows of every drone.

    A view counts if the drone's surroundings are within the image and clear of other drones; a frame, if two views do.

    Args:
        coverage: (frames, cameras, height, width), 0..255, silhouettes reduced by `settings.reduction`.
        position_m: (frames, drones, 3), world; any value where not well seen.
        well_seen: (frames, drones), whether a drone was found, and is there at all.
        size_m: (drones, 3), full lengths that are believed so far; within a factor of 1.5 or so they do not matter.
        cameras: with one leading axis.
        settings: of the score; of its windows the profile is taken.
        floor_z_m: height of the floor: what is low over it may have its shadow in its silhouette, and does not count.
    """

    def one(frame: tuple[Array, Array, Array]) -> SizeMeasurements:
        image, position, seen = frame
        return _look(
            image, jnp.where(seen[:, None], position, 0.0), seen, size_m, cameras, settings, floor_z_m
        )

    return jax.lax.map(one, (coverage, position_m, well_seen))


def _look(
    coverage: Coverage,
    position_m: Positions,
    well_seen: Bool[Array, "drones"],
    size_m: Positions,
    cameras: Camera,
    settings: ScoreSettings,
    floor_z_m: Float[Array, ""] | None,
) -> SizeMeasurements:
    """The look of one frame."""

    def boxes_of(factors: Float[Array, "2"]) -> Boxes:
        factor = jnp.sqrt(jnp.stack([factors[0], factors[0], factors[1]]))
        return project_boxes(make_extents(cameras, size_m * factor), position_m)

    def squares(factors: Float[Array, "2"]) -> Float[Array, "drones cameras 2"]:
        boxes = boxes_of(factors)
        return jnp.square(jnp.stack([boxes.x_half, boxes.y_half], axis=-1))

    same = jnp.ones(2)
    boxes, slope = boxes_of(same), jax.jacfwd(squares)(same)
    design = slope / slope.sum(axis=-1, keepdims=True)
    patches = cut(
        coverage,
        make_extents(cameras, size_m),
        position_m,
        reach_m=jnp.zeros_like(size_m[:, 0]),
        # Views in which a neighbour could claim anything do not count.
        claiming=None,
        reduction=settings.reduction,
        ring=settings.ring,
    )
    spread, fill, filled = _measured(patches, boxes, settings)
    counts = _counts(boxes, patches, settings.ring, well_seen) & (filled >= MIN_FILLED)
    if floor_z_m is not None:
        counts &= ~low(position_m, size_m, floor_z_m)[:, None]
    factors, share = _fitted(design, HALF_PER_STD**2 * spread, counts)
    good = (counts.sum(axis=-1) >= 2)[:, None] & (share >= MIN_SHARE) & (factors > 0)
    factors = jnp.where(good, jnp.sqrt(jnp.where(good, factors, 1.0)), jnp.nan)
    views = jnp.where(good[:, :1], counts.sum(axis=-1, keepdims=True).astype(jnp.float32), jnp.nan)
    return SizeMeasurements(
        size_m=size_m * jnp.stack([factors[:, 0], factors[:, 0], factors[:, 1]], axis=-1),
        fill=jnp.where(counts[..., None], fill, 0.0).sum(axis=1) / views,
    )


def _measured(
    patches: Patches, boxes: Boxes, settings: ScoreSettings
) -> tuple[
    Float[Array, "drones cameras 2"], Float[Array, "drones cameras windows"], Float[Array, "drones cameras"]
]:
    """Of the foreground in the ring: variances along columns and rows in squared halves of the box, how full each of
    the windows is, and the box itself."""
    image = jnp.diff(jnp.diff(patches.tables, axis=0), axis=2).transpose(1, 0, 2)
    image = image.reshape(*patches.x_px.shape, *image.shape[1:]).astype(jnp.float32) / FULL
    scales = jnp.asarray((*settings.windows, 1.0, settings.ring))

    def line(first_px: Array, middle_px: Array, half_px: Array) -> tuple[Array, Array, Array]:
        pixel = (patches.pixel_px / half_px)[..., None]
        cells = jnp.arange(image.shape[-1], dtype=jnp.float32) + 0.5
        at = ((first_px - middle_px) / half_px)[..., None] + cells * pixel
        inside = jnp.clip((scales[:, None] - jnp.abs(at[..., None, :])) / pixel[..., None] + 0.5, 0, 1)
        return at, inside, pixel

    x, x_inside, x_pixel = line(patches.x_px, boxes.x_middle, boxes.x_half)
    y, y_inside, y_pixel = line(patches.y_px, boxes.y_middle, boxes.y_half)
    sums = jnp.einsum("dcsi,dcij,dcsj->dcs", y_inside, image, x_inside)
    full = sums * x_pixel * y_pixel / jnp.square(2 * scales)

    def variance(of: Array, at: Array, pixel: Array) -> Array:
        of = of / jnp.maximum(of.sum(axis=-1, keepdims=True), 1e-6)
        middle = (of * at).sum(axis=-1, keepdims=True)
        # A pixel is as wide as it is: Sheppard's correction.
        return (of * jnp.square(at - middle)).sum(axis=-1) - jnp.square(pixel[..., 0]) / 12

    across = jnp.einsum("dci,dcij,dcj->dcj", y_inside[..., -1, :], image, x_inside[..., -1, :])
    down = jnp.einsum("dci,dcij,dcj->dci", y_inside[..., -1, :], image, x_inside[..., -1, :])
    spread = jnp.stack([variance(across, x, x_pixel), variance(down, y, y_pixel)], axis=-1)
    return spread, full[..., :-2], full[..., -2]


def _counts(
    boxes: Boxes, patches: Patches, ring: float, well_seen: Bool[Array, "drones"]
) -> Bool[Array, "drones cameras"]:
    """Which views show the drone alone and whole: the ring is within the image, and no other drone within the ring."""
    width_px, height_px = patches.size_wh_px

    def within(middle: Array, half: Array, length_px: int) -> Array:
        return (middle - ring * half >= 0) & (middle + ring * half <= length_px)

    def meet(middle: Array, half: Array) -> Array:
        return jnp.abs(middle[:, None] - middle) < ring * half[:, None] + NEIGHBOUR * half

    others = ~jnp.eye(len(well_seen), dtype=bool) & well_seen
    met = meet(boxes.x_middle, boxes.x_half) & meet(boxes.y_middle, boxes.y_half) & boxes.in_front
    whole = within(boxes.x_middle, boxes.x_half, width_px) & within(boxes.y_middle, boxes.y_half, height_px)
    return whole & boxes.in_front & ~(met & others[..., None]).any(axis=1) & well_seen[:, None]


def _fitted(
    design: Float[Array, "drones cameras 2 2"],
    squares: Float[Array, "drones cameras 2"],
    counts: Bool[Array, "drones cameras"],
) -> tuple[Float[Array, "drones 2"], Float[Array, "drones 2"]]:
    """Squared level and upright lengths, as factors of what they were taken for, by least squares that outlying views
    move little; and on what share of each the views have a say."""
    counting = jnp.broadcast_to(counts[..., None], squares.shape).astype(jnp.float32)

    def solved(weight: Array) -> tuple[Array, Array]:
        weighted = weight[..., None] * design
        normal = jnp.einsum("dcki,dckj->dij", weighted, design) + BELIEVED_VIEWS * jnp.eye(2)
        right = jnp.einsum("dcki,dck->di", weighted, squares) + BELIEVED_VIEWS
        cross, other = normal[:, :1, 1], jnp.stack([normal[:, 1, 1], normal[:, 0, 0]], axis=-1)
        inverse = other / (other[:, :1] * other[:, 1:] - jnp.square(cross))
        factors = inverse * (right - cross * right[:, ::-1] / other)
        return factors, 1 - BELIEVED_VIEWS * inverse

    factors, share = solved(counting)
    for _ in range(REWEIGHTINGS):
        residual = squares - jnp.einsum("dcki,di->dck", design, factors)
        factors, share = solved(counting / (1 + jnp.square(residual / VIEW_STD)))
    return factors, share
