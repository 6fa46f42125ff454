"""How `map-markers` shows a map, and what is wrong with one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from psotrack.cli.answers import PLACE, answer, in_words, known, say, show

if TYPE_CHECKING:
    from psotrack.inside_out import BuiltMap, FittedSquares, MapCheck, MarkerMap


def show_measured(
    squares: FittedSquares, out: Path, quiet: bool, json_path: Path | None, force: bool
) -> None:
    """A map from measured corners, and how far these are from squares."""
    rows = {
        marker: {**_place(squares.marker_map, marker), "residual_m": squares.residual_m[marker].tolist()}
        for marker in squares.marker_map.ids.tolist()
    }
    answer(json_path, {"map": str(out), "reordered": list(squares.reordered), "markers": rows}, force)
    show(
        quiet,
        json_path,
        ("marker", PLACE, "side (mm)", "corners off (mm)"),
        [
            (
                f"{marker}",
                in_words(row["centre_m"], 3),
                f"{1e3 * row['side_m']:.1f}",
                in_words([1e3 * off for off in row["residual_m"]], 1),
            )
            for marker, row in rows.items()
        ],
    )
    for marker in squares.reordered:
        say(quiet, json_path, f"marker {marker}: its corners were labelled in another order, and put right")
    worst = max(max(row["residual_m"]) for row in rows.values())
    say(quiet, json_path, f"{out}: {len(rows)} markers, corners within {1e3 * worst:.1f} mm of squares")


def show_built(
    built: BuiltMap, videos: list[str], out: Path, quiet: bool, json_path: Path | None, force: bool
) -> None:
    """A map from videos, and how surely each marker is where it is."""
    rows = {}
    for index, marker in enumerate(built.ids.tolist()):
        rows[marker] = {
            **_place(built.marker_map, marker),
            "std_m": built.std_m[index].tolist(),
            "turn_std_deg": np.rad2deg(built.turn_std_rad[index]).tolist(),
            "side_std_m": float(np.sqrt(built.covariance[index, 6, 6]) * built.marker_map.sides_m[index]),
            "residual_px": known(built.residual_px[index]),
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
    answer(json_path, content, force)
    show(
        quiet,
        json_path,
        ("marker", "frames", "left out", "rms (px)", PLACE, "std (mm)", "turn std (deg)"),
        [
            (
                f"{marker}{' known' if row['known'] else ''}",
                f"{row['frames']}",
                f"{row['outliers']}",
                "" if row["residual_px"] is None else f"{row['residual_px']:.2f}",
                in_words(row["centre_m"], 3),
                f"{1e3 * np.linalg.norm(row['std_m']):.1f}",
                f"{np.linalg.norm(row['turn_std_deg']):.2f}",
            )
            for marker, row in rows.items()
        ],
    )
    if built.unplaced:
        names = ", ".join(map(str, built.unplaced))
        say(quiet, json_path, f"not placed, because too seldom seen beside others: {names}")
    say(quiet, json_path, f"{out}: {len(rows)} markers from {built.num_views} frames")


def show_check(checkup: MapCheck, path: Path, quiet: bool, json_path: Path | None, force: bool) -> None:
    """Which markers of a map are not where videos see them."""
    rows = {
        marker: {
            "frames": one.sightings,
            "residual_px": known(one.residual_px),
            "moved_m": [known(value) for value in one.moved_m],
            "std_m": [known(value) for value in one.std_m],
            "turned_deg": known(one.turned_deg),
            "turn_std_deg": known(one.turn_std_deg),
            "grown": known(one.side_ratio),
        }
        for marker, one in sorted(checkup.markers.items())
    }
    content = {
        "map": str(path),
        "findings": [{**vars(one), "markers": list(one.markers)} for one in checkup.findings],
        "frames": checkup.num_views,
        "noise_px": checkup.noise_px,
        "not_in_map": list(checkup.not_in_map),
        "markers": rows,
    }
    answer(json_path, content, force)
    show(
        quiet,
        json_path,
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
        say(False, json_path, str(finding))
    if not checkup.findings:
        say(quiet, json_path, f"{path}: nothing disagrees")


def _place(marker_map: MarkerMap, marker: int) -> dict[str, Any]:
    row = marker_map.ids.tolist().index(marker)
    return {
        "centre_m": marker_map.centres_m[row].tolist(),
        "normal": marker_map.normals[row].tolist(),
        "side_m": float(marker_map.sides_m[row]),
    }
