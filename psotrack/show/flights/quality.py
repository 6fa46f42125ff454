"""Tables of the quality of tracks: one row per drone, and one row per camera."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from psotrack.recordings import Recording
from psotrack.show.flights.ellipsoids import ellipsoids_90
from psotrack.show.flights.flight import FlightTracks
from psotrack.show.flights.image_views import boxes_in_images, shown_frames
from psotrack.trajectories import Status

if TYPE_CHECKING:
    from pandas import DataFrame


def drone_quality(tracks: FlightTracks) -> DataFrame:
    """One row per drone.

    Returns:
        Columns `drone`; `seen`, share of the frames in which the drone is seen; `coasting`, share of the frames in
        which it is predicted only; `first_s`, `last_s`, times of the first and the last frame in which it is seen;
        `fitness`, `num_cameras`, means over the frames in which it is seen; `radius_90_m`, median of the longest half
        axis of the 90 % ellipsoid; `speed_m_s`, mean speed; `size_x_m`, `size_y_m`, `size_z_m`, lengths. NaN where
        unknown.
    """
    import pandas as pd

    trajectories, seen = tracks.trajectories, tracks.trajectories.seen
    rows: list[dict[str, Any]] = []
    for drone, name in enumerate(trajectories.drones):
        there = seen[:, drone]
        times_s = trajectories.time_s[there]
        rows.append(
            {
                "drone": name,
                "seen": there.mean(),
                "coasting": np.nan
                if trajectories.status is None
                else (there & (trajectories.status[:, drone] == Status.COASTING)).mean(),
                "first_s": times_s[0] if len(times_s) else np.nan,
                "last_s": times_s[-1] if len(times_s) else np.nan,
                "fitness": _mean(trajectories.fitness, there, drone),
                "num_cameras": _mean(trajectories.num_cameras, there, drone),
                "radius_90_m": _median_radius_m(trajectories.covariance_m2, there, drone),
                "speed_m_s": _mean_speed_m_s(trajectories.velocity_m_s, there, drone),
                **dict(zip(("size_x_m", "size_y_m", "size_z_m"), tracks.size_m[drone], strict=True)),
            }
        )
    return pd.DataFrame(rows)


def camera_quality(tracks: FlightTracks, recording: Recording) -> DataFrame:
    """One row per camera of the recording's rig.

    Returns:
        Columns `camera`; `frames`, share of the instants at which the camera has a frame; `in_view`, share of the
        drones' positions that are in its image; `width_px`, median width of the drones' boxes in its image; `noise_px`,
        the noise of the drones' places in its image as the run learned it, root mean square of columns and rows;
        `left_out`, number of its frames that the run left out. NaN where unknown.
    """
    import pandas as pd

    boxes_px = boxes_in_images(recording, tracks.trajectories, tracks.size_m)
    in_view = np.isfinite(boxes_px).all(axis=-1)
    num_seen = max(int(tracks.trajectories.seen.sum()), 1)
    shown = shown_frames(recording, tracks.trajectories)
    record = tracks.record
    errors = {} if record is None else record.camera_errors.get("cameras", {})
    rows = []
    for camera, name in enumerate(recording.rig.names):
        widths_px = np.ptp(boxes_px[..., camera, [0, 2]][in_view[..., camera]], axis=-1)
        noise_px = [part for part in errors.get(name, {}).get("noise_px") or () if part is not None]
        intervals = [] if record is None else record.left_out.get(name, [])
        rows.append(
            {
                "camera": name,
                "frames": shown.is_there[:, camera].mean(),
                "in_view": in_view[..., camera].sum() / num_seen,
                "width_px": np.median(widths_px) if len(widths_px) else np.nan,
                "noise_px": np.sqrt(np.mean(np.square(noise_px))) if noise_px else np.nan,
                "left_out": sum(stop - first for first, stop in intervals),
            }
        )
    return pd.DataFrame(rows)


def _mean(values: np.ndarray | None, there: np.ndarray, drone: int) -> float:
    if values is None or not there.any():
        return np.nan
    return float(np.mean(values[there, drone]))


def _mean_speed_m_s(velocity_m_s: np.ndarray | None, there: np.ndarray, drone: int) -> float:
    if velocity_m_s is None or not there.any():
        return np.nan
    return float(np.linalg.norm(velocity_m_s[there, drone], axis=-1).mean())


def _median_radius_m(
    covariance_m2: Float[np.ndarray, "frames drones 3 3"] | None, there: np.ndarray, drone: int
) -> float:
    if covariance_m2 is None or not there.any():
        return np.nan
    longest_m = ellipsoids_90(covariance_m2[there, drone]).half_axes_m[:, 2]
    return float(np.nanmedian(longest_m)) if np.isfinite(longest_m).any() else np.nan
