"""The words for array axes, and the aliases that are used in more than one module.

Axis words, the same in every annotation and docstring: `frames`, `cameras`, `drones`, `particles`, `groups` and
`dims` (of a swarm), `height`, `width` (of an image, rows and columns), `coefficients` (of a lens).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray, UInt8

#: NumPy outside of jit, where geometry is float64; JAX inside, where it is float32.
if TYPE_CHECKING:
    Array = np.ndarray | jax.Array
else:
    # NumPy turns arrays without axes into scalars, which to a type checker could not be indexed.
    Array = np.ndarray | np.generic | jax.Array

Key = PRNGKeyArray
Coverage = UInt8[Array, "cameras height width"]
Tables = Int[Array, "height1 cameras width1"]
Positions = Float[Array, "drones 3"]

__all__ = ["Array", "Coverage", "Key", "Positions", "Tables"]
