"""Errors frame by frame, for those who want to look at them rather than at their mean."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from psotrack.trajectories import Trajectories
from psotrack.trajectories.association import (
    align,
    fixed_identity,
    identity_switches,
    matched_per_frame,
    of_partners,
)

if TYPE_CHECKING:
    from pandas import DataFrame


def errors_over_time(traj_est: Trajectories, traj_ref: Trajectories) -> DataFrame:
    """One row per frame and drone of which the truth is known, drone by drone.

    Returns:
        `frame`, `time_s`, `drone` (its name in the reference), `error_m` (distance to the track that stands for it as
        in `evaluate`; NaN where it is missed), and `switch`, whether another track is at it than when it was last
        matched.

    Raises:
        InputError: the estimate and the reference do not fit together.
    """
    import pandas as pd

    pair = align(traj_est, traj_ref)
    error_m = np.linalg.norm(of_partners(pair.est_m, fixed_identity(pair)) - pair.ref_m, axis=-1)
    switch = identity_switches(matched_per_frame(pair.distance_m, keep=True))
    frame, drone = np.nonzero(pair.truth_known)
    order = np.lexsort((frame, drone))
    frame, drone = frame[order], drone[order]
    return pd.DataFrame(
        {
            "frame": pair.frame[frame],
            "time_s": pair.time_s[frame],
            "drone": pd.Categorical(np.array(pair.drones)[drone], categories=list(pair.drones)),
            "error_m": error_m[frame, drone],
            "switch": switch[frame, drone],
        }
    )
