"""The floor of the swarm's time: the table look-ups that the score must do, and nothing else.

For each particle, iteration, drone and camera the score reads summed-area tables at the corners of several boxes: its
windows and the ring. A corner lies between pixels, so four neighbouring entries are read for it, sixteen for a box. The
floor reads the same number of entries, in the same tables and order, at the places of boxes of particles about the
drones, and adds them up. The places are known beforehand: projection, interpolation, score and swarm take no time.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from _peers import Problem

from psotrack.geometry import make_extents, project_boxes
from psotrack.tracking.swarm import SoftIoU, on_device
from psotrack.tracking.swarm.patches import ExpectedDrones, cut, make_pyramid
from psotrack.tracking.swarm.tracker import REACH_SIGMAS


class LookUps:
    """The look-ups of a number of frames."""

    def __init__(self, problem: Problem, silhouettes: np.ndarray) -> None:
        score, swarm = problem.score, problem.settings.swarm
        assert isinstance(score, SoftIoU)
        self._evaluations = swarm.iterations + 1
        middle = jnp.asarray(problem.start.position_m, jnp.float32)
        extents = make_extents(on_device(problem.rig.cameras), jnp.asarray(problem.start.size_m, jnp.float32))
        patches, _ = cut(
            jax.tree.map(lambda leaf: leaf[0], make_pyramid(jnp.asarray(silhouettes)[None])),
            extents,
            ExpectedDrones(middle, reach_m=jnp.full(len(middle), REACH_SIGMAS * swarm.spread_m)),
            reduction=problem.reduction,
            ring=score.ring,
        )
        generator = np.random.default_rng(0)
        spread = generator.normal(scale=swarm.spread_m, size=(swarm.particles, *middle.shape))
        boxes = project_boxes(extents, middle + spread.astype(np.float32))
        height1, windows, width1 = patches.tables.shape
        scales = jnp.asarray((*score.windows, score.ring)).reshape(-1, 1, 1, 1)

        def cells(
            middle_px: jax.Array, half_px: jax.Array, first_px: jax.Array, last: int
        ) -> list[jax.Array]:
            ends = (middle_px - scales * half_px, middle_px + scales * half_px)
            # One less than the last cell, because every other evaluation reads one column farther.
            return [
                jnp.clip((end - first_px) / patches.pixel_px, 0, last - 2).astype(jnp.int32) for end in ends
            ]

        columns = cells(boxes.x_middle, boxes.x_half, patches.x_px, width1 - 1)
        rows = cells(boxes.y_middle, boxes.y_half, patches.y_px, height1 - 1)
        self._row = windows * width1
        rows = [patches.number * width1 + row * self._row for row in rows]
        #: (boxes, particles, drones, cameras), index of the first of the four entries at each corner.
        self._corners = jnp.stack([row + column for row in rows for column in columns], axis=1)
        self._table = patches.tables.reshape(-1)
        self._run = jax.jit(self._read, static_argnames="frames")

    @property
    def per_frame(self) -> int:
        """Number of entries that are read per frame."""
        return 4 * self._corners.size * self._evaluations

    def __call__(self, frames: int) -> None:
        """Do the look-ups of some frames."""
        jax.block_until_ready(self._run(self._table, self._corners, frames=frames))

    def _read(self, table: jax.Array, corners: jax.Array, *, frames: int) -> jax.Array:
        def evaluation(number: jax.Array, total: jax.Array) -> jax.Array:
            # A place that depends on the evaluation, so that the compiler reads again each time.
            shift = number & 1

            def of_box(of_corner: jax.Array) -> jax.Array:
                read = jnp.zeros(of_corner.shape[1:], jnp.int32)
                for corner in of_corner:
                    for step in (0, 1, self._row, self._row + 1):
                        read += table.at[corner + (shift + step)].get(mode="promise_in_bounds")
                return read

            return total + jax.lax.map(of_box, corners).sum(axis=0)

        start = jnp.zeros(corners.shape[2:], jnp.int32)
        return jax.lax.fori_loop(0, frames * self._evaluations, evaluation, start)
