"""How `calibrate` shows where cameras stand, and which points fit worst."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from psotrack.cli.answers import PLACE, answer, in_words, known, say, show

#: Points that are shown by name, those that fit worst.
_WORST = 5


def row_of(
    centre_m: Float[np.ndarray, "3"],
    covariance_m2: Float[np.ndarray, "3 3"],
    residual_px: Float[np.ndarray, " points"],
    used: np.ndarray,
    points: Any,
) -> dict[str, Any]:
    """What is said of a camera: where it is, how surely, and which of its points fit worst."""
    order = np.argsort(-residual_px)[:_WORST]
    return {
        "centre_m": centre_m.tolist(),
        "centre_std_m": np.sqrt(np.diag(covariance_m2)).tolist(),
        "points": len(residual_px),
        "used": int(used.sum()),
        "rms_px": float(np.sqrt(np.mean(residual_px[used] ** 2))) if used.any() else None,
        "worst": [
            # Behind the camera there is no distance.
            {
                "point": str(points[index]),
                "residual_px": known(residual_px[index]),
                "used": bool(used[index]),
            }
            for index in order
        ],
    }


def show_cameras(
    rows: dict[str, dict[str, Any]], out: Path, quiet: bool, json_path: Path | None, force: bool
) -> None:
    """The cameras as JSON, or a table of them and the points that fit worst."""
    answer(json_path, {"rig": str(out), "cameras": rows}, force)
    adjusted = any("moved_m" in row for row in rows.values())
    # Where a camera is now is of less interest than how far that is from where it was, and a line is short.
    place = ("moved (mm)", "turned (deg)", "std (mm)", "verdict") if adjusted else (PLACE, "std (mm)")
    show(
        quiet,
        json_path,
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
    # Names of points may be long, and a column of them narrow.
    for name, row in rows.items():
        say(quiet, json_path, f"{name}, worst points (px): {', '.join(map(_worst, row['worst']))}")
    say(quiet, json_path, f"{out}")


def _placed(row: dict[str, Any]) -> tuple[str, str]:
    return in_words(row["centre_m"], 3), in_words([1e3 * std for std in row["centre_std_m"]], 1)


def _changed(row: dict[str, Any]) -> tuple[str, str, str, str]:
    std_mm = 1e3 * float(np.linalg.norm(row["centre_std_m"]))
    return f"{1e3 * row['moved_m']:.1f}", f"{row['turned_deg']:.2f}", f"{std_mm:.1f}", row["verdict"]


def _worst(one: dict[str, Any]) -> str:
    distance = "behind" if one["residual_px"] is None else f"{one['residual_px']:.1f}"
    return f"{one['point']} {distance}{'' if one['used'] else ' left out'}"
