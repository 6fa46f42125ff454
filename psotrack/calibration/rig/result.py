"""What a calibration of a rig gives: the cameras, their figures, and sentences, as a record, text, a table and JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from psotrack.calibration.rig.adjustment import CalibratedRig
from psotrack.geometry import Rig
from psotrack.support import POSITION, finite_or_none, format_numbers, html_block, html_table, text_table

#: Number of points that are shown by name for each camera, those that fit worst.
_WORST = 5


@dataclass(frozen=True, repr=False)
class RigCalibration:
    """A rig that was calibrated; its text is what `psotrack calibrate rig` prints.

    Attributes:
        rig: the cameras.
        cameras: figures of each camera, by its name.
        table: headings, and a row of texts of each camera.
        before: sentences above the table.
        after: sentences below the table.
        more: what JSON has besides the cameras.
        calibrated: how the rig fits each view of a board; None without a board.
        path: file of the rig; None where it is not written.
    """

    rig: Rig
    cameras: Mapping[str, dict[str, Any]]
    table: tuple[Sequence[str], Sequence[Sequence[str]]]
    before: Sequence[str] = ()
    after: Sequence[str] = ()
    more: Mapping[str, Any] = field(default_factory=dict)
    calibrated: CalibratedRig | None = None
    path: Path | None = None

    def to_dict(self) -> dict[str, Any]:
        """The figures of the cameras, and the sentences."""
        path = None if self.path is None else str(self.path)
        return {"rig": path, "cameras": dict(self.cameras), **self.more}

    def __str__(self) -> str:
        path = () if self.path is None else (f"{self.path}",)
        return "\n".join([*self.before, text_table(*self.table), *self.after, *path])

    def __repr__(self) -> str:
        return f"RigCalibration({', '.join(self.rig.names)}; {'; '.join(self.after)})"

    def _repr_html_(self) -> str:
        """What a notebook shows: the table of the cameras, and the sentences."""
        return html_block("; ".join(self.after), html_table(*self.table))


@dataclass(frozen=True)
class PointFit:
    """How points fit one camera.

    Attributes:
        points: names of the points.
        covariance_m2: (3, 3), covariance of the camera's centre, m².
        residual_px: (points,), distances of the points from their projections, pixels; infinite behind the camera.
        used: (points,), False for points that were left out.
    """

    points: Sequence[Any]
    covariance_m2: Float[np.ndarray, "3 3"]
    residual_px: Float[np.ndarray, " points"]
    used: Bool[np.ndarray, " points"]


def calibration_by_points(rig: Rig, fits: Mapping[str, PointFit], notes: Sequence[str]) -> RigCalibration:
    """The result of a calibration by points: positions, standard deviations, and the points that fit worst.

    Args:
        rig: the cameras.
        fits: how the points fit each camera.
        notes: sentences on the world, and on what the points do not determine.
    """
    cameras, rows, worst = {}, [], []
    for name, centre_m in zip(rig.names, np.asarray(rig.cameras.centre_world), strict=True):
        fit = fits[name]
        std_m = np.sqrt(np.diag(fit.covariance_m2))
        rms_px = float(np.sqrt(np.mean(fit.residual_px[fit.used] ** 2))) if fit.used.any() else None
        points = [
            {
                "point": str(fit.points[index]),
                "residual_px": finite_or_none(fit.residual_px[index]),
                "used": bool(fit.used[index]),
            }
            for index in np.argsort(-fit.residual_px)[:_WORST]
        ]
        cameras[name] = {
            "centre_m": centre_m.tolist(),
            "centre_std_m": std_m.tolist(),
            "points": len(fit.used),
            "used": int(fit.used.sum()),
            "rms_px": rms_px,
            "worst": points,
        }
        rows.append(
            (
                name,
                f"{fit.used.sum()} of {len(fit.used)}",
                "" if rms_px is None else f"{rms_px:.2f}",
                format_numbers(centre_m.tolist(), 3),
                format_numbers((1e3 * std_m).tolist(), 1),
            )
        )
        # Names of points may be too long for a column.
        worst.append(f"{name}, worst points (px): {', '.join(map(_in_words, points))}")
    table = ("camera", "points", "rms (px)", POSITION, "std (mm)"), rows
    return RigCalibration(rig, cameras, table, after=[*worst, *notes], more={"notes": list(notes)})


def _in_words(one: dict[str, Any]) -> str:
    distance = "behind" if one["residual_px"] is None else f"{one['residual_px']:.1f}"
    return f"{one['point']} {distance}{'' if one['used'] else ' left out'}"
