"""Summary of each drone's track: when it was seen, how well, and how it flew. Commands and notebooks show it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from psotrack.support import html_table
from psotrack.trajectories.status import Status

if TYPE_CHECKING:
    from psotrack.trajectories.trajectories import Trajectories

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
