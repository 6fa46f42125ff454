"""Input of `resolve`, prepared for computing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float


@dataclass(frozen=True)
class MeasuredTracks:
    """Measurements of all tracks, with finite numbers everywhere that the computation uses.

    Attributes:
        time_s: (frames,), times.
        measured_m: (frames, tracks, 3), measured positions; 0 where not measured.
        covariance_m2: (frames, tracks, 3, 3), their covariances; the identity where not measured.
        was_measured: (frames, tracks), whether the track was measured.
        size_m: (frames, tracks, 3), apparent sizes; NaN where not known.
        distance_m: (frames, tracks, tracks), distances; NaN from a track to itself, and where not both are measured.
        clear: (frames, tracks), whether the track is measured and no other track is near.
    """

    time_s: Float[np.ndarray, "frames"]
    measured_m: Float[np.ndarray, "frames drones 3"]
    covariance_m2: Float[np.ndarray, "frames drones 3 3"]
    was_measured: Bool[np.ndarray, "frames drones"]
    size_m: Float[np.ndarray, "frames drones 3"]
    distance_m: Float[np.ndarray, "frames drones drones"]
    clear: Bool[np.ndarray, "frames drones"]


def prepare_tracks(
    time_s: Float[np.ndarray, "frames"],
    measured_m: Float[np.ndarray, "frames drones 3"],
    measured_covariance_m2: Float[np.ndarray, "frames drones 3 3"],
    was_measured: Bool[np.ndarray, "frames drones"],
    size_m: Float[np.ndarray, "frames drones 3"] | None,
    encounter_m: float,
) -> MeasuredTracks:
    """Prepare the input of `resolve`: float64, and finite numbers where a track is not measured."""
    position_m = np.where(was_measured[..., None], measured_m, np.nan).astype(np.float64)
    distance_m = np.linalg.norm(position_m[:, :, None] - position_m[:, None], axis=-1)
    distance_m[:, np.eye(was_measured.shape[1], dtype=bool)] = np.nan
    return MeasuredTracks(
        time_s=time_s.astype(np.float64),
        measured_m=np.nan_to_num(position_m),
        covariance_m2=np.where(was_measured[..., None, None], measured_covariance_m2, np.eye(3)),
        was_measured=was_measured,
        size_m=np.full(measured_m.shape, np.nan) if size_m is None else size_m.astype(np.float64),
        distance_m=distance_m,
        clear=was_measured & ~(distance_m < encounter_m).any(axis=-1),
    )
