"""Tables and JSON of `onboard map`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from psotrack.cli.onboard.shutter import shutter_content, shutter_sentence
from psotrack.cli.output import Output
from psotrack.support import POSITION, finite_or_none, format_numbers

if TYPE_CHECKING:
    from psotrack.inside_out import BuiltMap, FittedSquares, MapCheck, MarkerMap, RollingShutter


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


def show_built(
    output: Output, built: BuiltMap, rows_px: dict[str, int], given: RollingShutter | None, out: Path
) -> None:
    """Show a map from videos, with the standard deviation of each marker's position.

    Args:
        built: the map.
        rows_px: height of the images by video.
        given: the shutter that the options give.
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
        "inset_px": dict(zip(rows_px, built.inset_px.tolist(), strict=True)),
        "shutter": _shutters(built, rows_px, given),
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
    for name, shown in zip(rows_px, built.line_times, strict=True):
        if of_shutter := shutter_sentence(given, shown):
            output.say(f"{name}: {of_shutter}")
    output.say(f"{out}: {len(rows)} markers from {built.num_views} frames")


def show_check(
    output: Output, checkup: MapCheck, rows_px: dict[str, int], given: RollingShutter | None, path: Path
) -> None:
    """Show the markers of a map that videos see elsewhere.

    Args:
        checkup: result of the check.
        rows_px: height of the images by video.
        given: the shutter that the options give.
        path: table of the map.
    """
    rows = {
        marker: {
            "frames": one.sightings,
            "residual_px": finite_or_none(one.residual_px),
            "moved_m": [finite_or_none(value) for value in one.moved_m],
            "std_m": [finite_or_none(value) for value in one.std_m],
            "turned_deg": finite_or_none(one.turned_deg),
            "turn_std_deg": finite_or_none(one.turn_std_deg),
            "grown": finite_or_none(one.side_ratio),
        }
        for marker, one in sorted(checkup.markers.items())
    }
    content = {
        "map": str(path),
        "findings": [{**vars(one), "markers": list(one.markers)} for one in checkup.findings],
        "frames": checkup.num_views,
        "noise_px": checkup.noise_px,
        "not_in_map": list(checkup.not_in_map),
        "shutter": _shutters(checkup, rows_px, given),
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
    for name, shown in zip(rows_px, checkup.line_times, strict=True):
        if of_shutter := shutter_sentence(given, shown, "the check uses the given one"):
            output.say(f"{name}: {of_shutter}")
    for finding in checkup.findings:
        output.say(str(finding), always=True)
    if not checkup.findings:
        output.say(f"{path}: nothing disagrees")


def _shutters(
    found: BuiltMap | MapCheck, rows_px: dict[str, int], given: RollingShutter | None
) -> dict[str, Any]:
    """The shutter of each video: given, used, and shown by the video."""
    return {
        name: shutter_content(given, used, shown, rows)
        for (name, rows), used, shown in zip(rows_px.items(), found.shutters, found.line_times, strict=True)
    }


def _place(marker_map: MarkerMap, marker: int) -> dict[str, Any]:
    row = marker_map.ids.tolist().index(marker)
    return {
        "centre_m": marker_map.centres_m[row].tolist(),
        "normal": marker_map.normals[row].tolist(),
        "side_m": float(marker_map.sides_m[row]),
    }
