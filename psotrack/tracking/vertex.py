"""Where exactly a drone is, and how far off that may be: a paraboloid through the score about the best position.

The score is made of pixels, and its maximum is a corner of a rugged top: off by a third of the width over which the
score falls off smoothly. The vertex of the paraboloid that fits the score best on a grid of 27 places about it
is not: it uses the slopes on all sides. The same paraboloids, one per camera, tell how sure it is. Each camera's hill,
weighted as the fitness weighs it, has a slope at the common vertex, by which it would move the drone, and a curvature,
by which it insists; along its ray it is flat. For an estimate that maximises a sum of such terms the covariance is

    C = phi H^-1,      H = -sum of the cameras' curvatures,      phi = sum of slope^T H^-1 slope over the cameras / 3,

the sandwich of H. White (1982), Econometrica 50(1), its filling taken to be of the same shape as H, as in
quasi-likelihood (McCullagh & Nelder 1989, chapter 9).
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from psotrack._typing import Array, Positions
from psotrack.tracking.fitness import ScoreInputs, camera_scores

#: Half of the grid, in parts of the drone's size. From 0.12 to 0.3 the errors are the same within a tenth.
SPAN = 0.2
#: Of the largest curvature: what is flatter, or bent the wrong way, counts as this flat.
FLATTEST = 0.02

#: Corners, edges, faces and the middle of a cube of side 2.
_CUBE = np.stack(np.meshgrid(*[(-1.0, 0.0, 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
_MIDDLE = len(_CUBE) // 2


def _least_squares() -> tuple[np.ndarray, np.ndarray]:
    """From 27 values on the cube to the slope (3, 27) and curvature (3, 3, 27) of the best paraboloid."""
    pairs = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
    products = np.stack([_CUBE[:, i] * _CUBE[:, j] for i, j in pairs], axis=-1)
    solve = np.linalg.pinv(np.concatenate([np.ones((len(_CUBE), 1)), _CUBE, products], axis=-1))
    curvature = np.zeros((3, 3, len(_CUBE)))
    for (i, j), row in zip(pairs, solve[4:], strict=True):
        curvature[i, j] += row
        curvature[j, i] += row
    return solve[1:4], curvature


_SLOPE, _CURVATURE = _least_squares()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Vertex:
    """The vertex of the score, and how sharp it is.

    Attributes:
        position_m: (drones, 3), the vertex; no farther from where it was sought than the grid.
        inverse_curvature_m2: (drones, 3, 3), H^-1: symmetric and positive definite.
        dispersion: (drones,), phi of this frame; infinite where no more than one camera has a say.
    """

    position_m: Positions
    inverse_curvature_m2: Float[Array, "drones 3 3"]
    dispersion: Float[Array, "drones"]


def find_vertex(scene: ScoreInputs, position_m: Positions, size_m: Positions) -> Vertex:
    """The paraboloid through the scores about the best positions.

    Args:
        scene: of the frame.
        position_m: (drones, 3), where the fitness is largest.
        size_m: (drones, 3), full lengths.
    """
    # In units of the span all three axes are alike, and flat is flat.
    span_m = SPAN * size_m
    score, weight = camera_scores(scene, position_m + span_m * jnp.asarray(_CUBE, span_m.dtype)[:, None, :])
    weight = weight[_MIDDLE]
    share = weight / jnp.maximum(weight.sum(axis=-1, keepdims=True), 1e-6)
    slope = jnp.einsum("ik,kdc,dc->dci", jnp.asarray(_SLOPE, score.dtype), score, share)
    curvature = -jnp.einsum("ijk,kdc,dc->dcij", jnp.asarray(_CURVATURE, score.dtype), score, share)
    bent, axes = jnp.linalg.eigh(curvature.sum(axis=1))
    bent = jnp.maximum(bent, FLATTEST * jnp.maximum(bent[:, -1:], 1e-6))
    inverse = jnp.einsum("dik,dk,djk->dij", axes, 1 / bent, axes)
    to_vertex = jnp.clip(jnp.einsum("dij,dj->di", inverse, slope.sum(axis=1)), -1.0, 1.0)
    # What each camera still wants when all have agreed.
    slope = slope - jnp.einsum("dcij,dj->dci", curvature, to_vertex)
    spread = jnp.einsum("dci,dij,dcj->d", slope, inverse, slope) / 3
    # Each camera measures two numbers and the position takes three: the residuals are smaller than the errors.
    cameras = jnp.square(share.sum(axis=-1)) / jnp.maximum(jnp.square(share).sum(axis=-1), 1e-6)
    spread = spread * cameras / jnp.maximum(cameras - 1.5, 0.1)
    return Vertex(
        position_m=position_m + span_m * to_vertex,
        inverse_curvature_m2=span_m[:, :, None] * inverse * span_m[:, None, :],
        dispersion=jnp.where(cameras > 1.5, spread, jnp.inf),
    )
