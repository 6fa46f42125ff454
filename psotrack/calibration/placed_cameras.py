"""Cameras that were placed by points: their positions, and the points that fit worst, as records, tables and JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from psotrack.calibration.extrinsics import locate_camera
from psotrack.calibration.image_points import ImagePoints
from psotrack.geometry import Camera, Rig, make_rig
from psotrack.support import (
    POSITION,
    finite_or_none,
    format_numbers,
    html_block,
    html_lines,
    html_table,
    text_table,
)

#: Number of points that are shown by name for each camera, those that fit worst.
_WORST = 5


@dataclass(frozen=True, repr=False)
class PlacedCameras:
    """Cameras that were placed by points; its text is what the commands of `psotrack calibrate` print.

    Attributes:
        rig: the cameras.
        cameras: what `row_of` says of each camera, by its name.
        notes: sentences on the world, and on what the points do not determine.
        path: file of the rig; None where it is not written.
    """

    rig: Rig
    cameras: Mapping[str, dict[str, Any]]
    notes: Sequence[str] = ()
    path: Path | None = None

    def to_dict(self) -> dict[str, Any]:
        """What is known of each camera, and the notes."""
        path = None if self.path is None else str(self.path)
        return {"rig": path, "cameras": dict(self.cameras), "notes": list(self.notes)}

    def __str__(self) -> str:
        # Names of points may be too long for a column.
        worst = (f"{name}, worst points (px): {words}" for name, words in self._worst().items())
        path = () if self.path is None else (f"{self.path}",)
        return "\n".join([text_table(*self._table()), *worst, *self.notes, *path])

    def __repr__(self) -> str:
        return f"PlacedCameras({', '.join(self.rig.names)}; {'; '.join(self.notes)})"

    def _repr_html_(self) -> str:
        """What a notebook shows: the table of the cameras, and the points that fit worst."""
        return html_block("; ".join(self.notes), html_table(*self._table()), html_lines(self._worst()))

    def _worst(self) -> dict[str, str]:
        return {name: ", ".join(map(_in_words, row["worst"])) for name, row in self.cameras.items()}

    def _table(self) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
        adjusted = any("moved_m" in row for row in self.cameras.values())
        # An adjusted camera's movement matters more than its position, and a line has no room for both.
        place = ("moved (mm)", "turned (deg)", "std (mm)", "verdict") if adjusted else (POSITION, "std (mm)")
        rows = [
            (
                name,
                f"{row['used']} of {row['points']}",
                "" if row["rms_px"] is None else f"{row['rms_px']:.2f}",
                *(_changed(row) if adjusted else _placed(row)),
            )
            for name, row in self.cameras.items()
        ]
        return ("camera", "points", "rms (px)", *place), rows


def row_of(
    centre_m: Float[np.ndarray, "3"],
    covariance_m2: Float[np.ndarray, "3 3"],
    residual_px: Float[np.ndarray, " points"],
    used: Bool[np.ndarray, " points"],
    points: Any,
) -> dict[str, Any]:
    """What is said of a camera: position, its standard deviation, and the points that fit worst.

    Args:
        centre_m: (3,), centre of the camera, metres.
        covariance_m2: (3, 3), its covariance, m².
        residual_px: (points,), distances of the points from their projections, pixels.
        used: (points,), False for points that were left out.
        points: names of the points.
    """
    order = np.argsort(-residual_px)[:_WORST]
    return {
        "centre_m": centre_m.tolist(),
        "centre_std_m": np.sqrt(np.diag(covariance_m2)).tolist(),
        "points": len(residual_px),
        "used": int(used.sum()),
        "rms_px": float(np.sqrt(np.mean(residual_px[used] ** 2))) if used.any() else None,
        "worst": [
            # A point behind the camera has no distance in the image.
            {
                "point": str(points[index]),
                "residual_px": finite_or_none(residual_px[index]),
                "used": bool(used[index]),
            }
            for index in order
        ],
    }


def place_cameras(
    marks: Mapping[str, ImagePoints], lenses: Mapping[str, Camera], noise_px: float
) -> PlacedCameras:
    """Place cameras whose images show points of known positions.

    Args:
        marks: the points in each camera's image, by the camera's name.
        lenses: a camera with the lens of each.
        noise_px: standard deviation of a point in the image, along x and along y, pixels.

    Raises:
        InputError: the points do not determine a camera's place.
    """
    cameras, rows = {}, {}
    for name, of_camera in marks.items():
        one = lenses[name]
        located = locate_camera(
            of_camera.points_m,
            of_camera.points_px,
            np.asarray(one.K),
            np.asarray(one.dist),
            noise_px,
            fisheye=bool(one.fisheye),
            name=f"camera {name}",
        )
        cameras[name] = replace(one, T_cam_world=located.T_cam_world)
        rows[name] = row_of(
            np.asarray(cameras[name].centre_world),
            located.centre_covariance_m2,
            located.residual_px,
            located.used,
            of_camera.points,
        )
    return PlacedCameras(make_rig(cameras), rows)


def _placed(row: dict[str, Any]) -> tuple[str, str]:
    return format_numbers(row["centre_m"], 3), format_numbers([1e3 * std for std in row["centre_std_m"]], 1)


def _changed(row: dict[str, Any]) -> tuple[str, str, str, str]:
    std_mm = 1e3 * float(np.linalg.norm(row["centre_std_m"]))
    return f"{1e3 * row['moved_m']:.1f}", f"{row['turned_deg']:.2f}", f"{std_mm:.1f}", row["verdict"]


def _in_words(one: dict[str, Any]) -> str:
    distance = "behind" if one["residual_px"] is None else f"{one['residual_px']:.1f}"
    return f"{one['point']} {distance}{'' if one['used'] else ' left out'}"
