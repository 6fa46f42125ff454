"""What an evaluation says: frozen records, None where there is no number, and the keys of the contract."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal


@dataclass(frozen=True)
class ErrorSummary:
    """Of the distances between true and estimated positions; all None where there are none.

    The standard deviation is that of the distances about their mean (divided by their number); p95 is the
    95th percentile, interpolated.
    """

    mean_error_m: float | None
    median_error_m: float | None
    std_error_m: float | None
    p95_error_m: float | None
    max_error_m: float | None


@dataclass(frozen=True)
class PathErrors:
    """Of whole paths, root mean squares; None where there is nothing to compare. See `paths`.

    Attributes:
        ate_rmse_m: absolute trajectory error, as it stands.
        ate_aligned_rmse_m: the same after the rigid motion that brings the estimate nearest to the truth: one
            for the drone, or one for all drones together.
        rpe_1s_rmse_m: relative pose error over 1 s, of displacements.
        rpe_1s_rotation_rmse_deg: likewise of rotations; None unless both have orientations.
    """

    ate_rmse_m: float | None
    ate_aligned_rmse_m: float | None
    rpe_1s_rmse_m: float | None
    rpe_1s_rotation_rmse_deg: float | None


@dataclass(frozen=True)
class Consistency:
    """Whether the estimate's covariances are honest; all None where it has none. See `consistency`.

    Attributes:
        inside_90_rate: share of true positions inside of the estimate's 90 % ellipsoid.
        mean_nees: mean normalised estimation error squared; 3 for honest covariances.
        offset_removed_inside_90_rate: the first after each drone's constant offset is taken out.
        offset_removed_mean_nees: the second, likewise.
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
    """Root mean squares over frames; the squares of the last three add up to that of the first."""

    gospa_m: float
    gospa_localisation_m: float
    gospa_missed_m: float
    gospa_false_m: float


@dataclass(frozen=True)
class DroneEvaluation(ErrorSummary, PathErrors, Consistency):
    """The errors of one true drone.

    Attributes:
        drone: its name in the reference.
        estimate: name of the estimated drone that stands for it, or None.
        frames: in which its true position is known.
        missed_rate: share of those frames without a row, or with a lost one.
        offset_removed_mean_error_m: mean error when the mean residual is taken out; None if never seen.
        offset_m: that residual, estimate minus truth, (x, y, z): the lever arm from the reference's point to the one
            that is tracked; None if never seen.
        offset_standard_error_m: of each of the three; None if seen in fewer than two frames.
        offset_frame: of `offset_m`: the true body's where its orientation is known in every frame of it, else
            the world's.
    """

    drone: str
    estimate: str | None
    frames: int
    missed_rate: float
    offset_removed_mean_error_m: float | None
    offset_m: tuple[float, float, float] | None
    offset_standard_error_m: tuple[float, float, float] | None
    offset_frame: Literal["body", "world"] | None


@dataclass(frozen=True)
class Evaluation(ErrorSummary, Hota, Gospa, PathErrors, Consistency):
    """An estimate judged by its reference; see `evaluate` for the definitions."""

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

    def to_dict(self) -> dict[str, Any]:
        """The contract for other programs: fit for strict JSON, with null where there is no number."""
        values = asdict(self)
        return {key: values[key] for key in _CONTRACT} | {
            "per_drone": [{key: drone[key] for key in _CONTRACT_DRONE} for drone in values["per_drone"]]
        }


_ERRORS = ("mean_error_m", "median_error_m", "std_error_m", "p95_error_m", "max_error_m")
_PATHS = ("ate_rmse_m", "ate_aligned_rmse_m", "rpe_1s_rmse_m", "rpe_1s_rotation_rmse_deg")
_CONSISTENCY = (
    "inside_90_rate",
    "mean_nees",
    "offset_removed_inside_90_rate",
    "offset_removed_mean_nees",
)
#: Keys of `Evaluation.to_dict`, in this order.
_CONTRACT = (
    *("frames", "drones"),
    *_ERRORS,
    *("missed_rate", "id_switches", "mota", "motp_m", "idf1"),
    *("matched_mean_error_m", "offset_removed_mean_error_m"),
    *("hota", "deta", "assa", "loca"),
    *("gospa_m", "gospa_localisation_m", "gospa_missed_m", "gospa_false_m"),
    *_PATHS,
    *_CONSISTENCY,
    "per_drone",
)
_CONTRACT_DRONE = (
    *("drone", "estimate", "frames"),
    *_ERRORS,
    *("missed_rate", "offset_removed_mean_error_m"),
    *("offset_m", "offset_standard_error_m", "offset_frame"),
    *_PATHS,
    *_CONSISTENCY,
)
