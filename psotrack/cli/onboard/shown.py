"""Sentences, table and JSON of `onboard map`."""

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
    places = _places(squares.marker_map)
    off_m = squares.residual_m
    output.json(
        {
            "map": str(out),
            "markers": {
                marker: row | {"residual_m": off_m[marker].tolist()} for marker, row in places.items()
            },
        }
    )
    worst, worst_mm = max(
        ((one, 1e3 * float(off.max())) for one, off in off_m.items()), key=lambda one: one[1]
    )
    output.say(f"{out}: {len(places)} markers, corners within {worst_mm:.1f} mm of squares (marker {worst})")


def show_built(output: Output, built: BuiltMap, videos: list[str], out: Path) -> None:
    """Show a map from videos, given their names, with the standard deviation of each marker's position."""
    rows = _places(built.marker_map)
    for index, row in enumerate(rows.values()):
        row |= {
            "std_m": built.std_m[index].tolist(),
            "turn_std_deg": np.rad2deg(built.turn_std_rad[index]).tolist(),
            "side_std_m": float(np.sqrt(built.covariance[index, 6, 6]) * built.marker_map.sides_m[index]),
            "residual_px": finite_or_none(built.residual_px[index]),
            "frames": int(built.sightings[index]),
            "outliers": int(built.outliers[index]),
            "known": bool(built.known[index]),
        }
    output.json(
        {
            "map": str(out),
            "frames": built.num_views,
            "noise_px": built.noise_px,
            "inset_px": dict(zip(videos, built.inset_px.tolist(), strict=True)),
            "unplaced": list(built.unplaced),
            "markers": rows,
        }
    )
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
    output.json({"map": str(path), **checkup.to_dict()})
    output.say(*map(str, checkup.findings), always=True)
    if not checkup.findings:
        output.say(f"{path}: nothing disagrees")


def _places(marker_map: MarkerMap) -> dict[int, dict[str, Any]]:
    """Centre, normal and side of each marker, by id, fit for JSON."""
    rows = zip(marker_map.centres_m, marker_map.normals, marker_map.sides_m, strict=True)
    return {
        marker: {"centre_m": centre_m.tolist(), "normal": normal.tolist(), "side_m": float(side_m)}
        for marker, (centre_m, normal, side_m) in zip(marker_map.ids.tolist(), rows, strict=True)
    }
