"""Records of an evaluation, with None where there is no number and the keys of the contract; and their tables."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

from psotrack.support import html_block, html_lines, html_table, text_table

if TYPE_CHECKING:
    from psotrack.evaluation.path_comparison import PathComparison


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
    """Root mean square errors of whole paths; None where there is nothing to compare. See `path_errors`.

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
    offset_m: tuple[float, float, float] | None = None
    offset_standard_error_m: tuple[float, float, float] | None = None
    offset_frame: Literal["body", "world"] | None = None


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


_COLUMNS = ("mean", "median", "std", "p95", "max", "missed", "centred", "offset x y z")


def as_text(evaluation: Evaluation, title: str = "") -> str:
    """Table at most 80 characters wide: one row per drone, one row for all drones, and the scores below.

    Errors are in millimetres, or in metres if the mean error is a metre or more. A drone is named as in the reference,
    with the track that follows it.
    """
    unit = _unit_of(evaluation)
    heading = _heading(evaluation, unit)
    scores = [f"{label:<10}{line}" for label, line in _scores(evaluation, unit).items()]
    table = text_table(["drone", *_COLUMNS], _rows(evaluation, unit), whole=_COLUMNS)
    return "\n".join([f"{title}: {heading}" if title else heading, table, *scores])


def paths_as_text(comparison: PathComparison, title: str) -> str:
    """Tables 7 and 8 of one path: distances in millimetres, angles in degrees, with the offsets that were found."""
    found, turning = comparison, comparison.turning
    rows = []
    for key, one in found.statistics.items():
        *words, unit = key.split("_")
        factor, decimals, unit = (1e3, 2, "mm") if unit == "m" else (1.0, 3, "deg")
        values = (one.mean, one.median, one.std, one.minimum, one.maximum)
        cells = (f"{factor * value:.{decimals}f}" for value in values)
        rows.append([f"{' '.join(words)} ({unit})", *cells, str(one.count)])
    table = text_table(("", "mean", "median", "std", "min", "max", "frames"), rows)
    known = "" if found.offset_std_s != found.offset_std_s else f" ± {found.offset_std_s:.4f} s"
    lines = [title, table, f"the reference's clock is {found.offset_s:+.4f} s{known} ahead of the path's"]
    if turning is not None and turning.offset_s != found.offset_s:
        lines.append(f"the clock of the reference's orientations is {turning.offset_s:+.4f} s ahead")
    arm = " ".join(f"{1e3 * part:+.1f}" for part in found.lever_arm_m)
    lines.append(f"lever arm {arm} mm; length of the reference's path {found.path_length_m:.2f} m")
    return "\n".join(lines)


def to_html(evaluation: Evaluation) -> str:
    """The same as HTML for notebooks."""
    unit = _unit_of(evaluation)
    return html_block(
        f"Evaluation: {_heading(evaluation, unit)}",
        html_table(["drone", *_COLUMNS], _rows(evaluation, unit)),
        html_lines(_scores(evaluation, unit)),
    )


@dataclass(frozen=True)
class _Unit:
    name: str
    per_metre: float
    decimals: int

    def number(self, value_m: float | None) -> str:
        if value_m is None:
            return "-"
        value = value_m * self.per_metre
        return f"{value:.{self.decimals if value < 100 else 0}f}"

    def vector(self, value_m: tuple[float, float, float] | None) -> str:
        """Signed numbers with one decimal fewer than `number`, because offsets are not known better."""
        if value_m is None:
            return "-"
        return " ".join(f"{part * self.per_metre:+.{self.decimals - 1}f}" for part in value_m)


_METRES = _Unit("m", 1.0, 2)
_MILLIMETRES = _Unit("mm", 1000.0, 1)


def _unit_of(evaluation: Evaluation) -> _Unit:
    return _METRES if (evaluation.mean_error_m or 0) >= 1 else _MILLIMETRES


def _heading(evaluation: Evaluation, unit: _Unit) -> str:
    return f"{evaluation.frames} frames, {evaluation.drones} drones, errors in {unit.name}"


def drone_label(drone: str, track: str | None) -> str:
    """Name of a drone in the reference, and of the track that follows it, such as "dron2 (track 0)"."""
    return drone if track in (None, drone) else f"{drone} (track {track})"


def _rows(evaluation: Evaluation, unit: _Unit) -> list[list[str]]:
    """The cells of each drone, and last of all drones."""
    drones = [
        [drone_label(drone.drone, drone.estimate), *_cells(drone, unit), unit.vector(drone.offset_m)]
        for drone in evaluation.per_drone
    ]
    return [*drones, ["all", *_cells(evaluation, unit), ""]]


def _cells(errors: Evaluation | DroneEvaluation, unit: _Unit) -> list[str]:
    names = ("mean_error_m", "median_error_m", "std_error_m", "p95_error_m", "max_error_m")
    return [
        *(unit.number(getattr(errors, name)) for name in names),
        f"{errors.missed_rate:.1%}",
        unit.number(errors.offset_removed_mean_error_m),
    ]


def _scores(evaluation: Evaluation, unit: _Unit) -> dict[str, str]:
    """Label and sentence of each score; the second sentence about a label has none."""
    # Errors of matched pairs, and GOSPA, have at most the size of the gate, so millimetres fit.
    matched = _MILLIMETRES.number(evaluation.matched_mean_error_m)
    motp = _MILLIMETRES.number(evaluation.motp_m)
    parts = ("gospa_m", "gospa_localisation_m", "gospa_missed_m", "gospa_false_m")
    gospa, localisation, missed, false = (_MILLIMETRES.number(getattr(evaluation, part)) for part in parts)
    lines = {
        "CLEAR": (
            f"MOTA {evaluation.mota:.3f}, MOTP {motp} mm, IDF1 {evaluation.idf1:.3f}, "
            f"identity switches {evaluation.id_switches}"
        ),
        "": f"mean when matched anew in each frame {matched} mm",
        "HOTA": (
            f"{evaluation.hota:.3f}: DetA {evaluation.deta:.3f}, AssA {evaluation.assa:.3f}, "
            f"LocA {_or_dash(evaluation.loca, '.3f')}"
        ),
        "GOSPA": f"{gospa} mm: localisation {localisation}, missed {missed}, false {false}",
        "RMSE": _paths(evaluation, unit),
    }
    if evaluation.inside_90_rate is not None:
        lines["ellipsoid"] = (
            f"of 90 % holds {_or_dash(evaluation.inside_90_rate, '.1%')} "
            f"({_or_dash(evaluation.offset_removed_inside_90_rate, '.1%')} centred), mean NEES "
            f"{_or_dash(evaluation.mean_nees, '.2g')} ({_or_dash(evaluation.offset_removed_mean_nees, '.2g')})"
        )
    lines["centred"] = _centred(evaluation, unit)
    return lines


def _centred(evaluation: Evaluation, unit: _Unit) -> str:
    """Explain the column "centred": the frames of the offsets, and the largest standard error of an offset."""
    drones = evaluation.per_drone
    frames = sorted({drone.offset_frame for drone in drones if drone.offset_frame})
    parts_m = [part_m for drone in drones for part_m in drone.offset_standard_error_m or ()]
    known = f", known to {unit.number(max(parts_m))} {unit.name}" if parts_m else ""
    return f"without each drone's offset ({' or '.join(frames) or 'no'} frame{known})"


def _paths(evaluation: Evaluation, unit: _Unit) -> str:
    ate, ate_aligned, rpe = map(
        unit.number, (evaluation.ate_rmse_m, evaluation.ate_aligned_rmse_m, evaluation.rpe_1s_rmse_m)
    )
    turn_deg = evaluation.rpe_1s_rotation_rmse_deg
    turn = "" if turn_deg is None else f" and {turn_deg:.2f} deg"
    return f"ATE {ate} {unit.name} ({ate_aligned} aligned), RPE over 1 s {rpe} {unit.name}{turn}"


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"
