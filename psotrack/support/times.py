"""Times in files of others."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

#: Shortest time between two samples, seconds. Times in files are whole nanoseconds at the finest, and a change divided
#: by a much shorter time overflows.
LEAST_STEP_S = 0.5e-9


def first_repeat(time_s: Float[np.ndarray, "samples"]) -> int | None:
    """Index of the first time that is not at least `LEAST_STEP_S` after the time before it; None if there is none.

    Args:
        time_s: (samples,), seconds. Steps from or to NaN are not judged.
    """
    repeats = np.flatnonzero(np.diff(time_s) < LEAST_STEP_S)
    return int(repeats[0]) + 1 if len(repeats) else None
