"""Tables and JSON of `onboard map`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from psotrack.cli.output import Output
from psotrack.support import POSITION, finite_or_none, format_numbers

if TYPE_CHECKING:
    from psotrack.inside_out import BuiltMap, FittedSquares, MapCheck, MarkerMap


def show_measured(output: Output, squares: FittedSquares, out: Path) -> None:
    """Show a map from measured corners, and the distances of the corners from squares."""
    rows = {
        marker: {**_place(squares.marker_map, marker), "residual_m": squares.residual_m[marker].tolist()}
        for marker in squares.marker_map.ids.tolist()
    }
    output.json({"map": str(out), "reordered": list(squares.reordered), "markers": rows})
    output.table(
        ("marker", POSITION, "side (mm)", "corners off (mm)"),
        [
            (
                f"{marker}",
                format_numbers(row["centre_m"], 3),
                f"{1e3 * row['side_m']:.1f}",
                format_numbers([1e3 * off for off in row["residual_m"]], 1),
            )
            for marker, row in rows.items()
        ],
    )
    for marker in squares.reordered:
        output.say(f"marker {marker}: its corners were labelled in another order; the order was corrected")
    worst = max(max(row["residual_m"]) for row in rows.values())
    output.say(f"{out}: {len(rows)} markers, corners within {1e3 * worst:.1f} mm of squares")


def show_built(output: Output, built: BuiltMap, videos: list[str], out: Path) -> None:
    """Show a map from videos, with the standard deviation of each marker's position.

    Args:
        built: the map.
        videos: names of the videos.
        out: table of the map.
    """
    rows = {}
    for index, marker in enumerate(built.ids.tolist()):
        rows[marker] = {
            **_place(built.marker_map, marker),
            "std_m": built.std_m[index].tolist(),
            "turn_std_deg": np.rad2deg(built.turn_std_rad[index]).tolist(),
            "side_std_m": float(np.sqrt(built.covariance[index, 6, 6]) * built.marker_map.sides_m[index]),
            "residual_px": finite_or_none(built.residual_px[index]),
            "frames": int(built.sightings[index]),
            "outliers": int(built.outliers[index]),
            "known": bool(built.known[index]),
        }
    content = {
        "map": str(out),
        "frames": built.num_views,
        "noise_px": built.noise_px,
        "inset_px": dict(zip(videos, built.inset_px.tolist(), strict=True)),
        "unplaced": list(built.unplaced),
        "markers": rows,
    }
    output.json(content)
    output.table(
        ("marker", "frames", "left out", "rms (px)", POSITION, "std (mm)", "turn std (deg)"),
        [
            (
                f"{marker}{' known' if row['known'] else ''}",
                f"{row['frames']}",
                f"{row['outliers']}",
                "" if row["residual_px"] is None else f"{row['residual_px']:.2f}",
                format_numbers(row["centre_m"], 3),
                f"{1e3 * np.linalg.norm(row['std_m']):.1f}",
                f"{np.linalg.norm(row['turn_std_deg']):.2f}",
            )
            for marker, row in rows.items()
        ],
    )
    if built.unplaced:
        names = ", ".join(map(str, built.unplaced))
        output.say(f"not placed, because too rarely seen beside other markers: {names}")
    output.say(f"{out}: {len(rows)} markers from {built.num_views} frames")


def show_check(output: Output, checkup: MapCheck, path: Path) -> None:
    """Show the markers of a map, whose table is at a path, that videos see elsewhere."""
    rows: dict[int, dict[str, Any]] = {}
    for marker, frames in sorted(checkup.sightings.items()):
        difference = checkup.differences.get(marker)
        rows[marker] = {
            "frames": frames,
            "residual_px": checkup.residual_px.get(marker),
            **({} if difference is None else vars(difference)),
        }
        for name in ("moved_m", "std_m"):
            if name in rows[marker]:
                rows[marker][name] = rows[marker][name].tolist()
    content = {
        "map": str(path),
        "findings": [{**vars(one), "markers": list(one.markers)} for one in checkup.findings],
        "frames": checkup.num_views,
        "noise_px": checkup.noise_px,
        "not_in_map": list(checkup.not_in_map),
        "markers": rows,
    }
    output.json(content)
    output.table(
        ("marker", "frames", "median off (px)"),
        [
            (
                f"{marker}",
                f"{row['frames']}",
                "" if row["residual_px"] is None else f"{row['residual_px']:.2f}",
            )
            for marker, row in rows.items()
        ],
    )
    for finding in checkup.findings:
        output.say(str(finding), always=True)
    if not checkup.findings:
        output.say(f"{path}: nothing disagrees")


def _place(marker_map: MarkerMap, marker: int) -> dict[str, Any]:
    row = marker_map.ids.tolist().index(marker)
    return {
        "centre_m": marker_map.centres_m[row].tolist(),
        "normal": marker_map.normals[row].tolist(),
        "side_m": float(marker_map.sides_m[row]),
    }
