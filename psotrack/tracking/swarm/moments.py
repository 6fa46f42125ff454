"""What each camera alone shows of a drone: the middle of its foreground, and how large it is.

Both follow from the moments of the foreground in the ring about the drone's box, in the windows that the score reads.
The tracker's position is what all cameras agree on: how far a middle is from the projection of this position shows the
errors of the camera. The variance of a filled ellipse along a direction is a quarter of the squared half length (M. R.
Teague, Image analysis via the general theory of moments, JOSA 70(8), 1980).
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from psotrack.geometry import Boxes, Extents
from psotrack.support.array_types import Array, Positions
from psotrack.tracking.swarm.patches import FULL, SIDE, Windows

#: Half length over the standard deviation of the foreground: 2 for an ellipse, the square root of 6 for a rhombus.
#: Drones, whose arms end in points and whose rotors are widest, lie between the two.
HALF_PER_STD = 2.2
#: Scale of a neighbour's ellipse within which the neighbour may have foreground: outlines are no ellipses.
NEIGHBOUR = 1.15
#: A side of a box shows the drone's width if at most the first share of its squared length comes from the drone's
#: height, and shows the height if at least the second share does.
_OF_WIDTH, _OF_HEIGHT = 0.1, 0.3
#: Number of times that the foreground is measured: the ring follows the foreground that it holds.
_MOVES = 3
#: Least number of cameras that show the drone whole and clear, for its size to count.
_LEAST_VIEWS = 2


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Seen:
    """What the cameras show of the drones in one frame.

    Attributes:
        box_px: (drones, cameras, 4), see `Rows`.
        middle_px: (drones, cameras, 2), see `Rows`.
        size_ratio: (drones, 3), full lengths that the frame shows, as multiples of the lengths of the boxes; NaN where
            too few cameras show them.
    """

    box_px: Float[Array, "drones cameras 4"]
    middle_px: Float[Array, "drones cameras 2"]
    size_ratio: Positions


def measure(
    windows: Windows,
    boxes: Boxes,
    extents: Extents,
    *,
    ring: float,
    least_filled: float,
    known: Bool[Array, "drones"],
) -> Seen:
    """Middles and sizes of the drones' foreground in one frame.

    Args:
        windows: the pixels about the drones, whatever other drones may cover.
        boxes: boxes of the drones.
        extents: the drones' extents in the cameras.
        ring: scale of the box that bounds the foreground which belongs to the drone.
        least_filled: least share of the box that must be foreground in a camera that counts.
        known: (drones,), whether the drone is where its box is.
    """
    half_px = jnp.stack([boxes.x_half, boxes.y_half], axis=-1)
    at_px = jnp.stack([boxes.x_middle, boxes.y_middle], axis=-1)
    middle_px, spread, filled = _moments(windows, at_px, half_px, ring)
    counts = _alone_and_whole(boxes, windows, ring, known) & (filled >= least_filled)
    width_px, height_px = windows.size_wh_px
    inside = (boxes.x_middle >= 0) & (boxes.x_middle <= width_px) & boxes.in_front & known[:, None]
    inside &= (boxes.y_middle >= 0) & (boxes.y_middle <= height_px)
    return Seen(
        box_px=jnp.where(inside[..., None], jnp.concatenate([at_px, half_px], axis=-1), jnp.nan),
        # Pixel centres are at whole numbers, edges of boxes between pixels.
        middle_px=jnp.where(counts[..., None], middle_px - 0.5, jnp.nan),
        size_ratio=_size_ratio(extents, HALF_PER_STD**2 * spread, counts),
    )


def _moments(
    windows: Windows,
    at_px: Float[Array, "drones cameras 2"],
    half_px: Float[Array, "drones cameras 2"],
    ring: float,
) -> tuple[
    Float[Array, "drones cameras 2"], Float[Array, "drones cameras 2"], Float[Array, "drones cameras"]
]:
    """Middle of the foreground in the ring, its variances in squared half lengths, and its share of the box."""
    image = windows.value.astype(jnp.float32) / FULL
    axes_px = jnp.stack(windows.middles_px, axis=2)
    pixel_px = windows.pixel_px[..., None]
    total = off_px = square_px2 = jnp.zeros_like(at_px)
    for _ in range(_MOVES):
        centre_px = at_px + off_px
        to_edge = (ring * half_px[..., None] - jnp.abs(axes_px - centre_px[..., None])) / pixel_px[..., None]
        inside = jnp.clip(to_edge + 0.5, 0, 1)
        across = jnp.einsum("dcij,dci->dcj", image, inside[:, :, 1]) * inside[:, :, 0]
        down = jnp.einsum("dcij,dcj->dci", image, inside[:, :, 0]) * inside[:, :, 1]
        mass, way_px = jnp.stack([across, down], axis=2), axes_px - at_px[..., None]
        total = mass.sum(axis=-1)
        least = jnp.maximum(total, 1e-6)
        off_px, square_px2 = (
            (mass * way_px).sum(axis=-1) / least,
            (mass * jnp.square(way_px)).sum(axis=-1) / least,
        )
    # Sheppard's correction for the width of a pixel.
    variance_px2 = square_px2 - jnp.square(off_px) - jnp.square(pixel_px) / 12
    area = 4 * half_px.prod(axis=-1) / jnp.square(windows.pixel_px)
    return at_px + off_px, variance_px2 / jnp.square(half_px), total[..., 0] / jnp.maximum(area, 1e-6)


def _size_ratio(
    extents: Extents, square: Float[Array, "drones cameras 2"], counts: Bool[Array, "drones cameras"]
) -> Positions:
    """Lengths of the drones from the squared lengths of their boxes' sides, both as multiples of those expected.

    The squared side of a box is nearly linear in the squared lengths of the ellipsoid (Hartley & Zisserman 2004,
    section 8.3). Sides to which the height contributes little give the width, which is the same along x and y, because
    drones turn; the other sides then give the height.
    """
    rotation, height_m2 = extents.rotation, jnp.square(extents.size_m[:, 2, None] / 2)
    of_height = jnp.stack(
        [
            jnp.square(rotation[2]) * height_m2 / extents.s_xx,
            jnp.square(rotation[5]) * height_m2 / extents.s_yy,
        ],
        axis=-1,
    )
    counts = counts[..., None] & (square > 0)

    def median(values: Array, of: Array) -> Array:
        values = jnp.where(of, values, jnp.nan).reshape(len(values), -1)
        enough = of.any(axis=-1).sum(axis=-1) >= _LEAST_VIEWS
        return jnp.where(enough, jnp.nanmedian(values, axis=-1), jnp.nan)

    width = median(square, counts & (of_height <= _OF_WIDTH))
    rest = (square - (1 - of_height) * width[:, None, None]) / jnp.maximum(of_height, _OF_HEIGHT)
    height = median(rest, counts & (of_height >= _OF_HEIGHT))
    squares = jnp.stack([width, width, height], axis=-1)
    return jnp.sqrt(jnp.where(squares > 0, squares, jnp.nan))


def _alone_and_whole(
    boxes: Boxes, windows: Windows, ring: float, known: Bool[Array, "drones"]
) -> Bool[Array, "drones cameras"]:
    """Which views show the drone alone and whole: the ring is inside image and window, and no other drone is in it."""
    width_px, height_px = windows.size_wh_px
    window_px = SIDE * windows.pixel_px

    def within(middle: Array, half: Array, length_px: Array, first_px: Array) -> Array:
        low, high = middle - ring * half, middle + ring * half
        in_image = (low >= 0) & (high <= length_px)
        return in_image & (low >= first_px) & (high <= first_px + window_px)

    def meet(middle: Array, half: Array) -> Array:
        return jnp.abs(middle[:, None] - middle) < ring * half[:, None] + NEIGHBOUR * half

    others = ~jnp.eye(len(known), dtype=bool) & known
    met = meet(boxes.x_middle, boxes.x_half) & meet(boxes.y_middle, boxes.y_half) & boxes.in_front
    whole = within(boxes.x_middle, boxes.x_half, width_px, windows.x_px)
    whole &= within(boxes.y_middle, boxes.y_half, height_px, windows.y_px)
    return whole & boxes.in_front & ~(met & others[..., None]).any(axis=1) & known[:, None]
