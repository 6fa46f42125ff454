"""Records of an evaluation, with None where there is no number, and the keys of the contract."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

from psotrack.evaluation.tables import as_text, to_html


@dataclass(frozen=True)
class ErrorSummary:
    """Statistics of the distances between reference and estimated positions, metres; None without any distance.

    The standard deviation is the population's (divided by the number of distances); p95 is the 95th percentile,
    interpolated.
    """

    mean_error_m: float | None
    median_error_m: float | None
    std_error_m: float | None
    p95_error_m: float | None
    max_error_m: float | None


@dataclass(frozen=True)
class PathErrors:
    """Root mean square errors of whole paths; None where there is nothing to compare. See `paths`.

    Attributes:
        ate_rmse_m: absolute trajectory error, without alignment.
        ate_aligned_rmse_m: absolute trajectory error after the rigid motion that best aligns the estimate with the
            reference: one motion for the drone, or one for all drones together.
        rpe_1s_rmse_m: relative pose error of displacements over 1 s.
        rpe_1s_rotation_rmse_deg: relative pose error of rotations over 1 s; None unless both have orientations.
    """

    ate_rmse_m: float | None
    ate_aligned_rmse_m: float | None
    rpe_1s_rmse_m: float | None
    rpe_1s_rotation_rmse_deg: float | None


@dataclass(frozen=True)
class Consistency:
    """Consistency of the estimate's covariances with its errors; None without covariances. See `consistency`.

    Attributes:
        inside_90_rate: share of reference positions inside the estimate's 90 % ellipsoid.
        mean_nees: mean normalised estimation error squared; 3 for correct covariances.
        offset_removed_inside_90_rate: `inside_90_rate` after each drone's mean residual is subtracted.
        offset_removed_mean_nees: `mean_nees` after each drone's mean residual is subtracted.
    """

    inside_90_rate: float | None
    mean_nees: float | None
    offset_removed_inside_90_rate: float | None
    offset_removed_mean_nees: float | None


@dataclass(frozen=True)
class Hota:
    """Higher order tracking accuracy and its parts, in [0, 1]; `loca` is None where nothing matches."""

    hota: float
    deta: float
    assa: float
    loca: float | None


@dataclass(frozen=True)
class Gospa:
    """GOSPA and its three parts, root mean squares over frames; the parts' squares add up to GOSPA's square."""

    gospa_m: float
    gospa_localisation_m: float
    gospa_missed_m: float
    gospa_false_m: float


@dataclass(frozen=True)
class DroneEvaluation(Consistency, PathErrors, ErrorSummary):
    """Errors of one drone of the reference.

    Attributes:
        drone: the drone's name in the reference.
        estimate: name of the track that follows the drone; None without such a track.
        frames: number of frames in which the drone's position is known.
        missed_rate: share of these frames in which the track has no row, or a row with the status lost.
        offset_removed_mean_error_m: mean error after the mean residual is subtracted; None if missed in all frames.
        offset_m: (x, y, z), mean residual, estimate minus reference: the lever arm from the reference's point to the
            tracked point; None if missed in all frames.
        offset_standard_error_m: (x, y, z), standard error of `offset_m`; None if seen in fewer than two frames.
        offset_frame: frame of `offset_m`: the body's where its orientation is known in every frame, else the world's.
    """

    drone: str
    estimate: str | None
    frames: int
    missed_rate: float
    offset_removed_mean_error_m: float | None
    offset_m: tuple[float, float, float] | None
    offset_standard_error_m: tuple[float, float, float] | None
    offset_frame: Literal["body", "world"] | None


@dataclass(frozen=True, repr=False)
class Evaluation(Consistency, PathErrors, Gospa, Hota, ErrorSummary):
    """Figures of an estimate compared with its reference; see `evaluate` for the definitions."""

    frames: int
    drones: int
    missed_rate: float
    id_switches: int
    mota: float
    motp_m: float | None
    idf1: float
    matched_mean_error_m: float | None
    offset_removed_mean_error_m: float | None
    per_drone: tuple[DroneEvaluation, ...]

    def __repr__(self) -> str:
        mean = "unknown" if self.mean_error_m is None else f"{1e3 * self.mean_error_m:.1f} mm"
        return (
            f"Evaluation(mean error {mean}, missed {self.missed_rate:.1%}, MOTA {self.mota:.3f}, "
            f"identity switches {self.id_switches}; {self.drones} drones, {self.frames} frames)"
        )

    def __str__(self) -> str:
        """The table of `psotrack evaluate`."""
        return as_text(self)

    def _repr_html_(self) -> str:
        """What a notebook shows: the table of `psotrack evaluate`."""
        return to_html(self)

    def to_dict(self) -> dict[str, Any]:
        """The figures with the contract's keys, for strict JSON; None becomes null."""
        drones = [{"drone": each.drone, "estimate": each.estimate, **asdict(each)} for each in self.per_drone]
        return {**asdict(self), "per_drone": drones}
