"""Columns of tracks, one row per frame and drone, in files and data frames; and a summary of each drone's track.

The summary says when a drone was seen, how well, and how it flew. Commands and notebooks show it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Shaped

from psotrack.support import html_table
from psotrack.trajectories.tracks import Status

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


#: Text of an unknown number.
UNKNOWN = "-"
#: Numbers from here on are shown without decimals.
_LARGE = 10_000


def summary_columns(
    trajectories: Trajectories, size_m: Float[np.ndarray, "drones 3"] | None = None
) -> dict[str, list[str]]:
    """The summaries as text: heading -> one cell per drone; columns without any number are left out.

    - seen: share of the frames in which the drone is seen: its position is known and it is not lost;
    - coasting: share of the frames in which the position is predicted over a gap;
    - lost: share of the frames in which the drone is lost, after it was first seen;
    - cameras: mean number of cameras that see the drone, where it is seen;
    - std: median standard deviation of a coordinate, where the drone is seen;
    - extent: lengths of the space in which the drone flew; speed: mean speed.

    Args:
        trajectories: the tracks.
        size_m: (drones, 3), full lengths of each drone along the world's axes, metres.
    """
    if size_m is None:
        size_m = np.full((trajectories.num_drones, 3), math.nan)
    rows = [_cells(trajectories, drone, size_m[drone]) for drone in range(trajectories.num_drones)]
    columns = {"drone": list(trajectories.drones)}
    for heading in rows[0] if rows else ():
        columns[heading] = [row[heading] for row in rows]
    return {
        heading: cells for heading, cells in columns.items() if set(cells) != {UNKNOWN} or heading == "drone"
    }


def drones_html(trajectories: Trajectories, size_m: Float[np.ndarray, "drones 3"] | None = None) -> str:
    """The summaries as a table for notebooks; see `summary_columns`."""
    columns = summary_columns(trajectories, size_m)
    return html_table(list(columns), zip(*columns.values(), strict=True))


def _cells(trajectories: Trajectories, drone: int, size_m: Float[np.ndarray, "3"]) -> dict[str, str]:
    """The summary of one drone: heading -> text."""
    seen = trajectories.seen[:, drone]
    time_s = trajectories.time_s[seen]
    values = {name: value[:, drone] for name, value in trajectories.quantities().items()}
    position_m = values["position_m"][seen].astype(np.float64)
    status, cameras = values.get("status"), values.get("num_cameras")
    variance_m2 = np.empty(0)
    if "covariance_m2" in values:
        variance_m2 = np.trace(values["covariance_m2"][seen].astype(np.float64), axis1=-2, axis2=-1) / 3
        variance_m2 = variance_m2[np.isfinite(variance_m2)]
    std_m = math.sqrt(np.median(variance_m2)) if len(variance_m2) else math.nan
    first_s, last_s = (float(time_s[0]), float(time_s[-1])) if len(time_s) else (math.nan, math.nan)
    was_lost = np.maximum.accumulate(seen) & (status == Status.LOST)
    return {
        "seen": _share(_mean(seen)),
        "coasting": UNKNOWN if status is None else _share(_mean(seen & (status == Status.COASTING))),
        "lost": UNKNOWN if status is None else _share(_mean(was_lost)),
        "cameras": UNKNOWN if cameras is None else _number(_mean(cameras[seen]), 1),
        "std (mm)": _number(1000 * std_m, 1),
        # In centimetres and tenths of seconds, nine columns fit into 80 characters.
        "size (cm)": _vector(100 * size_m, 0),
        "from (s)": _number(first_s, 1),
        "to (s)": _number(last_s, 1),
        "extent (m)": _vector(np.ptp(position_m, axis=0), 2) if len(position_m) else UNKNOWN,
        "speed (m/s)": _number(_speed_m_s(trajectories, drone), 2),
    }


def _speed_m_s(trajectories: Trajectories, drone: int) -> float:
    """Mean speed from the velocities, or from the steps between neighbouring frames; NaN without either."""
    seen = trajectories.seen[:, drone]
    if trajectories.velocity_m_s is not None:
        speed_m_s = np.linalg.norm(trajectories.velocity_m_s[seen, drone].astype(np.float64), axis=-1)
    else:
        both = seen[1:] & seen[:-1]
        step_m = np.diff(trajectories.position_m[:, drone].astype(np.float64), axis=0)[both]
        speed_m_s = np.linalg.norm(step_m, axis=-1) / np.diff(trajectories.time_s)[both]
    return _mean(speed_m_s[np.isfinite(speed_m_s)])


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if len(values) else math.nan


def _number(value: float, decimals: int) -> str:
    """A number; a large one has no decimals, so that columns stay narrow."""
    if not math.isfinite(value):
        return UNKNOWN
    return f"{value:.{decimals if abs(value) < _LARGE else 0}f}"


def _share(value: float) -> str:
    return f"{value:.1%}" if math.isfinite(value) else UNKNOWN


def _vector(values: Float[np.ndarray, "3"], decimals: int) -> str:
    cells = [_number(float(value), decimals) for value in values]
    return UNKNOWN if UNKNOWN in cells else " ".join(cells)
