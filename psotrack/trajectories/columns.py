"""The columns of tracks: one row per frame and drone, in files and in data frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Shaped

from psotrack.trajectories.status import Status

if TYPE_CHECKING:
    from pandas import DataFrame

    from psotrack.trajectories.trajectories import Trajectories

_COVARIANCE = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")
#: Columns of each quantity of `Trajectories`, in written order. Covariances are the upper triangle, row by row.
PARTS = {
    "position_m": ("x_m", "y_m", "z_m"),
    "velocity_m_s": ("vx_m_s", "vy_m_s", "vz_m_s"),
    "fitness": ("fitness",),
    "num_cameras": ("num_cameras",),
    "status": ("status",),
    "covariance_m2": _COVARIANCE,
    "relative_covariance_m2": tuple(f"rel_{name}" for name in _COVARIANCE),
    "orientation_wxyz": ("qw", "qx", "qy", "qz"),
}
_UNITS = {
    "position_m": "m",
    "velocity_m_s": "m/s",
    "status": "tracked, coasting or lost",
    "covariance_m2": "m2",
    "relative_covariance_m2": "m2",
}
#: All columns and their units, in written order.
ALL_COLUMNS = {"frame": "1", "time_s": "s", "drone": "name"} | {
    name: _UNITS.get(quantity, "1") for quantity, names in PARTS.items() for name in names
}
#: Quantities whose columns are always written; the others are written if they are known.
ALWAYS = ("position_m", "velocity_m_s", "fitness", "num_cameras", "status")
_UPPER = np.triu_indices(3)


def columns_of(trajectories: Trajectories) -> dict[str, Shaped[np.ndarray, "rows"]]:
    """One array per column; unknown values are NaN, and -1 in `num_cameras`."""
    shape = (trajectories.num_frames, trajectories.num_drones)
    columns = {
        "frame": np.broadcast_to(trajectories.frame[:, None], shape),
        "time_s": np.broadcast_to(trajectories.time_s[:, None], shape),
        "drone": np.broadcast_to(np.array(trajectories.drones, str), shape),
    }
    unknown = {
        "num_cameras": np.full(shape, -1),
        "status": np.where(trajectories.seen, Status.TRACKED, Status.LOST),
    }
    for quantity, names in PARTS.items():
        values = getattr(trajectories, quantity)
        if values is None and quantity not in ALWAYS:
            continue
        if values is None:
            values = unknown.get(quantity, np.full((*shape, len(names)), np.nan, np.float32))
        if quantity == "status":
            values = np.array([status.label for status in Status])[values]
        if values.ndim > 3:
            values = values[..., *_UPPER]
        columns |= dict(zip(names, np.moveaxis(values.reshape(*shape, len(names)), -1, 0), strict=True))
    return {name: column.ravel() for name, column in columns.items()}


def data_frame(trajectories: Trajectories) -> DataFrame:
    """The columns as a data frame; what is not known is NaN."""
    import pandas as pd

    columns = columns_of(trajectories)
    return pd.DataFrame({name: pd.Series(values).where(is_known(values)) for name, values in columns.items()})


def is_known(column: Shaped[np.ndarray, "rows"]) -> Bool[np.ndarray, "rows"]:
    """(rows,), whether the values of a column are known."""
    if column.dtype.kind == "f":
        return ~np.isnan(column)
    return column >= 0 if column.dtype.kind in "iu" else np.ones(len(column), bool)
