"""The vertex of the score: a drone's position to millimetres and its covariance, from a paraboloid through the scores.

The score is made of pixels: its largest value is at a corner of a rugged top, and that corner is off by a third of the
width over which the score falls off smoothly. The vertex of the paraboloid that fits the scores best on a grid of 27
positions about the corner is better, because the paraboloid uses the slopes on all sides. The paraboloids of the single
cameras give the covariance. Each camera's paraboloid, weighted as in the fitness, has a slope at the common vertex (the
direction in which this camera alone would move the drone) and a curvature, which is zero along the camera's ray. For an
estimate that maximises a sum of such terms the covariance is

    C = phi H^-1,      H = -sum of the cameras' curvatures,      phi = sum of slope^T H^-1 slope over the cameras / 3,

the sandwich estimator of H. White (1982), Econometrica 50(1), with a middle matrix proportional to H, as in
quasi-likelihood (McCullagh & Nelder 1989, chapter 9).
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from psotrack.support.array_types import Array, Positions
from psotrack.tracking.swarm.fitness import ScoreInputs, camera_scores

#: Half width of the grid, as a share of the drone's size. From 0.12 to 0.3 the errors differ by less than a tenth.
SPAN = 0.2
#: Least curvature, as a share of the largest one: smaller and negative curvatures are replaced by this one. For the
#: covariance the limit is lower: cameras on one side know the depth of a drone thirty times worse than its direction.
FLATTEST, FLATTEST_OF_COVARIANCE = 0.02, 0.001

#: Corners, edges, faces and the middle of a cube of side 2.
_CUBE = np.stack(np.meshgrid(*[(-1.0, 0.0, 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
_MIDDLE = len(_CUBE) // 2


def _least_squares() -> tuple[np.ndarray, np.ndarray]:
    """Matrices that map 27 scores on the cube to slope (3, 27) and curvature (3, 3, 27) of the fitted paraboloid."""
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
    """The vertex of the score, and its sharpness.

    Attributes:
        position_m: (drones, 3), the vertex, metres; never outside of the grid.
        inverse_curvature_m2: (drones, 3, 3), H^-1: positive definite, and symmetric to rounding in float32.
        dispersion: (drones,), phi of this frame; infinite where no more than one camera sees the drone.
        camera_share: (drones, cameras), each camera's share of the weight; the shares of all cameras sum to 1.
    """

    position_m: Positions
    inverse_curvature_m2: Float[Array, "drones 3 3"]
    dispersion: Float[Array, "drones"]
    camera_share: Float[Array, "drones cameras"]


def find_vertex(
    inputs: ScoreInputs,
    position_m: Positions,
    size_m: Positions,
    information: Float[Array, "cameras"] | None = None,
) -> Vertex:
    """The vertex of the paraboloid through the scores about the best positions.

    Args:
        inputs: what the score reads of the frame.
        position_m: (drones, 3), positions of the largest fitness, metres.
        size_m: (drones, 3), full lengths of the drones, metres.
        information: (cameras,), share of each camera's information that counts in the covariance; None counts all of
            it. A frame that several instants show must not shrink the covariance at each of them.
    """
    # In units of the span the curvatures along the three axes can be compared.
    span_m = SPAN * size_m
    score, weight = camera_scores(inputs, position_m + span_m * jnp.asarray(_CUBE, span_m.dtype)[:, None, :])
    weight = weight[_MIDDLE]
    share = weight / jnp.maximum(weight.sum(axis=-1, keepdims=True), 1e-6)
    slope = jnp.einsum("ik,kdc,dc->dci", jnp.asarray(_SLOPE, score.dtype), score, share)
    curvature = -jnp.einsum("ijk,kdc,dc->dcij", jnp.asarray(_CURVATURE, score.dtype), score, share)
    inverse = _inverse(curvature.sum(axis=1), FLATTEST)
    to_vertex = jnp.clip(jnp.einsum("dij,dj->di", inverse, slope.sum(axis=1)), -1.0, 1.0)
    # Slopes of the single cameras at the common vertex.
    slope = slope - jnp.einsum("dcij,dj->dci", curvature, to_vertex)
    spread = jnp.einsum("dci,dij,dcj->d", slope, inverse, slope) / 3
    # Each camera measures two numbers and the position has three: residuals are smaller than errors.
    cameras = jnp.square(share.sum(axis=-1)) / jnp.maximum(jnp.square(share).sum(axis=-1), 1e-6)
    spread = spread * cameras / jnp.maximum(cameras - 1.5, 0.1)
    if information is not None:
        curvature = jnp.asarray(information)[:, None, None] * curvature
    inverse = _inverse(curvature.sum(axis=1), FLATTEST_OF_COVARIANCE)
    return Vertex(
        position_m=position_m + span_m * to_vertex,
        inverse_curvature_m2=span_m[:, :, None] * inverse * span_m[:, None, :],
        dispersion=jnp.where(cameras > 1.5, spread, jnp.inf),
        camera_share=share,
    )


def _inverse(curvature: Float[Array, "drones 3 3"], flattest: float) -> Float[Array, "drones 3 3"]:
    """Inverses of curvatures, of which small and negative eigenvalues are raised."""
    bent, axes = jnp.linalg.eigh(curvature)
    bent = jnp.maximum(bent, flattest * jnp.maximum(bent[:, -1:], 1e-6))
    return jnp.einsum("dik,dk,djk->dij", axes, 1 / bent, axes)
