"""The score: how well positions of drones explain the silhouettes of all cameras, as a soft IoU of boxes.

For one drone in one camera, with the drone's box scaled about its middle by s (a window), and a larger ring that bounds
the foreground around the drone:

    IoU_s = F_s / (A_s + F_ring - F_s)        score = mean over windows of IoU_s

F is foreground and A is area, both inside the image and without the foreground that another drone may cover. Foreground
in the ring that the window does not contain makes the union larger.

One window at s = 1 is the paper's overlap of box and silhouette. That score is a plateau, because every box that holds
the whole silhouette has the same score. Concentric windows, of which some are smaller than the silhouette, have their
maximum where the silhouette's middle is.

`Score` is the interface of a camera's score, `SoftIoU` the score of this package. Another score is any frozen, hashable
object with the same attributes and method: given to `psotrack.track(..., score=...)`, or by name as a plugin (see
`psotrack.support.plugins`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import reduce
from operator import add
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from psotrack.foreground.silhouettes import box_sum, packed_box_sums
from psotrack.geometry import Boxes, Camera, Extents, make_extents, project_boxes
from psotrack.support.array_types import Array, Tables
from psotrack.tracking.swarm.patches import FULL, Patches, whole_images

#: A window's area counts with at least this share of itself, so that a little foreground in a window that other drones
#: cover nearly completely is no full agreement.
LEAST_AREA = 0.7
#: A camera of smaller weight does not see the drone.
MIN_WEIGHT = 0.1


@runtime_checkable
class Score(Protocol):
    """The score of positions in single cameras.

    The score is compiled in: it must be frozen and hashable, for example a frozen dataclass of plain numbers, and its
    method is called inside a compiled function (`jax.jit`), so it consists of JAX operations without branches on
    values. Two equal scores share one compiled program.

    Attributes:
        ring: scale of the largest box about a drone's position that the score reads, at least 1. Only the part of the
            silhouettes inside this box (and where the search may move it) is at hand.
        whole_pixels: whether edges of boxes are rounded to whole pixels of the reduced silhouettes.
        min_cameras: a drone that fewer cameras see has no fitness (NaN).
    """

    @property
    def ring(self) -> float: ...  # noqa: D102

    @property
    def whole_pixels(self) -> bool: ...  # noqa: D102

    @property
    def min_cameras(self) -> int: ...  # noqa: D102

    def camera_scores(
        self, inputs: ScoreInputs, position_m: Float[Array, "*batch drones 3"]
    ) -> tuple[Float[Array, "*batch drones cameras"], Float[Array, "*batch drones cameras"]]:
        """Scores in [0, 1] of every drone in every camera, and the weight of each camera in [0, 1].

        The fitness of a drone is the mean of its scores, weighted by these weights (see `drone_fitness`). The tracker
        also fits a paraboloid through the scores, so a score that changes smoothly gives better positions. For the
        search before it, `psotrack.tracking.swarm.foreground_and_area` rounds the edges of boxes to the pixels that it
        reads.

        Args:
            inputs: extents of the drones and silhouettes of one frame. `psotrack.geometry.project_boxes` gives the
                drones' boxes, `psotrack.tracking.swarm.foreground_and_area` the foreground in scaled boxes, and
                `psotrack.tracking.swarm.camera_weights` the usual weights.
            position_m: (..., drones, 3), positions in the world, metres, float32; the leading axes are particles.

        Returns:
            Scores (..., drones, cameras), finite, larger is better; weights of the same shape, 0 where the camera does
            not see the drone.
        """
        ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ScoreInputs:
    """What a score reads of one frame.

    Attributes:
        extents: extents of the drones in the cameras.
        patches: the frame's silhouettes about the drones.
        score: the score; static.
    """

    extents: Extents
    patches: Patches
    score: Score = field(metadata={"static": True})


@dataclass(frozen=True)
class SoftIoU:
    """The mean soft IoU over concentric windows (see the module).

    Attributes:
        windows: scales of the box that are compared with the foreground.
        ring: scale of the box that bounds the foreground which belongs to the drone.
        whole_pixels: whether edges are rounded to whole pixels of the reduced silhouettes, as in the paper.
        min_cameras: a drone that fewer cameras see has no fitness.
    """

    windows: tuple[float, ...] = (0.4, 0.7, 1.0)
    ring: float = 1.5
    whole_pixels: bool = False
    min_cameras: int = 2

    def camera_scores(
        self, inputs: ScoreInputs, position_m: Float[Array, "*batch drones 3"]
    ) -> tuple[Float[Array, "*batch drones cameras"], Float[Array, "*batch drones cameras"]]:
        """See `Score`."""
        return self.box_scores(inputs, project_boxes(inputs.extents, position_m))

    def box_scores(
        self, inputs: ScoreInputs, boxes: Boxes
    ) -> tuple[Float[Array, "*batch cameras"], Float[Array, "*batch cameras"]]:
        """The scores and weights of positions, from the drones' boxes there."""
        patches, rounded = inputs.patches, self.whole_pixels
        in_ring, _ = _foreground_and_area(patches, boxes, self.ring, rounded)

        def iou(scale: float) -> Array:
            foreground, area = _foreground_and_area(patches, boxes, scale, rounded)
            # Rounding alone can make the foreground of a window larger than that of the ring.
            return foreground / jnp.maximum(area + jnp.maximum(in_ring - foreground, 0.0), 1e-6)

        score = reduce(add, map(iou, self.windows)) / len(self.windows)
        return score, camera_weights(inputs, boxes)


#: The paper's score: one box with edges on whole pixels.
PAPER_SCORE = SoftIoU(windows=(1.0,), whole_pixels=True)


def score_inputs(
    cameras: Camera,
    size_m: Float[Array, "drones 3"],
    tables: Tables,
    score: Score,
    *,
    reduction: int,
    offset_m: Float[Array, "drones 3"] | None = None,
) -> ScoreInputs:
    """What the score reads of the whole images of one frame.

    Args:
        cameras: cameras with one leading axis.
        size_m: (drones, 3), full lengths of the drones, metres.
        tables: (height + 1, cameras, width + 1), summed-area tables of the silhouettes.
        score: the score.
        reduction: image pixels per silhouette pixel, along each side.
        offset_m: (drones, 3), from each drone's position to the middle of its extent (see `make_extents`).
    """
    return ScoreInputs(make_extents(cameras, size_m, offset_m), whole_images(tables, reduction), score)


def foreground_and_area(
    inputs: ScoreInputs, boxes: Boxes, scales: tuple[float, ...]
) -> tuple[Float[Array, "scales *batch"], Float[Array, "scales *batch"]]:
    """Foreground in boxes that are scaled about their middles, and the area of these boxes, in pixels of the patches.

    Both are cut at the image's border, and without the foreground that another drone may cover.
    """
    patches, rounded = inputs.patches, inputs.score.whole_pixels
    of_scales = [_foreground_and_area(patches, boxes, scale, rounded) for scale in scales]
    foreground, area = (jnp.stack(values) for values in zip(*of_scales, strict=True))
    return foreground, area


def camera_weights(inputs: ScoreInputs, boxes: Boxes) -> Float[Array, "*batch drones cameras"]:
    """Weight of each camera: the share of the box inside the image (0 behind the camera) times its unoccluded share."""
    return inputs.patches.clear * _share_in_image(inputs.patches, boxes)


def camera_scores(
    inputs: ScoreInputs, position_m: Float[Array, "*batch drones 3"]
) -> tuple[Float[Array, "*batch drones cameras"], Float[Array, "*batch drones cameras"]]:
    """Scores in [0, 1] of every drone in every camera, and the weight of each camera, as `inputs.score` defines them.

    Args:
        inputs: silhouettes and extents of one frame.
        position_m: (..., drones, 3), positions of the drones, world, metres.
    """
    return inputs.score.camera_scores(inputs, position_m)


def filled_share(
    inputs: ScoreInputs, position_m: Float[Array, "*batch drones 3"]
) -> Float[Array, "*batch drones cameras"]:
    """Share of every drone's box that is foreground; 0 where most of the box is outside the image."""
    boxes = project_boxes(inputs.extents, position_m)
    foreground, area = _foreground_and_area(inputs.patches, boxes, 1.0, inputs.score.whole_pixels)
    share = foreground / jnp.maximum(area, 1e-6)
    return jnp.where(_share_in_image(inputs.patches, boxes) > 0.5, share, 0.0)


def drone_fitness(
    inputs: ScoreInputs, position_m: Float[Array, "*batch drones 3"]
) -> Float[Array, "*batch drones"]:
    """Fitness of each drone: the weighted mean of its scores over the cameras; NaN where too few cameras see it.

    A camera's weight is the share of the box inside the image, so that the fitness is continuous at the border, times
    the share that is clear of other drones. A camera of less weight than `MIN_WEIGHT` does not see the drone. Neither
    do several cameras of small weight, if the sum of their weights is less than half of the least number of cameras.
    """
    return weighted_fitness(*camera_scores(inputs, position_m), inputs.score.min_cameras)


def weighted_fitness(
    score: Float[Array, "*batch cameras"], weight: Float[Array, "*batch cameras"], least: int
) -> Float[Array, "*batch"]:
    """`drone_fitness` from the scores and weights of the cameras, of which at least `least` must see the drone."""
    total = weight.sum(axis=-1)
    # XLA on a CPU gives a sum of 4,096 numbers or more to a library (YNNPACK), together with the multiplications and
    # additions that come before the sum. The rest of the score is then computed again for each read of a table, which
    # takes up to ten times as long. The library computes no choices: this one keeps the score in one piece.
    weighted = jnp.where(weight > 0, weight * score, 0.0)
    mean = weighted.sum(axis=-1) / jnp.maximum(total, 1e-6)
    enough = ((weight > MIN_WEIGHT).sum(axis=-1) >= least) & (total > least / 2)
    return jnp.where(enough, mean, jnp.nan)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DroneFitness:
    """The objective of one search per drone: `drone_fitness` of the inputs."""

    inputs: ScoreInputs

    def __call__(self, position_m: Float[Array, "*batch drones 3"]) -> Float[Array, "*batch drones"]:
        """Fitness of each drone."""
        return drone_fitness(self.inputs, position_m)


def joint_fitness(
    inputs: ScoreInputs,
    position_m: Float[Array, "*batch drones 3"],
    present: Bool[Array, "drones"] | None = None,
) -> Float[Array, "*batch"]:
    """Mean fitness over all drones, as in the paper. A drone without fitness counts 0: losing a drone gains nothing.

    Args:
        inputs: silhouettes and extents of one frame.
        position_m: (..., drones, 3), positions of the drones, world, metres.
        present: (drones,), the drones that count; None counts all.
    """
    fitness = jnp.nan_to_num(drone_fitness(inputs, position_m))
    if present is None:
        return fitness.mean(axis=-1)
    return jnp.where(present, fitness, 0.0).sum(axis=-1) / jnp.maximum(present.sum().astype(jnp.float32), 1.0)


def _foreground_and_area(
    patches: Patches, boxes: Boxes, scale: float, whole_pixels: bool = False
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Foreground in the boxes scaled about their middles and cut at the image, and the area of these boxes.

    Both are in pixels of the patches, without the foreground that other drones may cover. Several scales are several
    calls: with an axis of scales, XLA on a CPU computes each place in the tables again for each of its sixteen reads.
    """

    def interval(middle: Array, half: Array, length_px: Array, first_px: Array) -> tuple[Array, Array]:
        ends = [jnp.clip(end, 0, length_px) for end in (middle - scale * half, middle + scale * half)]
        if whole_pixels:
            # Whole pixels of the silhouettes, however coarse the window is.
            ends = [patches.reduction * jnp.round(end / patches.reduction) for end in ends]
        low, high = ((end - first_px) / patches.pixel_px for end in ends)
        return (_whole(low), _whole(high)) if patches.whole_cells else (low, high)

    x0, x1 = interval(boxes.x_middle, boxes.x_half, patches.size_wh_px[0], patches.x_px)
    y0, y1 = interval(boxes.y_middle, boxes.y_half, patches.size_wh_px[1], patches.y_px)
    area = ((x1 - x0) * (y1 - y0)).astype(boxes.x_middle.dtype)
    if not patches.packed:
        return box_sum(patches.tables, patches.number, x0, y0, x1, y1) / FULL, area
    foreground, occluded = packed_box_sums(patches.tables, patches.number, x0, y0, x1, y1)
    return foreground / FULL, jnp.maximum(area - occluded, LEAST_AREA * area)


def _whole(edge: Array) -> Array:
    return jnp.round(edge).astype(jnp.int32)


def _share_in_image(patches: Patches, boxes: Boxes) -> Float[Array, "*batch drones cameras"]:
    width_px, height_px = patches.size_wh_px

    def inside(middle: Array, half: Array, length_px: Array) -> Array:
        return jnp.clip(middle + half, 0, length_px) - jnp.clip(middle - half, 0, length_px)

    area = inside(boxes.x_middle, boxes.x_half, width_px) * inside(boxes.y_middle, boxes.y_half, height_px)
    whole = 4 * boxes.x_half * boxes.y_half
    return jnp.where(boxes.in_front, area / jnp.maximum(whole, 1e-6), 0.0)
