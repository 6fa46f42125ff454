"""Trajectories as HTML, for notebooks."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from psotrack.support import html_paths, html_table
from psotrack.trajectories.summaries import summary_columns
from psotrack.trajectories.trajectories import Trajectories


def drones_html(trajectories: Trajectories, size_m: Float[np.ndarray, "drones 3"] | None = None) -> str:
    """A table with a row for each drone, and a picture of the paths from above in the colours of the table.

    Args:
        trajectories: the tracks.
        size_m: (drones, 3), full lengths of each drone along the world's axes, metres.
    """
    columns = summary_columns(trajectories, size_m)
    rows = list(zip(*columns.values(), strict=True))
    seen_m = np.where(trajectories.seen[..., None], trajectories.position_m, np.nan)
    return html_table(list(columns), rows, coloured=True) + html_paths(seen_m)
