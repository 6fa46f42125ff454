"""Measures of one flight by one method, and of several flights together."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields

import numpy as np
from _recordings import Recording
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from psotrack.evaluation import PathComparison, Statistics
from psotrack.inside_out import CameraPath

ANGLES = ("roll", "pitch", "yaw")


@dataclass(frozen=True)
class Measures:
    """Measures of each frame; NaN where a measure is not known.

    Attributes:
        distance_m, distance_to_point_m, difference_deg, angle_deg: by the paper's procedure: see `PathComparison`.
        error_m, error_deg: errors against the true pose of the camera, at the video's times; real recordings have no
            true pose, and here the reference takes its place.
        inside_90: whether the true position lies in the 90 % ellipsoid of the estimate.
        posed: whether the frame has a pose.
    """

    distance_m: Float[np.ndarray, "frames"]
    distance_to_point_m: Float[np.ndarray, "frames"]
    difference_deg: Float[np.ndarray, "frames 3"]
    angle_deg: Float[np.ndarray, "frames"]
    error_m: Float[np.ndarray, "frames"]
    error_deg: Float[np.ndarray, "frames"]
    inside_90: Float[np.ndarray, "frames"]
    posed: Bool[np.ndarray, "frames"]


def measure(recording: Recording, path: CameraPath, comparison: PathComparison) -> Measures:
    """Compute the measures of one flight by one method."""
    turning, unknown = comparison.turning, np.full(path.num_frames, np.nan)
    if recording.truth is not None:
        true_m, true_wxyz = recording.truth.position_m, recording.truth.orientation_wxyz
    else:
        true_m = comparison.reference_m
        true_wxyz = np.full((path.num_frames, 4), np.nan) if turning is None else turning.reference_wxyz
    off_m = np.where(path.seen[:, None], path.position_m, np.nan) - true_m
    return Measures(
        distance_m=comparison.distance_m,
        distance_to_point_m=comparison.distance_to_point_m,
        difference_deg=np.tile(unknown[:, None], 3) if turning is None else turning.difference_deg,
        angle_deg=unknown if turning is None else turning.angle_deg,
        error_m=np.linalg.norm(off_m, axis=-1),
        error_deg=_angles_deg(np.where(path.seen[:, None], path.orientation_wxyz, np.nan), true_wxyz),
        inside_90=_inside_90(off_m, path.covariance[:, :3, :3]),
        posed=path.seen,
    )


def together(several: Iterable[Measures]) -> Measures:
    """Join the frames of several flights."""
    several = list(several)
    return Measures(
        *(np.concatenate([getattr(one, field.name) for one in several]) for field in fields(Measures))
    )


def row(measures: Measures) -> dict[str, float]:
    """Numbers of one row of the tables."""
    numbers = {
        "position_median_m": _statistic(np.nanmedian, measures.error_m),
        "position_p99_m": _statistic(lambda values: np.nanpercentile(values, 99), measures.error_m),
        "position_max_m": _statistic(np.nanmax, measures.error_m),
        "orientation_median_deg": _statistic(np.nanmedian, measures.error_deg),
        "posed_rate": float(np.mean(measures.posed)),
        "inside_90_rate": _statistic(np.nanmean, measures.inside_90),
    }
    tables = {
        "distance_m": measures.distance_m,
        "distance_to_point_m": measures.distance_to_point_m,
        **{f"{name}_deg": measures.difference_deg[:, axis] for axis, name in enumerate(ANGLES)},
        **{f"abs_{name}_deg": np.abs(measures.difference_deg[:, axis]) for axis, name in enumerate(ANGLES)},
        "angle_deg": measures.angle_deg,
    }
    for name, values in tables.items():
        numbers |= {f"{name}.{key}": value for key, value in asdict(Statistics.of(values)).items()}
    return numbers


def _statistic(function: object, values: Float[np.ndarray, "frames"]) -> float:
    return float(function(values)) if np.isfinite(values).any() else np.nan


def _angles_deg(
    one_wxyz: Float[np.ndarray, "frames 4"], other_wxyz: Float[np.ndarray, "frames 4"]
) -> Float[np.ndarray, "frames"]:
    angles = np.full(len(one_wxyz), np.nan)
    both = np.isfinite(one_wxyz).all(axis=-1) & np.isfinite(other_wxyz).all(axis=-1)
    if both.any():
        one, other = (Rotation.from_quat(wxyz[both], scalar_first=True) for wxyz in (one_wxyz, other_wxyz))
        angles[both] = np.degrees((one.inv() * other).magnitude())
    return angles


def _inside_90(
    off_m: Float[np.ndarray, "frames 3"], covariance_m2: Float[np.ndarray, "frames 3 3"]
) -> Float[np.ndarray, "frames"]:
    """1 where the true position is in the 90 % ellipsoid, else 0; NaN without estimate, true position or covariance."""
    inside = np.full(len(off_m), np.nan)
    both = np.isfinite(off_m).all(axis=-1) & np.isfinite(covariance_m2).all(axis=(-2, -1))
    if both.any():
        squared = np.einsum(
            "fi,fi->f", off_m[both], np.linalg.solve(covariance_m2[both], off_m[both][..., None])[..., 0]
        )
        inside[both] = squared <= chi2.ppf(0.9, 3)
    return inside
