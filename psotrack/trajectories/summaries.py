"""Summary of each drone's track: when it was seen, how well, and how it flew. Commands and notebooks show it."""

from __future__ import annotations

import math
from dataclasses import dataclass
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


@dataclass(frozen=True)
class DroneSummary:
    """One drone's track in a few numbers; NaN where a number is unknown.

    Attributes:
        drone: name of the drone.
        seen_share: share of the frames in which the drone is seen: its position is known and it is not lost.
        coasting_share: share of the frames in which the position is predicted over a gap.
        lost_share: share of the frames in which the drone is lost, after it was first seen.
        num_cameras: mean number of cameras that see the drone, where it is seen.
        std_m: median standard deviation of a coordinate, where the drone is seen, metres.
        first_s, last_s: times at which the drone is seen first and last, seconds.
        extent_m: (x, y, z), lengths of the space in which the drone flew, metres.
        speed_m_s: mean speed, metres per second.
    """

    drone: str
    seen_share: float
    coasting_share: float
    lost_share: float
    num_cameras: float
    std_m: float
    first_s: float
    last_s: float
    extent_m: tuple[float, float, float]
    speed_m_s: float


def summarise(trajectories: Trajectories) -> tuple[DroneSummary, ...]:
    """One summary for each drone."""
    return tuple(_summary(trajectories, drone) for drone in range(trajectories.num_drones))


def summary_columns(
    trajectories: Trajectories, size_m: Float[np.ndarray, "drones 3"] | None = None
) -> dict[str, list[str]]:
    """The summaries as text: heading -> one cell per drone; columns without any number are left out.

    Args:
        trajectories: the tracks.
        size_m: (drones, 3), full lengths of each drone along the world's axes, metres.
    """
    drones, numbers = summarise(trajectories), range(trajectories.num_drones)
    columns = {
        "drone": [each.drone for each in drones],
        "seen": [_share(each.seen_share) for each in drones],
        "coasting": [_share(each.coasting_share) for each in drones],
        "lost": [_share(each.lost_share) for each in drones],
        "cameras": [_number(each.num_cameras, 1) for each in drones],
        "std (mm)": [_number(1000 * each.std_m, 1) for each in drones],
        # In centimetres and tenths of seconds, nine columns fit into 80 characters.
        "size (cm)": [UNKNOWN if size_m is None else _vector(100 * size_m[drone], 0) for drone in numbers],
        "from (s)": [_number(each.first_s, 1) for each in drones],
        "to (s)": [_number(each.last_s, 1) for each in drones],
        "extent (m)": [_vector(each.extent_m, 2) for each in drones],
        "speed (m/s)": [_number(each.speed_m_s, 2) for each in drones],
    }
    return {
        heading: cells
        for heading, cells in columns.items()
        if heading == "drone" or any(cell != UNKNOWN for cell in cells)
    }


def drones_html(trajectories: Trajectories, size_m: Float[np.ndarray, "drones 3"] | None = None) -> str:
    """The summaries as a table for notebooks; see `summary_columns`."""
    columns = summary_columns(trajectories, size_m)
    return html_table(list(columns), zip(*columns.values(), strict=True))


def _summary(trajectories: Trajectories, drone: int) -> DroneSummary:
    seen = trajectories.seen[:, drone]
    time_s = trajectories.time_s[seen]
    position_m = trajectories.position_m[seen, drone].astype(np.float64)
    status = None if trajectories.status is None else trajectories.status[:, drone]
    was_seen = np.maximum.accumulate(seen)
    cameras = None if trajectories.num_cameras is None else trajectories.num_cameras[seen, drone]
    variances_m2 = np.empty(0)
    if trajectories.covariance_m2 is not None:
        covariance_m2 = trajectories.covariance_m2[seen, drone].astype(np.float64)
        variances_m2 = np.trace(covariance_m2, axis1=-2, axis2=-1) / 3
        variances_m2 = variances_m2[np.isfinite(variances_m2)]
    x_m, y_m, z_m = np.ptp(position_m, axis=0) if seen.any() else 3 * (math.nan,)
    return DroneSummary(
        drone=trajectories.drones[drone],
        seen_share=_mean(seen),
        coasting_share=math.nan if status is None else _mean(seen & (status == Status.COASTING)),
        lost_share=math.nan if status is None else _mean(was_seen & (status == Status.LOST)),
        num_cameras=math.nan if cameras is None else _mean(cameras),
        std_m=math.sqrt(np.median(variances_m2)) if len(variances_m2) else math.nan,
        first_s=float(time_s[0]) if len(time_s) else math.nan,
        last_s=float(time_s[-1]) if len(time_s) else math.nan,
        extent_m=(float(x_m), float(y_m), float(z_m)),
        speed_m_s=_speed_m_s(trajectories, drone),
    )


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


def _vector(values: np.ndarray | tuple[float, ...], decimals: int) -> str:
    cells = [_number(float(value), decimals) for value in values]
    return UNKNOWN if UNKNOWN in cells else " ".join(cells)
