"""Errors frame by frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from psotrack.trajectories import Trajectories
from psotrack.trajectories.association import (
    align,
    fixed_identity,
    fixed_partner_values,
    identity_switches,
    partners_per_frame,
)

if TYPE_CHECKING:
    from pandas import DataFrame


def errors_over_time(traj_est: Trajectories, traj_ref: Trajectories) -> DataFrame:
    """One row per frame and drone whose position is known, sorted by drone and frame.

    Returns:
        Columns `frame`; `time_s`; `drone`, the drone's name in the reference; `error_m`, distance to the track that
        follows the drone as in `evaluate`, NaN where the drone is missed; and `switch`, whether the drone is matched to
        another track than at its previous match.

    Raises:
        InputError: the estimate and the reference do not fit together.
    """
    import pandas as pd

    pair = align(traj_est, traj_ref)
    error_m = np.linalg.norm(fixed_partner_values(pair.est_m, fixed_identity(pair)) - pair.ref_m, axis=-1)
    switch = identity_switches(partners_per_frame(pair.distance_m, keep=True))
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
