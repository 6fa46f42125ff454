"""Tables and JSON of `calibrate`: positions of cameras, and the points that fit worst."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from psotrack.cli.output import POSITION, Output, finite_or_none, format_numbers

#: Number of points that are shown by name for each camera, those that fit worst.
_WORST = 5


def row_of(
    centre_m: Float[np.ndarray, "3"],
    covariance_m2: Float[np.ndarray, "3 3"],
    residual_px: Float[np.ndarray, " points"],
    used: np.ndarray,
    points: Any,
) -> dict[str, Any]:
    """Row of a camera: position, standard deviation of the position, and the points that fit worst."""
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


def show_cameras(
    output: Output, rows: dict[str, dict[str, Any]], out: Path, sentences: Sequence[str] = ()
) -> None:
    """Show the cameras, as JSON or as a table with the points that fit worst, and sentences on them."""
    output.json({"rig": str(out), "cameras": rows, "notes": list(sentences)})
    adjusted = any("moved_m" in row for row in rows.values())
    # An adjusted camera's movement matters more than its position, and a line has no room for both.
    place = ("moved (mm)", "turned (deg)", "std (mm)", "verdict") if adjusted else (POSITION, "std (mm)")
    output.table(
        ("camera", "points", "rms (px)", *place),
        (
            (
                name,
                f"{row['used']} of {row['points']}",
                "" if row["rms_px"] is None else f"{row['rms_px']:.2f}",
                *(_changed(row) if adjusted else _placed(row)),
            )
            for name, row in rows.items()
        ),
    )
    # Names of points may be too long for a column.
    for name, row in rows.items():
        output.say(f"{name}, worst points (px): {', '.join(map(_worst, row['worst']))}")
    for sentence in sentences:
        output.say(sentence)
    output.say(f"{out}")


def _placed(row: dict[str, Any]) -> tuple[str, str]:
    return format_numbers(row["centre_m"], 3), format_numbers([1e3 * std for std in row["centre_std_m"]], 1)


def _changed(row: dict[str, Any]) -> tuple[str, str, str, str]:
    std_mm = 1e3 * float(np.linalg.norm(row["centre_std_m"]))
    return f"{1e3 * row['moved_m']:.1f}", f"{row['turned_deg']:.2f}", f"{std_mm:.1f}", row["verdict"]


def _worst(one: dict[str, Any]) -> str:
    distance = "behind" if one["residual_px"] is None else f"{one['residual_px']:.1f}"
    return f"{one['point']} {distance}{'' if one['used'] else ' left out'}"
