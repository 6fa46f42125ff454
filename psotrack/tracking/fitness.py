"""The soft IoU of boxes against silhouettes: how well positions of drones explain what the cameras see.

For one drone in one camera, with its box scaled about its middle by s (a window) and a larger ring that holds what
foreground there is around it:

    IoU_s = F_s / (A_s + F_ring - F_s)        score = mean over windows of IoU_s

F is foreground and A is area, both inside the image and without the foreground that another drone claims: whether that
is this drone's nobody knows. Foreground in the ring that the window leaves
unexplained makes the union larger.

One window at s = 1 is the paper's overlap of box and silhouette: a plateau, because every box that holds the whole
silhouette scores the same. Concentric windows, some smaller than the silhouette, have their maximum where the
silhouette's middle is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from jaxtyping import Float

from psotrack._typing import Array, Tables
from psotrack.geometry import Boxes, Camera, Extents, make_extents, project_boxes
from psotrack.silhouettes import box_sum, of_packed_box_sums
from psotrack.tracking.patches import FULL, Patches, whole_images

#: So much of a window's area counts in any case: little that agrees, where nearly all is claimed, is no full agreement.
LEAST_AREA = 0.7
#: A camera that counts less does not see the drone.
MIN_WEIGHT = 0.1


@dataclass(frozen=True)
class ScoreSettings:
    """What is compiled in.

    Attributes:
        windows: scales of the box that are compared with the foreground.
        ring: scale of the box that bounds the foreground which belongs to the drone.
        whole_pixels: round edges to whole pixels of the reduced silhouettes, as the paper's hard score does.
        reduction: image pixels per silhouette pixel, along each side.
        min_cameras: a drone that fewer cameras see has no score.
    """

    windows: tuple[float, ...] = (0.4, 0.7, 1.0)
    ring: float = 1.5
    whole_pixels: bool = False
    reduction: int = 4
    min_cameras: int = 2


#: The baseline: one box with edges on whole pixels, as in the paper.
PAPER_SCORE = ScoreSettings(windows=(1.0,), whole_pixels=True)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ScoreInputs:
    """What the score of one frame reads.

    Attributes:
        extents: of the drones in the cameras.
        patches: the frame's silhouettes about the drones.
        settings: static.
    """

    extents: Extents
    patches: Patches
    settings: ScoreSettings = field(metadata={"static": True})


def score_inputs(
    cameras: Camera,
    size_m: Float[Array, "drones 3"],
    tables: Tables,
    settings: ScoreSettings,
    offset_m: Float[Array, "drones 3"] | None = None,
) -> ScoreInputs:
    """The scene of one frame, all of its images, for drones of these sizes and offsets (see `boxes.extents`)."""
    return ScoreInputs(
        make_extents(cameras, size_m, offset_m), whole_images(tables, settings.reduction), settings
    )


def camera_scores(
    score_inputs: ScoreInputs, position_m: Float[Array, "*batch drones 3"]
) -> tuple[Float[Array, "*batch drones cameras"], Float[Array, "*batch drones cameras"]]:
    """Soft IoU of every drone in every camera, and how much each camera counts.

    Args:
        score_inputs: of one frame, for as many drones.
        position_m: (..., drones, 3), world.

    Returns:
        Scores in [0, 1]; and weights: the share of the drone's box that lies inside the image (0 behind the camera),
        times the share that no other drone claims.
    """
    boxes = project_boxes(score_inputs.extents, position_m)
    in_ring = _of_windows(
        score_inputs, boxes, (score_inputs.settings.ring,), lambda foreground, area: foreground
    )[0]

    def iou(foreground: Array, area: Array) -> Array:
        # The inner maximum is for rounding alone: a window may hold a hair more than the ring.
        return foreground / jnp.maximum(area + jnp.maximum(in_ring - foreground, 0.0), 1e-6)

    score = _of_windows(score_inputs, boxes, score_inputs.settings.windows, iou).mean(axis=0)
    return score, score_inputs.patches.clear * _share_in_image(score_inputs, boxes)


def filled(
    score_inputs: ScoreInputs, position_m: Float[Array, "*batch drones 3"]
) -> Float[Array, "*batch drones cameras"]:
    """Share of every drone's box that is foreground; 0 where most of the box is outside the image."""
    boxes = project_boxes(score_inputs.extents, position_m)
    share = _of_windows(
        score_inputs, boxes, (1.0,), lambda foreground, area: foreground / jnp.maximum(area, 1e-6)
    )
    return jnp.where(_share_in_image(score_inputs, boxes) > 0.5, share[0], 0.0)


def drone_fitness(
    score_inputs: ScoreInputs, position_m: Float[Array, "*batch drones 3"]
) -> Float[Array, "*batch drones"]:
    """Fitness of each drone: the mean of its scores over the cameras that see it; NaN where too few do.

    A camera counts by the share of the box that its image holds, so that the fitness stays continuous at the border,
    and by the share that is clear of other drones. Cameras that hardly count do not see it; nor do many that each
    count for little, if together they are less than half of the least number.
    """
    score, weight = camera_scores(score_inputs, position_m)
    total = weight.sum(axis=-1)
    mean = (weight * score).sum(axis=-1) / jnp.maximum(total, 1e-6)
    least = score_inputs.settings.min_cameras
    enough = ((weight > MIN_WEIGHT).sum(axis=-1) >= least) & (total > least / 2)
    return jnp.where(enough, mean, jnp.nan)


def joint_fitness(
    score_inputs: ScoreInputs, position_m: Float[Array, "*batch drones 3"]
) -> Float[Array, "*batch"]:
    """Mean fitness over all drones, the paper's. A drone without a score counts 0: losing one is no gain."""
    return jnp.nan_to_num(drone_fitness(score_inputs, position_m)).mean(axis=-1)


def _of_windows(
    score_inputs: ScoreInputs, boxes: Boxes, scales: tuple[float, ...], then: Callable[[Array, Array], Array]
) -> Float[Array, "scales *batch"]:
    """What follows from foreground and area of the boxes scaled about their middles and cut at the image.

    Both are in pixels of the patches, without the foreground that is claimed.
    """
    patches = score_inputs.patches

    def interval(middle: Array, half: Array, length_px: int, first_px: Array) -> tuple[Array, Array]:
        half = jnp.asarray(scales, half.dtype).reshape(-1, *[1] * half.ndim) * half
        ends = [jnp.clip(end, 0, length_px) for end in (middle - half, middle + half)]
        if score_inputs.settings.whole_pixels:
            # Of the silhouettes as they are, however coarse the window is.
            ends = [
                score_inputs.settings.reduction * jnp.round(end / score_inputs.settings.reduction)
                for end in ends
            ]
        low, high = ((end - first_px) / patches.pixel_px for end in ends)
        return low, high

    x0, x1 = interval(boxes.x_middle, boxes.x_half, patches.size_wh_px[0], patches.x_px)
    y0, y1 = interval(boxes.y_middle, boxes.y_half, patches.size_wh_px[1], patches.y_px)
    area = (x1 - x0) * (y1 - y0)
    if not patches.packed:
        return then(box_sum(patches.tables, patches.number, x0, y0, x1, y1) / FULL, area)

    def of_sums(foreground: Array, claimed: Array, area: Array) -> Array:
        return then(foreground / FULL, jnp.maximum(area - claimed, LEAST_AREA * area))

    return of_packed_box_sums(of_sums, patches.tables, patches.number, x0, y0, x1, y1, area)


def _share_in_image(score_inputs: ScoreInputs, boxes: Boxes) -> Float[Array, "*batch drones cameras"]:
    width_px, height_px = score_inputs.patches.size_wh_px

    def inside(middle: Array, half: Array, length_px: int) -> Array:
        return jnp.clip(middle + half, 0, length_px) - jnp.clip(middle - half, 0, length_px)

    area = inside(boxes.x_middle, boxes.x_half, width_px) * inside(boxes.y_middle, boxes.y_half, height_px)
    whole = 4 * boxes.x_half * boxes.y_half
    return jnp.where(boxes.in_front, area / jnp.maximum(whole, 1e-6), 0.0)
