"""Names of array axes, and type aliases that more than one module uses.

Annotations and docstrings call the axes `frames`, `cameras`, `drones`; `particles`, `groups` and `dims` in a swarm;
`height` and `width` (rows and columns) in an image; `coefficients` in a lens.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray, UInt8

#: NumPy arrays (float64) outside of jit, JAX arrays (float32) inside.
if TYPE_CHECKING:
    Array = np.ndarray | jax.Array
else:
    # NumPy turns arrays without axes into scalars. Static type checkers do not get them: scalars cannot be indexed.
    Array = np.ndarray | np.generic | jax.Array

Key = PRNGKeyArray
Coverage = UInt8[Array, "cameras height width"]
Tables = Int[Array, "height1 cameras width1"]
Positions = Float[Array, "drones 3"]

__all__ = ["Array", "Coverage", "Key", "Positions", "Tables"]
